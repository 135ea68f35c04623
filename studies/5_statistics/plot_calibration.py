r"""
Coverage of intervals
=====================

A 90 % interval should hold the truth in nine experiments of ten. Whether sampler and density are
right can be tested: draw the truth from the prior, simulate, sample the posterior, and rank the
truth among its draws. Over many replications the ranks are uniform (simulation-based calibration,
Talts et al. 2018). Whether the *model* is right cannot be tested so, and where an effect is missing
intervals promise too much: the second half of this page counts how much.
"""

# %%
# Ranks
# -----
#
# A gas spring, :math:`y = (1 - x)^{-\theta}`: its exponent and the logarithm of its variance are
# drawn from their priors, a hundred samples are simulated, and the posterior is sampled, fifty
# times.

# sphinx_gallery_thumbnail_number = -1
import matplotlib.pyplot as plt
import numpy as np

from bayesoleo.error_models import error_model
from bayesoleo.estimation import FunctionProblem
from bayesoleo.model import Normal
from bayesoleo.plots import Study
from bayesoleo.posterior import LogDensity, laplace_mixture, rank_of, sample, uniformity

position = np.linspace(0.0, 0.9, 100)
prior, log_variance_prior = Normal(1.0, 0.1), Normal(2 * np.log(0.0792), 0.5)


def ranks(seed):
    """Ranks of the exponent and the log variance of one simulated experiment."""
    rng = np.random.default_rng(seed)
    theta, log_v = prior.sample(rng, 1)[0], log_variance_prior.sample(rng, 1)[0]
    force = (1 - position) ** -theta + np.exp(0.5 * log_v) * rng.standard_normal(position.size)
    problem = FunctionProblem(lambda x, p: (1 - x) ** -p[0], position, force, [prior], ["exponent"])
    errors = error_model("independent", problem, log_variance_prior={"y": log_variance_prior})
    density = LogDensity(problem, 1, errors=errors)
    start = laplace_mixture(density, np.array([[theta]]))
    draws = sample(density, start, effective_size=400, seed=seed, progress=False)
    return rank_of(draws, [theta, log_v], rng)


found = np.array([ranks(seed) for seed in range(50)])

# %%
# The part of the ranks up to a place, less that of a uniform variable. A curve that stays inside
# its band is what chance makes of a right posterior; one that leans has a bias, one that is bent
# twice has the wrong width.

figure, panels = plt.subplots(1, 2, figsize=(9, 2.6), sharey=True, layout="constrained")
for axes, column, name in zip(panels, found.T, ("exponent", "log variance"), strict=True):
    test = uniformity(column)
    axes.fill_between(test.places, test.low, test.high, color="0.88", lw=0)
    axes.plot(test.places, test.difference, color="#0072b2", lw=1.4)
    axes.set(title=f"{name}, p = {test.p_value:.2g}", xlabel="rank of the truth")
panels[0].set_ylabel("part of the ranks − uniform")
plt.show()

# %%
# Two thousand of them take longer; these and the tables below are those of the commands that they
# name.

study = Study("calibration", needs=("calibration_figures",))
figures = study.helper("calibration_figures")
if study.live:
    for name in ("spring", "oleo", "oleo-weighted", "coverage"):
        print(f"{name:14}", figures.stored(name)["command"], sep="  ")
figure = study.run(lambda: figures.ranks_figure("spring"))

# %%
# The same of seven parameters and two variances of an oleo, four runs of a shaker campaign.

figure = study.run(lambda: figures.ranks_figure("oleo"))

# %%
# Each band holds 95 % of uniform ranks, so of nine quantities one or none may leave theirs by
# chance. Of the first 300 of these experiments the variance of the pressure did (p = 0.003); twice
# as many tell chance from a mistake. Weighted draws
# (:func:`~bayesoleo.posterior.importance_sample`) cost a tenth; of the same experiments and more,
# they test the density where walkers test the sampler too.

if study.live:
    figures.print_ranks()
figure = study.run(lambda: figures.ranks_figure("oleo-weighted"))

# %%
# An effect that nobody declared
# ------------------------------
#
# Parameters, the effect and its size are drawn anew in each replication: direction-dependent
# damping, a linear stiffness, Stribeck friction or a wall that stores heat, one as likely as
# another, of a size of half to four times the noise (rms of what it changes, in the output that
# shows it most; uniform in the logarithm). The posterior knows nothing of the effect.
#
# What can one ask of it? A parameter whose signature the effect bears stands for the sum of both:
# no assumption on errors tells them apart, and such a parameter does not keep its meaning. Which
# these are the model says, without data: the part of what an effect changes that lies along what
# only this parameter changes, cos² of the angle between them, is compared with that of smooth
# misfits by chance. Left out besides are parameters that an effect redefines: the heat conduction
# of a wall that stores heat, base and slope of a friction with a Stribeck peak.

if study.live:
    figures.print_imitation()

# %%
# How often the intervals hold the truth, and what that costs in width:

if study.live:
    figures.print_coverage()

# %%
# Filled: parameters that keep their meaning. Open: the others. Errors assumed independent count
# each sample as news. The others know that a residual which stays off is one error and not a
# hundred, and the last that several runs may show one error and not several.
#
# What is left of the misses has two places. Of a linear stiffness the parameters together take over
# 95 % (last column of the table above): an error model learns the size of the misfit from the
# twentieth that is left, and the initial volume is off by more than that. A wall that stores
# heat changes pressure and force as volume and solubility of the gas do, in both outputs at once
# and with no curve that the runs share. What the parameters have taken over is not in the residual,
# and no error model sees it: so it pays to look for the effect first.

figure = study.run(lambda: figures.coverage_figure())
