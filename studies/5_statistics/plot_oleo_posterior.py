r"""
The posterior of an oleo
========================

From a campaign to a posterior: where the walkers start, how they move, whether they have settled,
what the draws say that the point did not, and what they foresee. The campaign is the simulated one
of :doc:`../1_start_here/plot_demo`, and the model lacks its effect, friction that drops as the
strut breaks away: what do error models make of that?
"""

# %%
# Sampling takes seconds: all runs of all walkers are solved in one batch.

import json
import tempfile
import warnings
from pathlib import Path

import arviz as az
import numpy as np

import bayesoleo
import bayesoleo._workflow
from bayesoleo import plots
from bayesoleo._workflow.simulating import DEMO_SYSTEM, DEMO_TRUTH, demo_campaign
from bayesoleo.plots import Study

campaign = demo_campaign(Path(tempfile.mkdtemp()) / "campaign", seed=0)
model = bayesoleo.system(DEMO_SYSTEM)


def sampled(error_model):
    """The result under one error model."""
    return bayesoleo._workflow.estimating.sample(
        campaign, model, bayesoleo.Settings(seed=0, error_model=error_model, quick=True)
    )


tree = sampled("independent")

# %%
# **Start and moves.** Walkers of four ensembles are drawn from Laplace approximations at the modes
# and proposed from a mixture that was adapted to the warm-up and then frozen; a part of the steps
# goes by differences between walkers. How often each was accepted, and what the draws are worth by
# the smallest of three estimates:

stats = {key: tree["sample_stats"].attrs[key] for key in tree["sample_stats"].attrs}
print("accepted:", {k: round(v, 2) for k, v in json.loads(stats["acceptance"]).items()})
sizes, times, rhat = (
    json.loads(stats[key]).values()
    for key in ("effective_sample_size", "autocorrelation_time", "rhat_nested")
)
print(
    f"{stats['evaluations']} evaluations, effective size at least {min(sizes):.0f}, autocorrelation"
    f" time at most {max(times):.1f} draws, nested R-hat at most {max(rhat):.3f}"
)
figure_trace = plots.trace(tree)

# %%
# **Pairs.** Piston area and volume go together, for the gas feels their quotient; the friction that
# is always there and the one that grows with pressure trade off.

figure_corner = plots.corner(tree)

# %%
# **Point against posterior.** Mode and linearised covariance say nearly all there is to say, once
# the model is accepted; only the slope of the friction, which stands in an arctan, is skewed. So
# the intervals are *computed* well. Whether they are *right* can be asked here, where the truth is
# known (last column). The gas is found. The friction is many standard deviations off: its three
# parameters stand in for the part that is missing.

found = tree["comparison"].to_dataset()
print(
    f"{'parameter':24}{'shift [sd]':>11}{'sd / linear':>13}{'skewness':>10}{'truth off [sd]':>16}"
)
for name in found["parameter"].values:
    one, draws = found.sel(parameter=name), tree["posterior"][str(name)]
    ratio = float(one["sd_ratio"].sel(reference="linearised"))
    off = (float(draws.mean()) - DEMO_TRUTH[str(name)]) / float(draws.std())
    numbers = f"{float(one['shift']):11.2f}{ratio:13.2f}{float(one['skewness']):10.2f}{off:16.1f}"
    print(f"{name!s:24}{numbers}")
figure_forest = plots.point_against_posterior(tree)

# %%
# **What it foresees.** The band of the averages over each run's periods, and within it what the
# parameters leave open, a line. Measured averages leave the band wherever the strut turns round:
# errors are not independent, and each of a thousand samples was taken for news.

figure_force = plots.predictive(tree, "force")

# %%
# **Other errors.** The same with a variance for each run, and with a discrepancy that repeats every
# period. Under the discrepancy the slope comes near its truth while the base moves away from it:
# what is missing may be taken for friction or for a discrepancy, and a discrepancy that is smooth
# would rather be a step that lasts for half a cycle than the spike that it was (figure). An error
# model widens intervals; it does not make a wrong model right. Leaving out one run at a time
# (``arviz.loo``) tells the error models apart. Importance sampling cannot leave out a quarter of
# the data, and says so by a Pareto k above 0.7, but differences of this size need no digits.

study = Study("oleo_posterior", slow=True)
trees = study.run(
    lambda: {"independent": tree} | {word: sampled(word) for word in ("per-run", "discrepancy")}
)


def leave_one_out():
    """Expected log density of a new run, and the width of three parameters."""
    names = ("heat_conduction", "friction_base", "friction_slope")
    print(f"{'errors':13}{'elpd':>9}{'largest k':>11}" + "".join(f"{n:>26}" for n in names))
    for word, one in trees.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of k, which is printed
            loo = az.loo(one, var_name="runs", pointwise=True)
        cells = "".join(
            f"{float(d.mean()):15.4g} ± {float(d.std()):8.2g}"
            for d in (one["posterior"][name] for name in names)
        )
        print(f"{word:13}{loo.elpd:9.0f}{float(np.max(loo.pareto_k)):11.2f}{cells}")
    truth = "".join(f"{DEMO_TRUTH[name]:15.4g}{'':11}" for name in names)
    print(f"{'truth':33}{truth.rstrip()}")
    print(f"bayesoleo {bayesoleo.__version__}, seed 0; to repeat:")
    print("BAYESOLEO_STORE_FIGURES=1 python studies/5_statistics/plot_oleo_posterior.py")


study.text("loo", leave_one_out)
figure_discrepancy = study.figure(
    "discrepancy", lambda: plots.predictive(trees["discrepancy"], "force")
)
