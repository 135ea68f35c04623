r"""
A posterior with two modes
==========================

A narrow prior far from the data can give a posterior with two modes. This page samples such a
posterior :math:`p^*(\theta, v)`, that of the gas spring with an undeclared factor 0.95
(:doc:`../2_thesis/plot_gas_spring`). It has two parameters only, so quadrature gives the exact
result. The page checks the sampler, weighs the two modes, and compares estimate and posterior.
"""

# %%
# The same data, and the same two priors.

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from bayesoleo.estimation import FunctionProblem, multistart
from bayesoleo.model import Normal
from bayesoleo.plots import AFTER, BEFORE
from bayesoleo.posterior import LogDensity, compare, laplace_mixture, sample, to_datasets

TRUTH = 1.2
position = np.linspace(0.0, 0.9, 100)
noise = np.random.default_rng(0).normal(0.0, 0.005 * 10**TRUTH, position.size)
force = (1 - position) ** -TRUTH + noise


def assumed(x, theta):
    return 0.95 * (1 - x) ** -theta[0]


def sampled(problem, errors="independent", effective_size=4000):
    """Modes, density and draws."""
    modes = multistart(problem, 4, np.random.default_rng(1))
    density = LogDensity(problem, errors=errors)
    start = laplace_mixture(density, np.array([mode.theta for mode in modes]))
    draws = sample(density, start, effective_size=effective_size, seed=2, progress=False)
    return modes, density, draws


problems = {
    sd: FunctionProblem(assumed, position, force, [Normal(1.0, sd)], ["exponent"])
    for sd in (0.10, 0.01)
}
found = {sd: sampled(problem) for sd, problem in problems.items()}

# %%
# **Against quadrature.** The posterior on a fine grid of :math:`\theta` and :math:`\ln v`, summed
# up. The wide prior leaves one mode, the narrow one makes two: the exponent of the prior with much
# noise, and that of the data with little. A chain of small steps would never cross from one to the
# other. Here walkers start from both, and proposals come from the mixture of both. The standard
# errors follow from the effective sizes that the sampler reports.

exponents, log_v = np.linspace(0.97, 1.28, 1241), np.linspace(-6.5, 2.5, 721)


def quadrature(sd):
    """Probabilities of the grid's cells, (exponents, log variances): eq. 2.30, written out."""
    residual = force - 0.95 * (1 - position) ** -exponents[:, None]
    sums = np.sum(residual**2, axis=1)[:, None]
    heights = -0.5 * (position.size * log_v + sums * np.exp(-log_v))
    heights -= 0.5 * ((exponents[:, None] - 1.0) / sd) ** 2
    weights = np.exp(heights - heights.max())
    return weights / weights.sum()


def row(name, values, exact):
    """One line: sampled, its standard error, exact, and their distance in standard errors."""
    mean, error = values.mean(), values.std() / np.sqrt(size)
    print(f"{name:26}{mean:10.5f} ±{error:8.5f}{exact:10.5f}{(mean - exact) / error:8.1f}")


grids = {sd: quadrature(sd) for sd in problems}
BETWEEN = 1.14  # lies in the valley
print(f"{'':26}{'sampled':>10}{'':10}{'exact':>10}   off by (standard errors)")
for sd, (_, _, draws) in found.items():
    size = draws.effective_size.min()
    theta, u = draws.draws.reshape(-1, 2).T
    by_theta, by_u = grids[sd].sum(axis=1), grids[sd].sum(axis=0)
    mean = by_theta @ exponents
    row(f"prior ± {sd:.2f}: exponent", theta, mean)
    row("  its variance × 1e3", 1e3 * (theta - mean) ** 2, 1e3 * by_theta @ (exponents - mean) ** 2)
    row("  ln v", u, by_u @ log_v)
row("  part below 1.14", (theta < BETWEEN) * 1.0, by_theta[exponents < BETWEEN].sum())

# %%
# Left: the exact density in grey and draws in blue. Right: the marginal density of the exponent.
# With the narrow prior no mean and standard deviation describe the posterior, and its *mean* is
# improbable under both prior and data.

