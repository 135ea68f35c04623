"""Disturbances that are no physics, on systems that lack nothing: is an effect named?

Run as ``python tests/benchmarks/structures_nuisance.py [--json] [--fraction 0.1]``. A hundred
campaigns each of five kinds of system in :mod:`truth_systems` get a drift (a random walk or a cubic
polynomial), a tone between the harmonics, or noise with the tails of Student's t. Every effect that
is named is false, save one that names the disturbance itself. An eighth of the campaigns are
transients.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from truth_systems import Effect, Made, Noise, Plan, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._loop import ClosedLoop, close_loop
from bayesoleo.effects._nonparametric import FAMILY

Array = NDArray[np.float64]

SYSTEMS = ("linear", "two dofs", "thermal", "force law", "oleo")
#: Campaigns with each disturbance.
EACH = 100
#: Effects that name the disturbance.
TRUE = {
    "drift": ("sensor_drift", "drifting_force"),
    "tone": ("humming_force",),
    "tails": (),
}


@dataclass(frozen=True)
class Disturbance:
    """What is in the outputs besides a model's, in standard deviations of a sample's noise.

    Parameters
    ----------
    kind : {"none", "walk", "polynomial", "tone", "tails"}
    size : float
        Of a random walk its standard deviation at the end of the record, of a polynomial its
        largest value, of a tone its amplitude; of heavy tails the degrees of freedom.
    first_only : bool
        Only the first of two outputs has it.
    """

    kind: str
    size: float = 0.0
    first_only: bool = False

    def drawn(
        self, rng: np.random.Generator, name: str, time: Array, frequency: float, sd: float
    ) -> Array:
        """Noise of one output, with the disturbance."""
        white = rng.standard_normal(time.size)
        if self.kind == "none" or (self.first_only and name in ("second", "pressure")):
            return sd * white
        if self.kind == "tails":
            return sd * rng.standard_t(self.size, time.size)
        makes: Mapping[str, Callable[..., Array]] = {
            "walk": _walk, "polynomial": _polynomial, "tone": _tone
        }  # fmt: skip
        return sd * (white + self.size * makes[self.kind](rng, time, frequency))


def _walk(rng: np.random.Generator, time: Array, _: float) -> Array:
    return np.cumsum(rng.standard_normal(time.size)) / np.sqrt(time.size)


def _polynomial(rng: np.random.Generator, time: Array, _: float) -> Array:
    place = np.linspace(-1.0, 1.0, time.size)
    values = np.polynomial.legendre.legval(place, [0.0, *rng.standard_normal(3)])
    return values / np.abs(values).max()


def _tone(rng: np.random.Generator, time: Array, frequency: float) -> Array:
    # A quarter of the distance between harmonics from any.
    place = rng.integers(0, 12) + rng.uniform(0.25, 0.75)
    return np.sin(2 * np.pi * (place * frequency * time + rng.uniform()))


def disturbed(
    kind: str, seed: int, what: Disturbance, plan: Plan | None = None, effect: Effect | None = None
) -> Made:
    """A campaign of a true model, or of one that lacks an effect, with a disturbance."""
    noise = Noise(drawn=what.drawn)
    return make(kind, seed, plan=plan or Plan(), noise=noise, effect=effect)


def close(made: Made, **settings: Any) -> ClosedLoop:
    """Close the loop on a campaign, without a posterior."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        task = prepare(made.campaign, made.model, Settings(jobs=1, **settings))
        return close_loop(task.assembly, task.roles, task.settings.numerics, seed=0)


def drawn_disturbance(word: str, number: int) -> Disturbance:
    """The disturbance of a campaign by its number: weak and strong ones, on one output or all."""
    first = number % 3 == 1
    if word == "drift":
        kind, sizes = (("walk", (1.0, 3.0, 10.0)), ("polynomial", (1.0, 5.0, 30.0)))[number % 2]
        return Disturbance(kind, sizes[number // 2 % 3], first)
    sizes = (0.5, 2.0, 10.0) if word == "tone" else (2.0, 3.0, 5.0)
    return Disturbance(word, sizes[number // 2 % 3], first)


@dataclass(frozen=True)
class Case:
    """One campaign and what came of it."""

    word: str
    kind: str
    number: int
    what: Disturbance
    transient: bool
    loop: ClosedLoop

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that are false; a function without a name is no effect of physics."""
        steps = self.loop.final.assembly.steps
        effects = [step.effect.id for step in steps if step.effect.family != FAMILY]
        return tuple(effect for effect in effects if effect not in TRUE[self.word])

    @property
    def significant(self) -> bool:
        """Whether the best score of the declared model is."""
        return min((item.p_value for item in self.loop.rounds[0].ranking), default=1.0) < 0.01


def run(word: str, number: int, **settings: Any) -> Case:
    """One campaign; its number says which it is."""
    kind = SYSTEMS[number % len(SYSTEMS)]
    what, transient = drawn_disturbance(word, number // len(SYSTEMS)), number % 8 == 3
    made = disturbed(kind, 500 + number, what, Plan(transient=transient))
    return Case(word, kind, number, what, transient, close(made, **settings))


def figures(
    fraction: float = 1.0, say: Callable[[str], object] = print, **settings: Any
) -> dict[str, float]:
    """Parts of the campaigns in which something false was said.

    Parameters
    ----------
    fraction : float
        Part of the campaigns, the first ones of each disturbance.
    say : callable
        Told of each false name.
    settings
        Other than the defaults.
    """
    cases = []
    for number in range(max(1, round(fraction * EACH))):
        for word in TRUE:
            case = run(word, number, **settings)
            cases.append(case)
            if case.named or case.significant:
                what = ", ".join(case.named) or "significant only"
                say(f"{word} {number} {case.kind} {case.what} transient={case.transient}: {what}")

    def part(chosen: list[Case], key: Callable[[Case], object]) -> float:
        return float(np.mean([bool(key(case)) for case in chosen])) if chosen else 0.0

    def about(name: str, chosen: list[Case]) -> dict[str, float]:
        return {
            f"nuisance_named{name}": part(chosen, lambda case: case.named),
            f"nuisance_significant{name}": part(chosen, lambda case: case.significant),
        }

    table = {"nuisance_campaigns": float(len(cases))} | about("", cases)
    for word in TRUE:
        table |= about(f"_{word}", [case for case in cases if case.word == word])
    for kind in SYSTEMS:
        table |= about(f"_{kind.replace(' ', '_')}", [case for case in cases if case.kind == kind])
    table |= about("_periodic", [case for case in cases if not case.transient])
    return table | about("_transient", [case for case in cases if case.transient])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object, no more")
    parser.add_argument("--fraction", type=float, default=1.0, help="part of the campaigns to run")
    parser.add_argument("--keep", action="store_true", help="remove no disturbance, for comparison")
    options = parser.parse_args()
    settings = {"disturbances": ()} if options.keep else {}
    table = figures(
        options.fraction, lambda text: print(text, file=sys.stderr, flush=True), **settings
    )
    if options.json:
        print(json.dumps(table))
        return
    for key, value in table.items():
        print(f"{key:{max(map(len, table))}}  {value:.4g}")


if __name__ == "__main__":
    main()
