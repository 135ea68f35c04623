"""How often do 90 % intervals hold the truth where constants are known to a tolerance only?

Campaigns that lack nothing, from the six kinds of :mod:`truth_systems`: every true constant is
drawn from its prior without limits, one of each kind from its declared tolerance, and half of the
campaigns have fitted runs that say little. Each is fitted as ``estimate`` does. An interval is the
one that the package reports: equal-tailed under the normal approximation at the posterior's mode
for all, and from posterior draws for some. That is Bayes' own calibration (Cook, Gelman and Rubin
2006): coverage is exact when averaged over the prior, whatever the data say.

Coverage is counted by parameter of a kind. With fifty campaigns each its standard error is four per
cent, so that the worst of some thirty is expected several per cent off: what the worst may be by
chance is stated beside it, and so is the largest deviation in standard errors.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats
from truth_systems import KINDS, Made, make

from bayesoleo._workflow.estimating import draw
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import Task, prepare
from bayesoleo.discovery._fit import ModelFit, fit_model

#: Campaigns of each kind, those of them that are sampled, and the level of the intervals.
CAMPAIGNS, SAMPLED, LEVEL = 50, 5, 0.9
#: Seeds of the worst by chance.
_DRAWS = 4000

#: By kind and parameter whether each interval holds the truth.
Held = dict[tuple[str, str], list[bool]]


@dataclass(frozen=True)
class Tally:
    """What was counted.

    Parameters
    ----------
    linear, drawn : dict
        By kind and parameter, of intervals by linearisation and from draws.
    toleranced : dict
        Those of ``linear`` that are of constants known to a tolerance.
    failed : int
        Campaigns whose estimate did not converge.
    """

    linear: Held
    drawn: Held
    toleranced: Held
    failed: int


def counted(fraction: float = 1.0, say: Callable[[str], None] = print) -> Tally:
    """Fit all campaigns, or the first part of each kind, and count."""
    linear, drawn, toleranced = (defaultdict(list) for _ in range(3))
    failed, campaigns = 0, max(1, round(fraction * CAMPAIGNS))
    sampled = max(1, round(fraction * SAMPLED))
    for kind in KINDS:
        for seed in range(campaigns):
            made, task, fit = _fitted(kind, seed)
            if not fit.point.status.ok:
                failed += 1
                continue
            for name, held in _linear(made, fit):
                linear[kind, name].append(held)
                if made.model.parameters[name].toleranced:
                    toleranced[kind, name].append(held)
            if seed < sampled:
                for name, held in _drawn(made, task, fit):
                    drawn[kind, name].append(held)
        say(f"{kind}: {100 * _mean(_of(linear, kind)):.1f} % of {campaigns} campaigns' intervals")
    return Tally(linear, drawn, toleranced, failed)


def _fitted(kind: str, seed: int) -> tuple[Made, Task, ModelFit]:
    made = make(kind, seed, weak=seed % 2 == 0, toleranced=True, within=np.inf)
    task = prepare(made.campaign, made.model, Settings(seed=seed, jobs=1, quick=True))
    return made, task, fit_model(task.assembly.model(), task.roles.fitted, task.settings.numerics)


def _linear(made: Made, fit: ModelFit) -> Iterator[tuple[str, bool]]:
    half = stats.norm.ppf(0.5 + LEVEL / 2) * fit.point.sd
    for name, estimate, reach in zip(fit.point.names, fit.point.theta, half, strict=True):
        yield name, bool(abs(estimate - made.truth[name]) < reach)


def _drawn(made: Made, task: Task, fit: ModelFit) -> Iterator[tuple[str, bool]]:
    samples, _ = draw(task, fit, None, lambda _: None, False)
    for name in fit.point.names:
        values = samples.draws[:, :, samples.names.index(name)]
        low, high = np.quantile(values, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
        yield name, bool(low < made.truth[name] < high)


def _of(held: Held, kind: str) -> list[bool]:
    return [item for (of, _), items in held.items() if of == kind for item in items]


def _mean(items: list[bool]) -> float:
    return float(np.mean(items)) if items else float("nan")


def _error(items: list[bool]) -> float:
    """Standard error of a coverage, were it the level."""
    return float(np.sqrt(LEVEL * (1 - LEVEL) / max(len(items), 1)))


def _worst(held: Held) -> tuple[str, float, float]:
    """Name of the parameter whose coverage is farthest off, the coverage, and how far in standard
    errors."""
    off = {key: (_mean(items) - LEVEL) / _error(items) for key, items in held.items()}
    key = max(off, key=lambda k: abs(off[k]))
    return " ".join(key), _mean(held[key]), off[key]


def _chance(held: Held) -> float:
    """What the largest deviation in standard errors stays below 95 times in a hundred, if every
    interval holds with its level and independently."""
    rng = np.random.default_rng(0)
    sizes = np.array([len(items) for items in held.values()])
    hits = rng.binomial(sizes, LEVEL, (_DRAWS, sizes.size))
    off = np.abs(hits / sizes - LEVEL) / np.sqrt(LEVEL * (1 - LEVEL) / sizes)
    return float(np.quantile(off.max(axis=1), 0.95))


def _clustered_error(held: Held, kinds: Mapping[str, object]) -> float:
    """Standard error of the pooled coverage: the parameters of a campaign go together."""
    parts, total = [], 0
    for kind in kinds:
        rows = [items for (of, _), items in held.items() if of == kind]
        if not rows:
            continue
        table = np.array(rows, dtype=float)
        total += table.size
        parts.append(float(np.var(table.sum(axis=0), ddof=1)) * table.shape[1])
    return float(np.sqrt(sum(parts)) / max(total, 1))


def figures(fraction: float = 1.0, say: Callable[[str], None] = print) -> dict[str, float]:
    """Coverage of 90 % intervals, all parameters together and the worst.

    Parameters
    ----------
    fraction : float
        Part of the campaigns.
    say : callable
        Told what is being done.

    Returns
    -------
    dict of str to float
        ``coverage``: of all intervals by linearisation together, with its standard error, which
        counts that the parameters of a campaign go together. ``coverage_worst``: of the parameter
        of a kind that is farthest off; ``coverage_worst_sigma`` says how far in standard errors and
        ``coverage_worst_chance`` how far the worst of so many may be.
        ``coverage_toleranced``: of the constants known to a tolerance. ``coverage_drawn``: of
        intervals from posterior draws. Fractions, not per cent.
    """
    tally = counted(fraction, say)
    everything = [item for items in tally.linear.values() for item in items]
    constants = [item for items in tally.toleranced.values() for item in items]
    draws = [item for items in tally.drawn.values() for item in items]
    name, worst, sigma = _worst(tally.linear)
    say(f"farthest off: {name}, {100 * worst:.0f} %")
    campaigns = sum(max(map(len, rows)) for rows in _by_kind(tally.linear).values())
    table = {
        "coverage": _mean(everything),
        "coverage_error": _clustered_error(tally.linear, KINDS) if campaigns > len(KINDS) else 1.0,
        "coverage_campaigns": campaigns,
        "coverage_parameters": len(tally.linear),
        "coverage_worst": worst,
        "coverage_worst_sigma": sigma,
        "coverage_worst_chance": _chance(tally.linear),
        "coverage_toleranced": _mean(constants),
        "coverage_toleranced_error": _error(constants),
        "coverage_drawn": _mean(draws),
        "coverage_drawn_error": _error(draws),
        "coverage_failed": tally.failed,
    }
    return {key: round(float(value), 4) for key, value in table.items()}


def _by_kind(held: Held) -> dict[str, list[list[bool]]]:
    found: dict[str, list[list[bool]]] = defaultdict(list)
    for (kind, _), items in held.items():
        found[kind].append(items)
    return found
