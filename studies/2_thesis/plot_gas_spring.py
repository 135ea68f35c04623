r"""
A gas spring with a model error
===============================

A narrow prior states that a parameter is well known. If the model is wrong, the classical Bayesian
estimator trusts the prior, takes the difference for noise, and stays near its start. The modified
Bayesian estimator (MBE) uses the prior only to scale its steps, and reaches the maximum of the
likelihood. This page repeats the numerical experiment of Verbeek (1993), section 3.4.2.
"""

# %%
# The measured force of an ideal gas spring is :math:`y = (1 - x)^{-\theta}` with :math:`\theta =
# 1.2` and noise of :math:`2\sigma` = 1 % of full scale. The model that is fitted to it has a
# factor 0.95 in front, as if the initial pressure had been read 5 % too low. The prior is centred
# on 1.0, where every estimate starts, with a standard deviation of 0.1 or of 0.01.

import matplotlib.pyplot as plt
import numpy as np

from bayesoleo.error_models import log_likelihood, output_counts, staged_variance
from bayesoleo.estimation import FunctionProblem, estimate, log_posterior, log_prior, multistart
from bayesoleo.model import Normal

position = np.linspace(0.0, 0.9, 100)
rng = np.random.default_rng(0)
force = (1 - position) ** -1.2 + rng.normal(0.0, 0.005 * 10**1.2, position.size)


def assumed(x, theta):
    return 0.95 * (1 - x) ** -theta[0]


problems = {
    sd: FunctionProblem(assumed, position, force, [Normal(1.0, sd)], ["exponent"])
    for sd in (0.10, 0.01)
}

figure, axes = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
axes.plot(position, force, ".", color="0.55", label="measured")
axes.plot(position, (1 - position) ** -1.2, "k", lw=1, label="exact: $(1-x)^{-1.2}$")
axes.plot(position, assumed(position, [1.2]), "--", color="#7a5195", label="assumed, same exponent")
axes.plot(position, assumed(position, [1.0]), ":", color="#7a5195", label="assumed, at the start")
axes.set(xlabel="displacement x", ylabel="force y", title="An ideal gas spring (cf. figure 3.1)")
axes.legend(frameon=False)

# %%
# Four estimators from the same start. BE is the Bayesian estimator; MVE, MMVE and MBE move or
# rescale the prior in every iteration, so that it no longer decides where they end.

METHODS = ("be", "mve", "mmve", "mbe")
points = {
    sd: {name: estimate(problem, name, tolerance=1e-4) for name in METHODS}
    for sd, problem in problems.items()
}
print("prior sd  method  iterations  exponent  log10 v   status")
for sd, found in points.items():
    for name, point in found.items():
        print(
            f"{sd:8.2f}  {name.upper():6}  {point.iterations:10d}  {point['exponent']:8.4f}"
            f"  {np.log10(point.variance[0]):7.2f}   {point.status.message}"
        )

# %%
# With the wide prior all agree. With the narrow prior BE converges to an exponent near the prior,
# with far too much noise. MVE stalls: its steps shrink as the reciprocal of the iteration, and a
# test of their size alone would report convergence. Its status is right, because the distance to
# the fixed point is tested too.
#
# BE has not failed as an optimiser. The posterior has two modes, and BE found the nearer one:

narrow = problems[0.01]
modes = multistart(narrow, 4, np.random.default_rng(1))
for mode in modes:
    print(
        f"mode at exponent {mode['exponent']:.4f}, log10 v = {np.log10(mode.variance[0]):.2f},"
        f" log posterior {mode.objective:.1f}"
    )

# %%
# The figure shows the log posterior :math:`\Phi_B(\theta, v)`, dark where it is high, and the path
# of each estimator, as in figures 3.2 and 3.3. On the right BE ends at the upper mode. The others
# pass it and reach the maximum of the likelihood, close to the lower mode. From there a few steps
# of BE reach that mode, which the package reports as the estimate.
# :doc:`../5_statistics/plot_two_modes` weighs the modes against each other.