figure, panels = plt.subplots(2, 2, figsize=(10, 6.2), layout="constrained", width_ratios=(1.6, 1))
for (plane, marginal), (sd, (modes, _, draws)) in zip(panels, found.items(), strict=True):
    theta, u = draws.draws.reshape(-1, 2).T
    low, high = (1.19, 1.26) if sd == 0.10 else (1.0, 1.26)
    near = (exponents > low) & (exponents < high)
    drop = np.log(grids[sd].max() / np.maximum(grids[sd], 1e-300))[near].T
    plane.contourf(exponents[near], log_v, drop, [0, 0.5, 2, 4.5, 8], cmap="Greys_r", alpha=0.55)
    plane.plot(theta[::3], u[::3], ".", ms=1.5, color=AFTER)
    for mode in modes:
        plane.plot(mode["exponent"], np.log(mode.variance[0]), "k*", ms=11, mec="white")
    plane.axvline(TRUTH, color=BEFORE, lw=1)
    plane.set(xlim=(low, high), ylim=(-5.6, -3.4) if sd == 0.10 else (-5.8, 1.5), ylabel="ln v")
    plane.set_title(f"prior 1.0 ± {sd:.2f}", loc="left", fontsize=9)
    marginal.hist(theta, 150, range=(low, high), density=True, color="#8cbbd9", label="draws")
    step = exponents[1] - exponents[0]
    marginal.plot(
        exponents[near], grids[sd].sum(axis=1)[near] / step, "k", lw=1, label="quadrature"
    )
    marginal.axvline(TRUTH, color=BEFORE, lw=1, label="truth")
    marginal.set(xlim=(low, high), ylabel="density of the exponent")
    marginal.set_xlabel("exponent θ")
    marginal.legend(frameon=False, fontsize=8)

# %%
# **Weights of the modes.** The heights are not the weights: a lower but broader mode may contain
# more probability. Laplace's approximation includes the curvature of each mode and is nearly right
# here.

modes, density, draws = found[0.01]
places = np.array([mode.theta for mode in modes])
mixture = laplace_mixture(density, places)
height = np.exp([mode.objective - modes[0].objective for mode in modes])
parts = {
    "by their heights": height[places[:, 0] < BETWEEN].sum() / height.sum(),
    "by Laplace": mixture.weights[mixture.centres[:, 0] < BETWEEN].sum(),
    "by the draws": np.mean(draws.theta < BETWEEN),
    "by quadrature": grids[0.01].sum(axis=1)[exponents < BETWEEN].sum(),
}
for name, part in parts.items():
    print(f"part of the posterior below 1.14 {name:18}{part:.3f}")

# %%
# **Point against posterior**, the table that every result of ``bayesoleo sample`` holds: how far
# the posterior's mean lies from the estimate, how wide it is beside the linearised standard
# deviation, and how skewed. With the wide prior the estimate suffices. With the narrow one it
# describes only one of the two modes.


print(f"{'prior':>6}{'estimate':>10}{'sd':>9}{'shift':>8}{'sd ratio':>10}{'skewness':>10}")
for sd, (modes, density, draws) in found.items():
    groups = to_datasets(draws, problems[sd].priors, density=density)
    best = max(modes, key=lambda mode: mode.objective)
    table = compare(xr.DataTree.from_dict({**groups, "point": best.to_dataset()}))
    ratio = table["sd_ratio"].sel(reference="linearised").item()
    point = f"{sd:6.2f}{best['exponent']:10.4f}{best.sd[0]:9.4f}"
    print(f"{point}{table['shift'].item():8.2f}{ratio:10.2f}{table['skewness'].item():10.2f}")

# %%
# **The undeclared factor.** With the wide prior estimate and posterior agree, and both are wrong:
# the truth lies many standard deviations away, because the model is wrong. An error model with
# autocorrelated residuals does not find the factor. But it penalises a smooth misfit less, so the
# exponent is less biased, and its interval is wider and nearer to the truth. It still misses it.
# The remedy is to find the missing effect.

print("errors         95 % interval of the exponent   off by (sd)")
for word in ("independent", "correlated", "discrepancy"):
    theta = sampled(problems[0.10], word, 1000)[2].theta.ravel()
    low, high = np.quantile(theta, [0.025, 0.975])
    print(f"{word:14} {low:.4f} to {high:.4f} {(theta.mean() - TRUTH) / theta.std():22.1f}")
