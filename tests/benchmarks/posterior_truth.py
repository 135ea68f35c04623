"""Our draws against quadrature, and against another kind of sampler."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from posterior_cases import Case, gas_spring_case, oleo_case
from posterior_gas_spring import quadrature

from bayesoleo.posterior import Samples, sample

Array = NDArray[np.float64]
TAILS = (0.025, 0.16, 0.84, 0.975)


def z_of_parts(found: Array, expected: Array, size: Array) -> Array:
    """Parts of the draws against probabilities, in standard errors of ``size`` effective draws."""
    return (found - expected) / np.sqrt(expected * (1 - expected) / size)


def z_scores(samples: Samples, draws: Array, weights: Array) -> dict[str, float]:
    """Largest differences of means, standard deviations and tails from weighted draws (M, d).

    Each over the standard error of the difference; kurtosis enters that of a standard deviation.
    """
    flat = samples.draws.reshape(-1, samples.draws.shape[-1])
    size, other = samples.effective_size, 1 / np.sum(weights**2)
    mean = weights @ draws
    sd = np.sqrt(weights @ (draws - mean) ** 2)
    fourth = weights @ ((draws - mean) / sd) ** 4
    both = 1 / size + 1 / other
    order = np.argsort(draws, axis=0)
    tails = []
    for part in TAILS:
        edges = np.array(
            [
                np.interp(part, np.cumsum(weights[order[:, a]]), draws[order[:, a], a])
                for a in range(draws.shape[1])
            ]
        )
        below = np.mean(flat <= edges, axis=0)
        tails.append((below - part) / np.sqrt(part * (1 - part) * both))
    return {
        "mean": float(np.max(np.abs(flat.mean(axis=0) - mean) / sd / np.sqrt(both))),
        "sd": float(np.max(np.abs(flat.std(axis=0) / sd - 1) / np.sqrt((fourth - 1) / 4 * both))),
        "tails": float(np.max(np.abs(tails))),
    }


def grid(case: Case, low: float, high: float) -> tuple[Array, Array]:
    """Points (M, 2) of theta and ln v, and their probabilities, by the density's definition."""
    theta, log_v = np.linspace(low, high, 1601), np.linspace(-6.5, 2.5, 1201)
    density = quadrature(case.density.problem, theta, log_v)
    points = np.stack([np.repeat(theta, log_v.size), np.tile(log_v, theta.size)], axis=1)
    return points, density.ravel() / density.sum()


def spring(relative_sd: float, low: float, high: float) -> dict[str, float]:
    """Moments and tails of the gas spring's posterior, and the mode near the prior."""
    case = gas_spring_case(relative_sd)
    found = sample(case.density, case.mixture, effective_size=20_000, seed=2, progress=False)
    points, weights = grid(case, low, high)
    # The grid is exact: as if of infinitely many draws.
    z = _exact(found, points, weights)
    if relative_sd < 0.05:
        near = float(weights @ (points[:, 0] < 1.13))
        part = float(np.mean(found.draws[:, :, 0] < 1.13))
        size = float(found.effective_size.min())
        z["mode"] = abs(float(z_of_parts(np.array(part), np.array(near), np.array(size))))
        z |= {"mode_weight": part, "mode_weight_exact": near}
    return z


def _exact(found: Samples, points: Array, weights: Array) -> dict[str, float]:
    flat, size = found.draws.reshape(-1, 2), found.effective_size
    mean = weights @ points
    sd = np.sqrt(weights @ (points - mean) ** 2)
    fourth = weights @ ((points - mean) / sd) ** 4
    tails = []
    for part in TAILS:
        for a in range(2):
            values, where = np.unique(points[:, a], return_inverse=True)
            mass = np.bincount(where, weights)
            below = np.cumsum(mass) - mass / 2  # of a cell, half lies below its point
            edge = np.interp(part, below, values)
            z = z_of_parts(np.mean(flat[:, a] <= edge), np.array(part), size[a])
            tails.append(abs(float(z)))
    return {
        "mean": float(np.max(np.abs(flat.mean(axis=0) - mean) / sd * np.sqrt(size))),
        "sd": float(np.max(np.abs(flat.std(axis=0) / sd - 1) / np.sqrt((fourth - 1) / 4 / size))),
        "tails": max(tails),
    }


def oleo() -> dict[str, float]:
    """The campaign's posterior against dynesty's nested sampling of the same log density."""
    try:
        import dynesty
    except ImportError:
        return {}
    case = oleo_case()
    mode, covariance = case.mixture.centres[0], case.mixture.covariances[0]
    factor = np.linalg.cholesky(covariance)
    width = 7.0  # standard deviations either side; no draw of ours comes near that

    def inside(cube: Array) -> Array:
        return mode + factor @ (width * (2 * cube - 1))

    # Nested sampling asks for one row at a time.
    sampler = dynesty.NestedSampler(
        lambda phi: float(case.density(phi[None])[0][0]),
        inside,
        case.dimension,
        nlive=400,
        sample="unif",
        rstate=np.random.default_rng(5),
    )
    sampler.run_nested(print_progress=False, dlogz=0.2)
    results = sampler.results
    weights = np.exp(results.logwt - results.logz[-1])
    found = sample(case.density, case.mixture, effective_size=8000, seed=3, progress=False)
    natural = case.density.natural(results.samples)
    z = z_scores(found, natural, weights / weights.sum())
    return {**z, "dynesty_evaluations": int(np.sum(results.ncall))}


def truth_figures() -> dict[str, float]:
    """All z, and the largest of them."""
    parts = {
        "z_spring_wide": spring(0.1, 0.9, 1.35),
        "z_spring_bimodal": spring(0.01, 0.9, 1.35),
        "z_oleo_dynesty": oleo(),
    }
    flat = {f"{name}_{key}": value for name, z in parts.items() for key, value in z.items()}
    largest = [
        z[key] for z in parts.values() for key in ("mean", "sd", "tails", "mode") if key in z
    ]
    return {**flat, "max_z_against_reference": max(largest)}
