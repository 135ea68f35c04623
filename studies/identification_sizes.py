"""Which effects the campaigns of ``identification.py`` can show, in which shape, and how large
they must be to be found.

The detection limit is the size that a score finds significant in half of the campaigns, at the
level corrected for the search, from the noise alone. An effect with a shape of its own is taken
where it differs most from all others: elsewhere it is another effect - a power law of exponent one
is viscous damping - and no data could tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from identification_data import DRIVE, SYSTEM, simulated
from identification_rows import FACTORS
from numpy.typing import NDArray
from scipy import optimize, stats

from bayesoleo.discovery import (
    Assembly,
    Numerics,
    Option,
    Score,
    SearchPolicy,
    State,
    assign,
    effective_tests,
    fit_state,
    scales_of,
    score_all,
    without_twins,
)
from bayesoleo.effects import Effect, force_effect
from bayesoleo.model import driven_by
from bayesoleo.systems import system

NUMERICS = Numerics(jobs=1, backend="numpy")
#: Of the motion that limits come from.
SEED = 0
#: What the catalogue has no name for.
STRANGERS = (
    force_effect("ripple", "nonparametric", "ripple*sin(900*position)", {"ripple": "force"}),
    force_effect(
        "late_drag", "nonparametric", "late_drag*velocity**3/(1 + (40*velocity)**4)",
        {"late_drag": "force/(position/s)**3"},
    ),
    force_effect(
        "inner_wall", "nonparametric", "inner_wall*exp(-((position - 0.11)/0.006)**2)",
        {"inner_wall": "force"},
    ),
)  # fmt: skip

#: Largest sizes that are possible: of a channel that is clipped nothing is shown.
POSSIBLE = {"sensor_saturation_upper": 1.0, "sensor_saturation_lower": 1.0}

Key = tuple[str, str]


@cache
def base() -> State:
    """The model fitted to a plain campaign: motion and noise that limits are computed from."""
    plain = simulated(driven_by(system(SYSTEM), DRIVE), {}, SEED)
    return fit_state(Assembly(system(SYSTEM), DRIVE), assign(plain.records), NUMERICS)


@cache
def freed() -> State:
    """The same with every constant estimated that is known to a tolerance."""
    assembly, roles = base().assembly, assign(base().fit.records)
    declared = assembly.model()
    loose = {n: replace(declared.parameters[n], fixed=False) for n in declared.uncertain()}
    return fit_state(assembly.with_parameters(loose), roles, NUMERICS)


def motion_scales() -> Any:
    """Sizes of the motion, which place scan grids."""
    return scales_of(base().fit, DRIVE, base().assembly.native)


@cache
def signs() -> dict[Key, int]:
    """Side of the null that is physical, zero for both, by effect and target."""
    sides = {option.key: set(option.candidate.sign.values()) for option in _options(None)}
    return {key: (found or {0}).pop() for key, found in sides.items()}


@cache
def effects() -> dict[Key, Score]:
    """Scores, in the shape that is put into data, of effects and strangers that data can show.

    Without what a constant does that is known to a tolerance only: a loop that finds it far off
    frees it first, and is right to.
    """
    rivals = score_all(base().base(), _options(None), jobs=1)[0]
    wanted = [*_options(None), *_options(STRANGERS)]
    seen = {score.option.key for score in score_all(freed().base(), wanted, jobs=1)[0]}
    order = [option.key for option in wanted]
    once, _ = without_twins(sorted(rivals, key=lambda score: order.index(score.option.key)))
    strange = {option.key for option in _options(STRANGERS)}
    seen &= strange | {score.option.key for score in once}
    found = {option.key: _most_itself(option, rivals) for option in wanted if option.key in seen}
    return {key: score for key, score in found.items() if score is not None}


def limit(key: Key, direction: NDArray[np.float64]) -> float:
    """How large an effect must be along a direction of its unknowns in the fitted runs, SI."""
    return _limit(effects()[key], direction)


def _limit(score: Score, direction: NDArray[np.float64]) -> float:
    needed = stats.chi2.isf(_local_level(), score.rank)
    # The median of a non-central variate is where its power is one half.
    away = optimize.brentq(lambda x: stats.ncx2.sf(needed, score.rank, x) - 0.5, 1e-6, 400.0)
    return float(np.sqrt(away / (direction @ score.information @ direction)))


@cache
def _local_level() -> float:
    """Level of one test among so many."""
    tests = effective_tests(score_all(base().base(), _options(None), jobs=1)[0], 0)
    return float(-np.expm1(np.log1p(-SearchPolicy().significance) / tests))


def _options(catalogue: Sequence[Effect] | None) -> list[Option]:
    """Every effect where it applies, of either sign so that noise has no say."""
    return base().assembly.options(motion_scales(), catalogue)


def _most_itself(option: Option, rivals: Sequence[Score]) -> Score | None:
    """The score at the shapes where the effect does least of what another could."""
    candidate = option.candidate
    grid = list(product(*candidate.shapes.values()))
    variants = [
        replace(
            option,
            candidate=replace(
                candidate,
                shapes={n: (v,) for n, v in zip(candidate.shapes, values, strict=True)},
                sign={},
            ),
        )
        for values in grid
    ]
    most = POSSIBLE.get(candidate.effect, np.inf) / max(FACTORS)
    scores = [
        score
        for score in score_all(base().base(), variants, jobs=1)[0]
        if not np.isfinite(most) or _limit(score, np.ones(1)) <= most
    ]
    others = [s.columns for s in rivals if s.option.key != option.key and len(s.names) == 1]
    if len(scores) < 2 or not others:
        return scores[0] if scores else None
    along = np.concatenate(others)
    return min(scores, key=lambda score: float(np.max((along @ score.columns[0]) ** 2)))
