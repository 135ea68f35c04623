r"""
Sampling distribution and posterior
===================================

A *sampling distribution* is the scatter of an estimate when the experiment is repeated. A
*posterior* is the probability of the parameters given one experiment. The two answer different
questions and are often confused. This page computes both by simulation: in a case where they agree,
in one where a prior separates them, and in one where their agreement proves nothing.
"""

# %%
# **Agreement.** The gas spring of Verbeek (1993), section 3.4.2, :math:`y = (1 - x)^{-\theta}`, has
# a hundred samples with noise of :math:`2\sigma` = 1 % of full scale. Four thousand repetitions are
# compared with draws of the posterior of a single one.

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from scipy import stats

from bayesoleo.estimation import FunctionProblem, estimate, polish, sampling_distribution
from bayesoleo.model import Normal
from bayesoleo.plots import AFTER, BEFORE
from bayesoleo.posterior import LogDensity, compare, laplace_mixture, sample, to_datasets

NOISE, TRUTH = 0.005 * 10**1.2, 1.2
position = np.linspace(0.0, 0.9, 100)


def both(problem, truth, noise, seed=1):
    """Repeat the experiment, and sample the posterior of one; the tree holds both."""
    repeated = sampling_distribution(problem, truth, variance=[noise**2], replications=4000)
    y = problem.predict(truth)
    once = problem.with_data([y + np.random.default_rng(seed).normal(0.0, noise, y.size)])
    mode = polish(once, estimate(once))
    density = LogDensity(once)
    start = laplace_mixture(density, mode.theta[None])
    draws = sample(density, start, effective_size=1500, seed=seed, progress=False)
    groups = to_datasets(draws, once.priors, density=density)
    groups |= {"point": mode.to_dataset(), "sampling_distribution": repeated.data}
    return xr.DataTree.from_dict(groups)


def show(tree, noise):
    """Widths and skewness of both, side by side."""
    found, repeated = compare(tree), tree["sampling_distribution"].to_dataset()
    ratio = found["sd_ratio"].sel(reference="monte carlo")
    print("parameter   posterior sd / scatter   skewness of posterior   of scatter")
    for k, name in enumerate(found["parameter"].values):
        skewness = stats.skew(repeated["replicate"].values[:, k])
        print(
            f"{name:10}{ratio.values[k]:14.2f}{found['skewness'].values[k]:25.2f}{skewness:18.2f}"
        )
    spread = np.quantile(np.sqrt(repeated["variance"].values[:, 0]) / noise, [0.05, 0.95])
    print("noise as nine of ten experiments see it: {:.2f} to {:.2f} of what it is".format(*spread))


def spring(x, theta):
    return (1 - x) ** -theta[0]


exact = spring(position, [TRUTH])
problem = FunctionProblem(spring, position, exact, [Normal(1.0, 0.1)], ["exponent"])
good = both(problem, [TRUTH], NOISE)
show(good, NOISE)

# %%
# Both have the same shape at different places. The scatter lies about the truth, which only a
# simulation knows; the posterior lies about the one estimate. The widths differ slightly, because
# an experiment estimates its noise from the same samples, and here that estimate is low. With many
# good data the two agree (Bernstein and von Mises), and the linearised covariance suffices.
#
# **Few data.** Ten samples, much noise, and a pressure that is correlated with the exponent. The
# width of the posterior depends on the experiment, and the shapes differ: one is a distribution of
# estimates for one truth, the other a distribution of truths for one estimate.

short = np.linspace(0.0, 0.9, 10)
pair = FunctionProblem(
    lambda x, t: t[0] * (1 - 0.95 * x) ** -t[1],
    short,
    (1 - 0.95 * short) ** -TRUTH,
    [Normal(1.0, 0.5), Normal(1.2, 0.5)],
    ["pressure", "exponent"],
)
poor = both(pair, [1.0, TRUTH], 1.5)
show(poor, 1.5)

