r"""
Coverage of intervals
=====================

A 90 % interval should contain the truth in nine of ten experiments. This can be tested: draw the
truth from the prior, simulate, sample the posterior, and rank the truth among its draws. Over many
replications the ranks are uniform if sampler and density are right (simulation-based calibration,
Talts et al. 2018). The test says nothing about the *model*. If an effect is missing, intervals are
too narrow; the second half of this page measures by how much.
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
from bayesoleo.gallery import Study
from bayesoleo.model import Normal
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
# The distribution function of the ranks minus the uniform one. A right posterior gives a curve
# within the band. A curve on one side of zero shows a bias, a curve that changes sides a wrong
# width.

figure, panels = plt.subplots(1, 2, figsize=(9, 2.6), sharey=True, layout="constrained")
for axes, column, name in zip(panels, found.T, ("exponent", "log variance"), strict=True):
    test = uniformity(column)
    axes.fill_between(test.places, test.low, test.high, color="0.88", lw=0)
    axes.plot(test.places, test.difference, color="#0072b2", lw=1.4)
    axes.set(title=f"{name}, p = {test.p_value:.2g}", xlabel="rank of the truth")
panels[0].set_ylabel("part of the ranks − uniform")
plt.show()

# %%
# Two thousand replications take longer. Their results, and the tables below, come from the commands
# listed here.

study = Study("calibration", needs=("calibration_figures",))
figures = study.helper("calibration_figures")
if study.live:
    for name in ("spring", "oleo", "oleo-weighted", "coverage"):
        print(f"{name:14}", figures.stored(name)["command"], sep="  ")
figure = study.run(lambda: figures.ranks_figure("spring"))

# %%
# The same for an oleo (the shock strut of an aircraft): seven parameters and two variances, four
# runs of a shaker campaign.

figure = study.run(lambda: figures.ranks_figure("oleo"))

# %%
# Each band contains 95 % of uniform ranks, so of nine quantities one or none may leave it by
# chance. In the first 300 experiments the variance of the pressure did (p = 0.003); twice as many
# show whether that was chance. Weighted draws (:func:`~bayesoleo.posterior.importance_sample`) cost
# a tenth. They test the density alone; the walkers test the sampler too.

if study.live:
    figures.print_ranks()
figure = study.run(lambda: figures.ranks_figure("oleo-weighted"))

# %%
# A missing effect
# ----------------
#
# Parameters, the effect and its size are drawn anew in each replication: direction-dependent
# damping, a linear stiffness, Stribeck friction or a wall that stores heat, one as likely as
# another, of a size of half to four times the noise (rms of what it changes, in the output that
# shows it most; uniform in the logarithm). The fitted model does not contain the effect.
#
# If an effect and a parameter change the outputs in the same way, the estimate is the sum of both.
# No assumption on errors separates them, and the parameter does not keep its meaning. The model
# alone shows which parameters these are: cos² of the angle between the change by the effect and the
# change by this parameter only is compared with that of random smooth misfits. Parameters that an
# effect redefines are left out too: the heat conduction of a wall that stores heat, and base and
# slope of a friction with a Stribeck peak.

if study.live:
    figures.print_imitation()

# %%
# How often the intervals contain the truth, and how wide they are:

if study.live:
    figures.print_coverage()

# %%
# Filled: parameters that keep their meaning. Open: the others. Independent errors count each sample
# as new information. The other error models treat a persistent residual as one error, and the last
# one lets several runs share one error.
#
# Two effects cause the remaining misses. The parameters together absorb 95 % of a linear stiffness
# (last column of the table above). The error model learns the size of the misfit from the remaining
# twentieth, but the initial volume errs by more. A wall that stores heat changes pressure and force
# as volume and solubility of the gas do, in both outputs at once and differently in each run. An
# absorbed effect is not in the residual, and no error model sees it. It is therefore better to find
# the effect first.

figure = study.run(lambda: figures.coverage_figure())
