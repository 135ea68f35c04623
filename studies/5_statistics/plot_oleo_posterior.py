r"""
The posterior of an oleo
========================

This page samples the posterior of an oleo (the shock strut of an aircraft), checks its convergence,
and compares it with the point estimate. The campaign is the simulated one of
:doc:`../1_start_here/plot_demo`. The model lacks an effect, friction that falls as the strut breaks
away, so the page also shows how far different error models compensate for that.
"""

# %%
# Sampling takes seconds: all runs of all walkers are solved in one batch.

# sphinx_gallery_thumbnail_number = 2
import json
import tempfile
import warnings
from pathlib import Path

import arviz as az
import numpy as np

import bayesoleo as bo
from bayesoleo import plots
from bayesoleo.gallery import Study

campaign = bo.Campaign.demo(Path(tempfile.mkdtemp()) / "campaign", seed=0)
TRUTH = {
    "piston_area": 3.44916e-3,
    "initial_volume": 9.2736e-4,
    "orifice_damping": 3186.7,
    "friction_base": 78.0,
    "friction_per_pressure": 1.6e-5,
    "friction_slope": 4080.0,
    "solubility": -1.3345e-8,
    "heat_conduction": 1.92525,
}


def sampled(error_model):
    """Sample the posterior under one error model."""
    problem = bo.Problem(campaign, "f16n2d2", seed=0, quick=True, error_model=error_model)
    return problem.fit(progress=False).sample(progress=False).tree


tree = sampled("independent")

# %%
# **Sampling.** The walkers of four ensembles start from Laplace approximations at the modes.
# Proposals come from a mixture that is adapted during warm-up and then fixed, and from differences
# between walkers. The output has the acceptance rates, and the smallest of three estimates of the
# effective sample size:

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
# **Pairs.** Piston area and volume are correlated, because the gas depends on their quotient. The
# constant friction and the friction proportional to pressure are correlated too.

figure_corner = plots.corner(tree)

# %%
# **Point against posterior.** The mode and the linearised covariance describe the posterior well.
# Only the slope of the friction, the argument of an arctan, is skewed. So the intervals are
# *computed* well. Whether they are *right* is known here, because the truth is known (last column).
# The gas parameters are right. The friction is many standard deviations off: its three parameters
# compensate for the missing effect.

found = tree["comparison"].to_dataset()
print(
    f"{'parameter':24}{'shift [sd]':>11}{'sd / linear':>13}{'skewness':>10}{'truth off [sd]':>16}"
)
for name in found["parameter"].values:
    one, draws = found.sel(parameter=name), tree["posterior"][str(name)]
    ratio = float(one["sd_ratio"].sel(reference="linearised"))
    off = (float(draws.mean()) - TRUTH[str(name)]) / float(draws.std())
    numbers = f"{float(one['shift']):11.2f}{ratio:13.2f}{float(one['skewness']):10.2f}{off:16.1f}"
    print(f"{name!s:24}{numbers}")
figure_forest = plots.point_against_posterior(tree)

# %%
# **Predictive distribution.** The band is the prediction of the averages over periods; the line
# within it is the uncertainty of the parameters alone. Measured averages leave the band wherever
# the motion reverses: the errors are not independent, but each of a thousand samples was counted as
# independent.

figure_force = plots.predictive(tree, "force")

# %%
# **Other error models.** The same with a variance for each run, and with a discrepancy that repeats
# every period. With the discrepancy the slope is near its truth, but the base is farther away. The
# missing effect is attributed partly to friction and partly to the discrepancy, and a smooth
# discrepancy is a step over half a cycle rather than the true spike (figure). An error model widens
# intervals; it does not correct a wrong model. Leaving out one run at a time (``arviz.loo``)
# separates the error models. Importance sampling is inaccurate when a quarter of the data is left
# out (Pareto k above 0.7), but the differences are large.

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
    truth = "".join(f"{TRUTH[name]:15.4g}{'':11}" for name in names)
    print(f"{'truth':33}{truth.rstrip()}")
    print(f"bayesoleo {bo.__version__}, seed 0; to repeat:")
    print("BAYESOLEO_STORE_FIGURES=1 python studies/5_statistics/plot_oleo_posterior.py")


study.text("loo", leave_one_out)
figure_discrepancy = study.figure(
    "discrepancy", lambda: plots.predictive(trees["discrepancy"], "force")
)
