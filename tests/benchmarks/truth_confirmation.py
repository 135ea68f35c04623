"""How absent effects are judged: p-values of their estimates, and falls of the hold-out error.

Nothing is missing in these campaigns. Effects of the catalogue are estimated beside the declared
model, one at a time, and judged on the hold-out runs. Their p-values, before the correction for
the search, should be below 5 % in one case of twenty. The mean of the fall is minus its expected
size; its distance from there, over the standard error that is stated, should have a mean square of
one. The noise is white, slow (AR(1) of 0.97), or lies in the band of the motion itself
with a fiftieth of it white, as the remaining error of a model does. Runs repeat or do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from truth_systems import KINDS, Made, Noise, Plan, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._hold_out_confirmation import Fall, fall_on_hold_out, judged
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import estimated, score_candidates
from bayesoleo.discovery._refit import refit
from bayesoleo.discovery._score_tests import corrected_p
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect

Array = NDArray[np.float64]

#: Effects that are tried, where a model has a place for them.
EFFECTS = ("coulomb_friction", "cubic_stiffness", "quadratic_damping", "quadratic_stiffness")
#: Campaigns of each kind of system and noise, and the first one's seed.
EACH, SEED = 12, 1000
RELATIVE = 0.02
NUMERICS = Numerics(jobs=1)


def in_the_band(
    rng: np.random.Generator, _: str, time: Array, frequency: float, sd: float
) -> Array:
    """Twelve random sinusoids about a frequency, and a little white noise."""
    places = frequency * rng.uniform(0.3, 3.0, 12)
    turns = 2 * np.pi * np.outer(places, time) + rng.uniform(0.0, 2 * np.pi, (12, 1))
    slow = rng.standard_normal(12) @ np.sin(turns) / np.sqrt(6.0)
    return np.asarray(sd * (slow + 0.02 * rng.standard_normal(time.size)))


NOISES = {
    "white": Noise(relative=RELATIVE),
    "slow": Noise(relative=RELATIVE, colour=0.97),
    "band": Noise(relative=RELATIVE, drawn=in_the_band),
}


def campaign(kind: str, seed: int, noise: str, *, transient: bool) -> Made:
    """A campaign in which nothing is missing."""
    return make(kind, seed, plan=Plan(transient=transient), noise=NOISES[noise])


@dataclass(frozen=True)
class Judged:
    """What is said of an effect that is absent.

    Parameters
    ----------
    p : float
        Of its estimate on the fitted runs, without a correction for the search.
    excludes : bool
        Whether the posterior of its amplitudes excludes the null.
    fall : Fall or None
        Of the hold-out error; None where the effect changes none.
    """

    p: float
    excludes: bool
    fall: Fall | None

    @property
    def distance(self) -> float:
        """Distance of the fall from its mean, in standard errors."""
        assert self.fall is not None
        return (self.fall.value + self.fall.expected) / self.fall.error


def judgements(made: Made, held_out: bool = True) -> Iterator[Judged]:
    """What is said of each of the effects."""
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    state = fit_state(task.assembly, task.roles, NUMERICS)
    base, effects = state.base(), [find_effect(name) for name in EFFECTS]
    for score in score_candidates(base, state.assembly, effects, 1)[0]:
        result = refit(base, score, NUMERICS)
        if not np.isfinite(result.share):
            continue
        p, fall = corrected_p(estimated(score, result), 1.0), None
        if held_out:
            start = result.fit.point.theta
            after = fit_state(result.assembly, task.roles, NUMERICS, start=start)
            fall = fall_on_hold_out(*judged(state, after), result.inflation)
        yield Judged(p, result.excludes_null(), fall if fall and fall.error > 0 else None)


def figures(fraction: float = 1.0, say: Callable[[str], Any] = print) -> dict[str, float]:
    """Root mean square distances, and how often absent effects are significant or confirmed.

    Parameters
    ----------
    fraction : float
        Part of the campaigns, the first ones of each kind.
    say : callable
        Told of each kind of system.
    """
    found: dict[str, float] = {}
    count = max(1, round(fraction * EACH))
    for runs in ("periodic", "transient"):
        for noise in NOISES:
            everything: list[Judged] = []
            for kind in KINDS:
                made = (
                    campaign(kind, SEED + k, noise, transient=runs == "transient")
                    for k in range(count)
                )
                own = [one for each in made for one in judgements(each)]
                say(f"{runs}, {noise} noise, {kind}: {_table(own)}")
                everything += own
            for key, value in _table(everything).items():
                found[f"confirmation_{runs}_{noise}_{key}"] = value
    return found


def _table(some: list[Judged]) -> dict[str, float]:
    shown = [one for one in some if one.fall is not None]
    distances = np.array([one.distance for one in shown])
    small = np.array([one.p for one in some])
    return {
        "effects": float(small.size),
        "p_below_5_percent": round(float(np.mean(small < 0.05)), 4),
        "p_below_0_1_percent": round(float(np.mean(small < 0.001)), 4),
        "excluded": round(float(np.mean([one.excludes for one in some])), 4),
        "distance_rms": round(float(np.sqrt(np.mean(distances**2))), 3),
        "confirmed": round(float(np.mean([one.fall.confirms for one in shown if one.fall])), 4),
    }
