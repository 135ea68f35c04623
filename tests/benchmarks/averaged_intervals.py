"""Intervals of parameters averaged over structures against a posterior by brute force.

Run as ``python tests/benchmarks/averaged_intervals.py [--json] [--only NAME]``. Each case is a
simulated campaign (:mod:`truth_systems`) whose model declares one or two parameters that the data
determine poorly, under a prior of structures that leaves one structure only. The posterior of all
unknowns is drawn by an ensemble sampler of NumPy alone, from the likelihood by which structures are
compared and the priors themselves, with a solution of the model for each vector: nothing is
linearised. What counts is the part of it within the stated interval of 90 %.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from truth_systems import Effect, Extra, Made, Noise, Plan, make, model_of

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery import StructurePosterior, StructurePrior
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._parameter_section import Followed, Section
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._spectral_data import EstimatedModel, linearised
from bayesoleo.discovery._state import fit_state
from bayesoleo.discovery._structure_columns import moment_power
from bayesoleo.discovery._structure_comparison import Comparison
from bayesoleo.discovery._structure_parameters import Frame
from bayesoleo.discovery._structure_search import structure_fits, structure_posterior
from bayesoleo.discovery._structures import Structure
from bayesoleo.effects import find_effect
from bayesoleo.model import Model, Parameter
from bayesoleo.model._priors import LogNormal, LogUniform

Array = NDArray[np.float64]

#: Prior of structures by which one is certain, without and with an effect.
NOTHING = StructurePrior(nothing=1.0, catalogue=1e-12, outside=1e-12)
ONE = StructurePrior(nothing=1e-12, catalogue=1.0, outside=1e-12, numbers=(1.0,))
#: Many vectors are solved together, by compiled code.
NUMERICS = Numerics(jobs=1)
#: Walkers of the ensemble, and its steps, of which a third is left out.
WALKERS, TIMES = 200, 1800


@dataclass(frozen=True)
class Case:
    """A campaign with parameters that the data determine poorly.

    Parameters
    ----------
    kind : str
    model : Model
        As declared.
    seed : int
    noise : float
        Relative.
    poor : tuple of str
    hidden : callable, optional
        What acts besides the kind's own law, the declared friction included.
    missing : tuple of (effect, target), optional
        The one effect that the model lacks.
    plan : Plan
    """

    kind: str
    model: Model
    seed: int
    noise: float
    poor: tuple[str, ...]
    hidden: Effect | None = None
    missing: tuple[str, str] | None = None
    plan: Plan = field(default_factory=lambda: Plan(fitted=2, held_out=0, broadband=False))

    def made(self) -> Made:
        """The campaign."""
        noise = Noise(relative=self.noise)
        return make(
            self.kind, self.seed, plan=self.plan, noise=noise, effect=self.hidden, model=self.model
        )


def rubbing(part: float, turning: float, drag: float = 0.0, cubic: float = 0.0) -> Effect:
    """Smoothed Coulomb friction by parts of the force and of the velocity, drag, and a spring."""

    def effect(sizes: Any) -> Extra:
        size, speed = part * sizes.force, turning * sizes.velocity
        more = drag * sizes.force / sizes.velocity**2
        hard = cubic * sizes.force / sizes.position**3

        def force(x: Array, v: Array, t: Array, z: Array) -> Array:
            return np.asarray(size * np.tanh(v / speed) + more * v * np.abs(v) + hard * x**3)

        return Extra(force)

    return effect


#: Speeds about which friction turns, over a decade and a half on each side of a velocity.
def _friction(model: Model, place: tuple[str, str], rate: str, force: float, speed: float) -> Model:
    """A model with smoothed Coulomb friction of which the size and the transition are unknown."""
    known = model.with_parameters(
        friction=Parameter(force, "N", prior=LogNormal(force, 1.0)),
        transition=Parameter(speed, "m/s", prior=LogUniform(speed / 30.0, speed * 30.0)),
    )
    return known.with_term(*place, "friction", f"friction*tanh({rate}/transition)")


def _cases() -> dict[str, Case]:
    law = _friction(model_of("force law"), ("output", "force"), "dot(displacement)", 0.5, 0.01)
    oscillator = _friction(model_of("linear"), ("equation", "position"), "dot(position)", 2.0, 0.05)
    duffing = model_of("duffing").with_parameters(
        cubic=Parameter(3e9, "N/m**3", prior=LogUniform(1e7, 1e11))
    )
    heated = model_of("thermal").with_parameters(
        radiation=Parameter(2e-9, "W/K**4", prior=LogNormal(2e-9, 1.5)),
        conductance=Parameter(2.0, "W/K", prior=LogNormal(2.0, 1.0)),
    )
    two = model_of("two dofs").with_parameters(
        coupling_damping=Parameter(8.0, "N*s/m", prior=LogUniform(0.08, 800.0))
    )
    oleo = model_of("oleo").with_parameters(
        friction_slope=Parameter(100.0, "s/m", prior=LogUniform(1.0, 1e4))
    )
    both, few = ("friction", "transition"), _plan(periods=4, per_period=30.3)
    return {
        "force law": Case("force law", law, 3, 0.1, both[1:], rubbing(0.1, 0.05), plan=few),
        "force law, two": Case("force law", law, 4, 0.1, both, rubbing(0.05, 0.5)),
        "force law, hardly": Case("force law", law, 8, 0.3, both, rubbing(0.05, 0.5), plan=few),
        "oscillator": Case("linear", oscillator, 3, 0.01, both[1:], rubbing(0.1, 0.1)),
        "oscillator, two": Case("linear", oscillator, 4, 0.05, both, rubbing(0.1, 0.3)),
        "duffing": Case("duffing", duffing, 3, 0.2, ("cubic",), plan=_plan(weak=True)),
        "first order, two": Case(
            "thermal", heated, 3, 0.3, ("radiation", "conductance"), plan=few
        ),
        "two dofs": Case("two dofs", two, 3, 0.03, ("coupling_damping",), plan=_plan(weak=True)),
        "oleo": Case("oleo", oleo, 3, 0.1, ("friction_slope",), plan=few),
        "force law, drag": Case(
            "force law", law, 5, 0.1, both[1:], rubbing(0.1, 0.1, 0.3),
            ("quadratic_damping", "force"), few,
        ),
        "oscillator, hardening": Case(
            "linear", oscillator, 6, 0.05, both, rubbing(0.1, 0.2, 0.0, 0.1),
            ("cubic_stiffness", "position"),
        ),
    }  # fmt: skip


def _plan(**more: Any) -> Plan:
    return Plan(**{"fitted": 2, "held_out": 0, "broadband": False, **more})


CASES = _cases()


@dataclass(frozen=True)
class Compared:
    """What is stated of a case, and what is needed to draw its posterior."""

    found: StructurePosterior
    comparison: Comparison
    anchor: EstimatedModel
    structure: Structure
    frame: Frame


def compared(case: Case) -> Compared:
    """Fit, score and compare structures."""
    made = case.made()
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    state = fit_state(task.assembly, task.roles, NUMERICS)
    base, prior = state.base(), NOTHING
    effects = [find_effect(name) for name in ("quadratic_damping", "cubic_stiffness")]
    scores, _ = score_candidates(base, state.assembly, effects, 1)
    if case.missing is not None:
        scores, prior = [s for s in scores if s.option.key == case.missing], ONE
    errors = {(entry.run, entry.output): entry for entry in state.fit_errors.entries}
    found = structure_posterior(base, state.assembly, scores, errors, NUMERICS, prior=prior)
    chosen = () if case.missing is None else (case.missing,)
    (anchor,) = structure_fits(base, state.assembly, scores, [chosen], NUMERICS)
    assert anchor is not None
    comparison = Comparison.of(base, errors, scores, prior)
    structure = Structure(chosen, False, 1.0, 0.0, True)
    here = linearised(anchor, comparison.data)
    frame = Frame.of(structure, anchor, comparison, comparison.columns(), here).fixed(here)
    return Compared(found, comparison, anchor, structure, frame)


class Target:
    """Log density of all unknowns of an anchor, in coordinates that have no limit below."""

    def __init__(self, what: Compared) -> None:
        self.what, self.problem = what, what.anchor.fit.problem
        self.amplitudes = what.anchor.amplitudes
        self.positive = np.array([
            prior.support[0] >= 0.0 and k not in self.amplitudes
            for k, prior in enumerate(self.problem.priors)
        ])  # fmt: skip
        comparison = what.comparison
        self.root = 1.0 / np.sqrt(comparison.variance)
        white = comparison.shared * self.root
        self.inner = np.linalg.inv(np.eye(len(white)) + white @ white.T) if len(white) else None
        self.white = white
        self.problem.freeze(self.problem.start if what is None else what.anchor.fit.point.theta)

    def theta(self, place: Array) -> Array:
        """Unknowns (L, l) at places (L, l)."""
        return np.where(self.positive, np.exp(np.where(self.positive, place, 0.0)), place)

    def place(self, theta: Array) -> Array:
        """Places of unknowns (l,)."""
        return np.where(self.positive, np.log(np.where(self.positive, theta, 1.0)), theta)

    def __call__(self, place: Array) -> Array:
        """Log densities (L,) at places (L, l)."""
        theta, log = self.theta(place), np.zeros(len(place))
        for k, prior in enumerate(self.problem.priors):
            if k not in self.amplitudes:
                log += prior.log_density(theta[:, k]) + np.where(self.positive[k], place[:, k], 0.0)
        log += self._log_amplitudes(theta)
        inside = np.isfinite(log)
        log[inside] += self._log_likelihood(theta[inside])
        return np.where(np.isfinite(log), log, -np.inf)

    def _log_amplitudes(self, theta: Array) -> Array:
        if not self.amplitudes:
            return np.zeros(len(theta))
        frame, b = self.what.frame, theta[:, self.amplitudes] / self.what.frame.units
        assert b.shape[1] == 1  # one effect with one amplitude
        power = moment_power(frame.sizes, 1)
        density = b**2 / power**1.5 * np.exp(-0.5 * b**2 / power)
        side = np.where(b[:, 0] > 0, frame.effects[0].positive, 1 - frame.effects[0].positive)
        return np.asarray(np.log(np.maximum(density.sum(axis=1) * side, 1e-300)))

    def _log_likelihood(self, theta: Array) -> Array:
        data, comparison = self.what.comparison.data, self.what.comparison
        by_run, good = [], np.ones(len(theta), dtype=bool)
        for r, run in enumerate(data.runs):
            left, status = self.problem.residuals(theta, r)
            good &= status == 0
            found = run.transformed(np.nan_to_num(left))  # (L, outputs, size)
            by_run.append(found.reshape(len(theta), -1))
        white = np.concatenate(by_run, axis=1) * self.root
        square = np.sum(white**2, axis=1)
        if self.inner is not None:
            slope = white @ self.white.T
            square = square - np.einsum("li,ij,lj->l", slope, self.inner, slope)
        freedom, count = comparison.freedom, comparison.variance.size
        log = -0.5 * (freedom + count) * np.log1p(square / freedom)
        return np.where(good, log, -np.inf)


def draws(target: Target, seed: int = 0, times: int = TIMES) -> Array:
    """Unknowns (N, l) by an ensemble of walkers (Goodman and Weare 2010, section 2), which begin
    over the whole priors of what is determined poorly."""
    rng, fit = np.random.default_rng(seed), target.what.anchor.fit
    start, size = target.place(fit.point.theta), len(fit.problem.names)
    spread = np.where(target.positive, fit.point.sd / fit.point.theta, fit.point.sd)
    spread = np.minimum(np.nan_to_num(spread, nan=1.0), 1.0)
    here = start + spread * rng.standard_normal((WALKERS, size))
    log = target(here)
    for k in np.flatnonzero(~np.isfinite(log)):
        here[k] = start + 0.05 * spread * rng.standard_normal(size)
    log, kept, half = target(here), [], WALKERS // 2
    for step in range(times):
        for some in (np.arange(half), np.arange(half, WALKERS)):
            others = np.setdiff1d(np.arange(WALKERS), some)
            if rng.uniform() < 0.3:  # differential evolution, for what is not of one scale
                one, two = (rng.permutation(others) for _ in range(2))
                factor = 1.0 if rng.uniform() < 0.1 else 2.38 / np.sqrt(2 * size)
                new = here[some] + factor * (here[one] - here[two])
                new = new + 1e-4 * spread * rng.standard_normal(new.shape)
                jump = np.zeros(half)
            else:
                z = (1.0 + rng.uniform(size=half)) ** 2 / 2.0
                mates = here[rng.permutation(others)]
                new, jump = mates + z[:, None] * (here[some] - mates), (size - 1) * np.log(z)
            found = target(new)
            with np.errstate(invalid="ignore"):  # nothing is known of a first place
                taken = np.log(rng.uniform(size=half)) < jump + found - log[some]
            here[some[taken]], log[some[taken]] = new[taken], found[taken]
        if step >= times // 3:
            kept.append(here.copy())
    return target.theta(np.concatenate(kept))


@contextmanager
def counted() -> Iterator[list[tuple[str, int, float]]]:
    """Name, solutions and CPU seconds of each density that follows the model meanwhile."""
    found: list[tuple[str, int, float]] = []
    plain = Section.density

    def density(self: Section, *args: Any) -> Followed | None:
        began, before = time.process_time(), self.solutions
        one = plain(self, *args)
        found.append((self.name, self.solutions - before, time.process_time() - began))
        if one is not None and "BAYESOLEO_SHOW" in os.environ:
            grid = one.grid
            print(f"  {self.name}: {grid.unknown:.3g} gap {grid.gap:.3g} modes {grid.modes}")
        return one

    Section.density = density  # type: ignore[method-assign]
    try:
        yield found
    finally:
        Section.density = plain  # type: ignore[method-assign]


def judged(case: Case, times: int = TIMES) -> dict[str, dict[str, float | str]]:
    """By declared parameter: the part of the posterior in its interval, or why none is
    stated, and the posterior's own interval."""
    with counted() as cost:
        what = compared(case)
    target = Target(what)
    theta = draws(target, times=times)
    found: dict[str, dict[str, float | str]] = {}
    for name in what.found.parameters:
        stated, own = what.found.parameters[name], theta[:, target.problem.names.index(name)]
        low, high = np.quantile(own, [0.05, 0.95])
        found[name] = {"true low": float(low), "true high": float(high)}
        found[name]["solutions"] = sum(count for other, count, _ in cost if other == name)
        found[name]["seconds"] = sum(cpu for other, _, cpu in cost if other == name)
        if stated.low is None or stated.high is None:
            found[name] |= {"withheld": stated.reason}
            continue
        inside = float(np.mean((own > stated.low) & (own < stated.high)))
        below = float(np.mean(own <= stated.low))
        found[name] |= {
            "content": inside, "below": below, "low": stated.low, "high": stated.high
        }  # fmt: skip
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object, no more")
    parser.add_argument("--only", action="append", help="a case; by default all")
    parser.add_argument("--times", type=int, default=TIMES, help="steps of the ensemble")
    options = parser.parse_args()
    table = {}
    for name, case in CASES.items():
        if options.only and name not in options.only:
            continue
        began = time.process_time()
        for parameter, found in judged(case, options.times).items():
            table |= {f"{name}: {parameter}: {key}": value for key, value in found.items()}
            print(name, parameter, found, file=sys.stderr, flush=True)
        print(f"{time.process_time() - began:.0f} s", file=sys.stderr, flush=True)
    if options.json:
        print(json.dumps(table))


if __name__ == "__main__":
    main()
