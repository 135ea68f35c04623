"""Coverage of 90 % intervals where an effect is missing: one replication, and what is made of many.

Parameters are drawn from their priors, the effect is one of four with equal probability, its size
is uniform in the logarithm, and its shape, where it has one, within its scan's range. The same
experiment is fitted under each error model, by a model that knows nothing of the effect.

**Parameters that keep their meaning.** A parameter whose signature an effect bears stands for both
when the effect is missing: its estimate is right about the sum, and wrong about the parameter,
whatever is assumed of errors. Which these are is decided by the model alone, before any data. Let
``d`` be what the effect changes at the priors' means, over the noise, and ``j`` what the
parameter changes and no combination of the others does (its sensitivity, made orthogonal to the
others', which their priors hold). The parameter takes over ``d'j / j'j``, so that the part of the
effect along its own direction is ``cos^2(d, j)``. Misfits that have nothing to do with the
parameter have such a part too: a function of phase drawn from the discrepancy's prior, a tenth of
a cycle long, in each run and output. Where the effect's part, mean over its shapes, exceeds what
95 % of those have, the effect imitates the parameter. Left out besides are parameters that the
effect redefines (:data:`calibration_oleo.EFFECTS`). What is left out is counted and printed as
well.
"""

from __future__ import annotations

from functools import cache

import calibration_oleo as campaign
import numpy as np
from numpy.typing import NDArray

from bayesoleo.error_models import basis, spectrum
from bayesoleo.posterior import LogDensity, importance_sample, laplace_mixture, sample as draw

Arrays = dict[str, NDArray]
#: Ninety-per-cent intervals.
TAILS = (0.05, 0.95)
#: Effective draws from which their ends are taken: of 200, 5 % lie beyond an end give or take 1.5.
ENDS = 200.0
#: Of chance misfits: length in cycles, how many, and the part of them that a direction must exceed.
LENGTH, CHANCE, LEVEL = 0.1, 2000, 0.95
#: Shapes of an effect over which its part is averaged.
SHAPES = 20


def experiment(number: int, seed: int):
    """Problem with data, true parameters, number of the effect and its size."""
    rng = campaign.generator(seed, number)
    effects = list(campaign.EFFECTS)
    index = int(rng.integers(len(effects)))
    size = float(np.exp(rng.uniform(*np.log(campaign.SIZES))))
    for _ in range(50):
        theta, _ = campaign.drawn(rng)
        outputs = campaign.with_effect(effects[index], theta, size, rng)
        if outputs is not None:
            break
    else:
        raise RuntimeError(f"no answer of {effects[index]} in fifty draws")
    base = campaign.declared().problem
    problem = base.with_data(campaign.noisy(outputs, campaign.NOISE, rng))
    problem.freeze(theta)
    return problem, theta, index, size


def replication(word: str, number: int, seed: int) -> Arrays:
    """Intervals of the parameters under an error model; the experiment does not depend on it."""
    problem, theta, effect, size = experiment(number, seed)
    low, high, weighted, reached = _ends(LogDensity(problem, 1, errors=word), theta, seed + number)
    return {
        "low": low, "high": high, "truth": theta, "size": np.array(size),
        "effect": np.array(effect), "weighted": np.array(weighted), "reached": np.array(reached),
    }  # fmt: skip


def _ends(density: LogDensity, theta, seed: int):
    """Ends of the intervals, (l,) each; whether by weights, and whether well enough.

    Weighted draws from the mixture do where they are worth so many; elsewhere walkers go.
    """
    mixture = laplace_mixture(density, theta[None])
    for draws, rounds in ((500, 8), (3000, 4)):
        weighted = importance_sample(
            density, mixture, seed=seed, effective_size=ENDS, draws=draws, rounds=rounds
        )
        if weighted.reached:
            low, high = weighted.quantiles(TAILS)[:, : theta.size]
            return low, high, True, True
    samples = draw(
        density, mixture, effective_size=ENDS, seed=seed, quick=True, progress=False,
        max_evaluations=40_000,
    )  # fmt: skip
    low, high = np.quantile(samples.theta.reshape(-1, theta.size), TAILS, axis=0)
    return low, high, False, samples.reached


def sensitivities() -> NDArray:
    """What parameters change over the noise, by prior sd, (n, l), at the priors' means."""
    problem = campaign.declared().problem
    sd = np.array([prior.sd for prior in problem.priors])
    problem.freeze(problem.start)
    found = problem.evaluate(problem.start)
    scaled = zip(found.sensitivity, campaign.NOISE.values(), strict=True)
    return np.concatenate([part / noise for part, noise in scaled]) * sd


def own_directions() -> NDArray:
    """Unit vectors of what each parameter alone changes, (l, n)."""
    columns, directions = sensitivities(), []
    for a, column in enumerate(columns.T):
        others = np.delete(columns, a, axis=1)
        # Their priors, one standard deviation each, are data of their own.
        held = np.concatenate([others, np.eye(others.shape[1])])
        target = np.concatenate([column, np.zeros(others.shape[1])])
        rest = column - others @ np.linalg.lstsq(held, target, rcond=None)[0]
        directions.append(rest / np.linalg.norm(rest))
    return np.array(directions)


