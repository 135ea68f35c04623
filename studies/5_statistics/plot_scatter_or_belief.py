r"""
Sampling distribution and posterior
===================================

A *sampling distribution* is how an estimate scatters when the experiment is repeated; a *posterior*
is what one experiment leaves to be believed. They answer different questions, and an engineer is
often shown one for the other. This page computes both, by replication and by sampling, where they
agree, where a prior parts them, and where their agreement proves nothing.
"""

# %%
# **Where they agree.** The gas spring of section 3.4.2, :math:`y = (1 - x)^{-\theta}`, a hundred
# samples with noise of :math:`2\sigma` = 1 % of full scale: four thousand repetitions on one side,
# draws given a single one of them on the other.

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
# The same shape, at different places: the scatter lies about the truth, which only a simulation
# knows; the posterior about the one estimate there is. Its width is the scatter's but for one
# thing: an experiment learns its noise from the same samples, and this one saw too little of it.
# With many good data it makes no difference which of the two is computed (Bernstein and von Mises),
# and the linearised covariance would have done.
#
# **Where the data are few.** Ten samples, much noise, and a pressure that trades off with the
# exponent. How wide the posterior is depends on the experiment, and shapes differ: one is a
# distribution of estimates at one truth, the other of truths at one estimate.

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
# **Where a prior parts them.** The spring again with noise a hundred times as large, and priors
# about 1.1 of any width; the truth is 1.2. A narrow prior makes the posterior narrow. It does not
# make MBE scatter less, whose fixed point knows no prior, and it makes the mode (BE) scatter *even
# less* than the posterior is wide: it hardly listens to the data. So the scatter of a Bayesian
# estimate is no measure of what is not known. On the right, how often the 95 % interval of the
# posterior holds *this* truth: not in 95 % unless the data decide. Over truths drawn from the prior
# it would at any width, which is what a Bayesian interval promises.

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
# **Where agreement proves nothing.** Both are computed from the model. If the model lacks
# something, here the factor 0.95 of the thesis, they agree with each other and on a wrong value;
# no repetition of the same experiment will tell. Runs under other conditions will
# (:doc:`/gallery/5_statistics/plot_sampling_distribution`), and so will the order of the residuals.

wide = [Normal(1.0, 0.1)]
lacking = FunctionProblem(lambda x, t: 0.95 * spring(x, t), position, exact, wide, ["n"])
point = estimate(lacking)
again = sampling_distribution(lacking, point, variance=[NOISE**2], replications=1000).data
away = abs(point["n"] - TRUTH) / float(again["sd"][0])
print(
    f"estimate {point['n']:.4f}, truth {TRUTH}: {away:.0f} standard deviations of the scatter away"
)