def height(problem, exponents, log_v):
    """Log posterior over a grid, below its highest value."""
    sums = problem.misfit(exponents[:, None]).sum_of_squares[:, 0]
    counts = output_counts(problem.counts)
    values = np.array(
        [
            [log_posterior(m, np.array([10**u]), counts, problem.priors, [t]) for u in log_v]
            for t, m in zip(exponents, sums, strict=True)
        ]
    )
    return values - values.max()


exponents, log_v = np.linspace(0.97, 1.28, 156), np.linspace(-2.6, 1.0, 145)
COLOURS = {"be": "#d55e00", "mve": "#e69f00", "mmve": "#009e73", "mbe": "#0072b2"}
SIZES = {"be": 9, "mve": 7, "mmve": 5, "mbe": 3}
levels = np.array([0, 0.5, 2, 8, 20, 50, 100, 200, 400, 1000])
greys = plt.get_cmap("Greys_r")(np.linspace(0.62, 0.98, levels.size - 1))
figure, panels = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
for axes, (sd, found) in zip(panels, points.items(), strict=True):
    drop = -height(problems[sd], exponents, log_v).T
    axes.contourf(exponents, log_v, drop, levels, colors=greys)
    axes.contour(exponents, log_v, drop, levels[1:], colors="white", linewidths=0.7)
    for name, point in found.items():
        colour, size = COLOURS[name], SIZES[name]
        path = point.history[:, 0], np.log10(point.history_variance[:, 0])
        axes.plot(*path, "o-", ms=size, lw=size / 2.5, color=colour, label=name.upper())
    for mode in multistart(problems[sd], 4, np.random.default_rng(1)):
        place = mode["exponent"], np.log10(mode.variance[0])
        axes.plot(*place, "k*", ms=13, mec="white", zorder=5)
        axes.annotate("mode", place, (10, 8), textcoords="offset points")
    axes.set(title=f"prior 1.0 ± {sd:.2f}", xlabel="exponent θ")
panels[0].set_ylabel("log₁₀ v")
panels[0].legend(frameon=False, loc="lower left")

# %%
# Every one of these points lies on the *solution path*: the variance is staged, so that it is the
# best one for its exponent. Along this path the likelihood has one maximum, but the posterior with
# the narrow prior has two (left, stars). The right panel shows the distance of each estimator from
# the final estimate, as in figure 3.4. MVE shrinks its steps until it hardly moves. MMVE and MBE
# differ only in the first steps, which are shorter for MBE.

counts = output_counts(narrow.counts)
sums = narrow.misfit(exponents[:, None]).sum_of_squares[:, 0]
variances = [staged_variance(total, counts) for total in sums]
likelihood = np.array([log_likelihood(m, v, counts) for m, v in zip(sums, variances, strict=True)])
posterior = likelihood + [log_prior(narrow.priors, [t]) for t in exponents]

figure, (path, pace) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
top = likelihood.max()
path.plot(exponents, likelihood - top, color="0.4", lw=1, label="log likelihood")
path.plot(exponents, posterior - top, "--", color="0.4", lw=1, label="log posterior")
for mode in modes:
    path.plot(mode["exponent"], mode.objective - top, "k*", ms=12, mec="white", zorder=5)
best = estimate(narrow, "mbe")
sd = np.sqrt(best.covariance_likelihood[0, 0])
for name in ("mve", "mmve", "mbe"):
    steps = points[0.01][name].history[:, 0]
    style = {"color": COLOURS[name], "ms": SIZES[name], "label": name.upper()}
    path.plot(steps, np.interp(steps, exponents, likelihood - top), "o", **style)
    left = abs(steps - best["exponent"]) / sd
    pace.semilogy(np.maximum(left, 1e-4), "o-", **style)
path.set(xlabel="exponent θ", ylabel="below the highest likelihood", ylim=(-340, 15))
path.legend(frameon=False, loc="upper left")
pace.axhline(1, color="0.7", lw=0.8)
pace.set(xlabel="iteration", ylabel="distance left, in standard deviations", ylim=(1e-4, None))