def taken_over(misfits: NDArray) -> NDArray:
    """Parts of unit vectors (k, n) that all parameters together take over, (k,).

    For misfits of the sizes' geometric mean: priors hold parameters back from small ones.
    """
    columns = sensitivities()
    samples = len(columns) / len(campaign.NOISE)
    scaled = misfits * np.sqrt(np.prod(campaign.SIZES) * samples)
    inner = columns.T @ columns + np.eye(columns.shape[1])
    rest = scaled - (columns @ np.linalg.solve(inner, columns.T @ scaled.T)).T
    return 1 - np.sum(rest**2, axis=1) / np.sum(scaled**2, axis=1)


def changed_by(effect: str, rng: np.random.Generator) -> NDArray:
    """What an effect of a shape that is drawn changes, over the noise, as a unit vector (n,)."""
    simulator = campaign.declared()
    start, noise = simulator.problem.start, campaign.NOISE.values()
    plain, found = simulator.outputs(start), campaign.with_effect(effect, start, 0.5, rng)
    parts = [(a - b) / sd for a, b, sd in zip(found, plain, noise, strict=True)]
    return np.concatenate(parts) / np.linalg.norm(np.concatenate(parts))


@cache
def imitation() -> tuple[NDArray, NDArray]:
    """Parts of effects along each parameter's own direction, and along all, (effects, l + 1).

    And those that 95 % of chance misfits do not exceed, (l + 1,).
    """
    own, rng = own_directions(), np.random.default_rng(0)
    tables = [basis(run.phase) for run in campaign.declared().problem.samples]
    root = np.sqrt(spectrum(np.array([LENGTH]))[0])
    parts = []
    for _ in range(len(campaign.NOISE)):
        for table in tables:
            parts.append((rng.standard_normal((CHANCE, root.size)) * root) @ table.T)
    misfits = np.concatenate(parts, axis=1)
    misfits /= np.linalg.norm(misfits, axis=1)[:, None]
    found = [_parts(misfits, own)]
    for name in campaign.EFFECTS:
        found.append(_parts(np.array([changed_by(name, rng) for _ in range(SHAPES)]), own))
    return np.array([part.mean(axis=0) for part in found[1:]]), np.quantile(found[0], LEVEL, axis=0)


def _parts(misfits: NDArray, own: NDArray) -> NDArray:
    return np.column_stack([(misfits @ own.T) ** 2, taken_over(misfits)])


@cache
def keeps_meaning() -> NDArray:
    """Which parameters do beside which effect, (effects, l) of bool."""
    parts, chance = imitation()
    names = campaign.declared().problem.names
    redefined = [[name in given for name in names] for given in campaign.EFFECTS.values()]
    return (parts <= chance)[:, :-1] & ~np.array(redefined)


def table_of(found: dict[str, list[Arrays]]) -> dict[str, object]:
    """Coverage and median width over the prior's sd, each parameter and pooled, by error model."""
    problem = campaign.declared().problem
    parts, chance = imitation()
    table: dict[str, object] = {
        "names": list(problem.names),
        "effects": list(campaign.EFFECTS),
        "imitation": np.round(parts[:, :-1], 4).tolist(),
        "imitation_by_chance": np.round(chance[:-1], 4).tolist(),
        "taken_over": np.round(parts[:, -1], 4).tolist(),
        "taken_over_by_chance": round(float(chance[-1]), 4),
        "keeps_meaning": keeps_meaning().tolist(),
    }
    sd = np.array([prior.sd for prior in problem.priors])
    for word, items in found.items():
        table[word] = _of_model(items, sd)
    return table


def _of_model(items: list[Arrays], sd: NDArray) -> dict[str, object]:
    low, high, truth = (np.array([item[key] for item in items]) for key in ("low", "high", "truth"))
    covers, width = (low <= truth) & (truth <= high), (high - low) / sd
    effect = np.array([int(item["effect"]) for item in items])
    keep, each = keeps_meaning()[effect], range(len(sd))
    # Parameters of one replication share its effect: replications are the independent units.
    share, weight = (covers & keep).sum(axis=1), keep.sum(axis=1)
    pooled = share.sum() / weight.sum()
    error = np.sqrt(np.sum((share - pooled * weight) ** 2)) / weight.sum()
    return {
        "each": [_mean(covers[keep[:, a], a]) for a in each],
        "each_left_out": [_mean(covers[~keep[:, a], a]) for a in each],
        "each_all": [_mean(covers[:, a]) for a in each],
        "pooled": _mean(covers[keep]),
        "pooled_standard_error": round(float(error), 4),
        "pooled_left_out": _mean(covers[~keep]),
        "pooled_all": _mean(covers),
        "by_effect": [
            _mean(covers[effect == e][keep[effect == e]]) for e in range(len(campaign.EFFECTS))
        ],
        "by_effect_and_parameter": [
            [_mean(covers[effect == e, a]) for a in each] for e in range(len(campaign.EFFECTS))
        ],
        "median_width_over_prior_sd": np.round(np.median(width, axis=0), 4).tolist(),
        "pooled_width_over_prior_sd": round(float(np.median(width[keep])), 4),
        "weighted": int(sum(bool(item["weighted"]) for item in items)),
        "reached": int(sum(bool(item["reached"]) for item in items)),
    }


def _mean(values: NDArray) -> float | None:
    return round(float(values.mean()), 4) if values.size else None