figure, panels = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
cases = ((good, "exponent", TRUTH), (poor, "pressure", 1.0), (poor, "exponent", TRUTH))
for axes, (tree, name, truth) in zip(panels, cases, strict=True):
    repeated = tree["sampling_distribution"].to_dataset()["replicate"].sel(parameter=name)
    belief = tree["posterior"][name].values.ravel()
    span = np.quantile(np.concatenate([repeated, belief]), [0.001, 0.999])
    axes.hist(repeated, 45, range=span, density=True, color="0.75", label="estimates, repeated")
    axes.hist(
        belief, 45, range=span, density=True, histtype="step", color=AFTER, lw=1.3,
        label="posterior of one",
    )  # fmt: skip
    axes.axvline(truth, color=BEFORE, lw=1, label="truth")
    axes.set(xlabel=name, yticks=[])
panels[0].set_title("100 good samples", fontsize=10)
panels[1].set_title("10 poor samples", fontsize=10)
panels[0].legend(frameon=False, fontsize=7, loc="upper right")

# %%
# **Influence of the prior.** The spring again with a hundred times the noise, and priors about 1.1
# of different widths; the truth is 1.2. A narrow prior makes the posterior narrow. It does not
# reduce the scatter of MBE, whose fixed point does not depend on the prior. The mode (BE) scatters
# *even less* than the posterior is wide, because it depends little on the data. So the scatter of a
# Bayesian estimate does not measure its uncertainty. The right panel shows how often the 95 %
# interval of the posterior contains *this* truth: in 95 % only if the data dominate. Over truths
# drawn from the prior it would be 95 % at any width, as a Bayesian interval promises.

rough, centre = 100 * NOISE, 1.1


def repeated(width, method):
    """Estimates from a thousand experiments."""
    prior = [Normal(centre, width)]
    weak = FunctionProblem(spring, position, exact, prior, ["exponent"])
    found = sampling_distribution(
        weak, [TRUTH], variance=[rough**2], replications=1000, method=method
    )
    return found.data["replicate"].values[:, 0]


scatter = np.std(repeated(1.0, "mbe"))
widths = np.array([0.02, 0.035, 0.06, 0.1, 0.2, 0.5])
modes = np.array([repeated(width, "be") for width in widths])
belief = (scatter**-2 + widths**-2) ** -0.5
inside = np.mean(np.abs(modes - TRUTH) < 1.96 * belief[:, None], axis=1)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.3), layout="constrained")
left.loglog(widths, np.full(widths.size, scatter), "k--", label="scatter of MBE")
left.loglog(widths, belief, "o-", color=AFTER, label="posterior sd")
left.loglog(widths, modes.std(axis=1), "s-", color=BEFORE, label="scatter of BE")
left.loglog(widths, belief**2 / scatter, ":", color=BEFORE, label="as theory says")
left.set(xlabel="sd of the prior", ylabel="standard deviation")
left.legend(frameon=False, fontsize=8)
right.semilogx(widths, 100 * inside, "o-", color=AFTER)
right.axhline(95, color="0.6", lw=0.8)
right.set(xlabel="sd of the prior", ylabel="intervals that hold 1.2, %", ylim=(0, 102))
for axes in (left, right):
    axes.set_xticks(widths, [f"{width:g}" for width in widths])
    axes.minorticks_off()

# %%
# **Agreement on a wrong value.** Both are computed from the model. If the model lacks an effect,
# here the factor 0.95 of the thesis, both agree on a wrong value. Repetition of the same experiment
# does not reveal it. Runs under other conditions do
# (:doc:`/gallery/5_statistics/plot_sampling_distribution`), and so does the order of the residuals.

wide = [Normal(1.0, 0.1)]
lacking = FunctionProblem(lambda x, t: 0.95 * spring(x, t), position, exact, wide, ["n"])
point = estimate(lacking)
again = sampling_distribution(lacking, point, variance=[NOISE**2], replications=1000).data
away = abs(point["n"] - TRUTH) / float(again["sd"][0])
print(
    f"estimate {point['n']:.4f}, truth {TRUTH}: {away:.0f} standard deviations of the scatter away"
)
