"""Whether the true effect stands in the final class: campaigns of one or two missing effects,
beside models that have terms which can partly imitate them.

Twelve effects, five campaigns each, and ten pairs of effects, two campaigns each, on a linear
oscillator, two coupled masses, a heated body, the force law of a damper and an oleo. Systems,
motions and noise are drawn by :mod:`truth_systems`, independently of the package; so are sizes:
three to ten times the detection limit, the size at which a score would be significant in half of
the campaigns among sixty candidates. Of two effects each has its size beside the other. The whole
catalogue is searched with default settings, from the declared model to the final one; nothing is
sampled.

``truth_in_class`` is the part of campaigns in which each true effect is a final one or stands in
the class of one (``indistinguishable_from``); ``false_companions`` the part in which an effect was
added whose class has none of the true ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats
from truth_systems import Extra, Made, Noise, Plan, Sizes, make, model_of

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._loop import ClosedLoop, close_loop
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._score_basis import Base, coefficients
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction._records import Record

Array = NDArray[np.float64]
#: Of position, velocity, time and own states.
Force = Callable[[Array, Array, Array, Array], Array]

NUMERICS = Numerics(jobs=1, backend="numpy")
PLAN = Plan(fitted=3, held_out=2, periods=5, per_period=64.3)
#: Two masses show two outputs, and take longest to simulate.
FEWER = Plan(fitted=2, held_out=1, periods=5, per_period=64.3)
NOISE = Noise(relative=0.005)
#: Campaigns of each effect and of each pair; the first seed. The search was developed on others.
SINGLES, PAIRS, SEED = 5, 2, 9000
#: Sizes in detection limits.
LEAST, MOST = 3.0, 10.0
#: Probability of a false addition, shared by so many candidates.
LEVEL, CANDIDATES = 0.01, 60
_NEEDED = float(stats.chi2.isf(LEVEL / CANDIDATES, 1))
#: Standard deviations of noise by which an effect at its limit changes the outputs, beside what the
#: model can do.
LIMIT = float(np.sqrt(optimize.brentq(lambda x: stats.ncx2.sf(_NEEDED, 1, x) - 0.5, 1e-6, 400.0)))
#: Amplitude of the first look at what an effect changes, and tries to come to a size.
PROBE, TRIES = 0.03, 8
#: Channels that show the motion on which an effect acts.
MOVES = ("displacement", "first", "body")
#: Harmonics that a lagging signal is made of.
HARMONICS = 24


@dataclass(frozen=True)
class Missing:
    """An effect that a model lacks.

    Parameters
    ----------
    effect, target : str
        What the catalogue calls it, and where it sits.
    unit : callable (sizes, truth) -> Extra or float
        The effect at unit size; of a lagging sensor the unit lag in s.
    signs : tuple of float
        Sides of the null that are physical.
    """

    effect: str
    target: str
    unit: Callable[[Sizes, Mapping[str, float]], Extra | float]
    signs: tuple[float, ...] = (-1.0, 1.0)


@dataclass(frozen=True)
class Case:
    """A kind of system, what its model declares besides, and what it lacks.

    Parameters
    ----------
    kind : str
    missing : tuple of Missing
    declared : callable, optional
        Changes the declared model.
    also : callable (sizes, truth) -> force, optional
        What is there of the terms that were declared besides.
    """

    kind: str
    missing: tuple[Missing, ...]
    declared: Callable[[Model], Model] = lambda model: model
    also: Callable[[Sizes, Mapping[str, float]], Force] | None = None

    @property
    def name(self) -> str:
        """Kind and effects."""
        return f"{self.kind}: {' + '.join(item.effect for item in self.missing)}"


# -- effects at unit size --------------------------------------------------------------------------


def _coulomb(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    transition = 0.02 * sizes.velocity
    return Extra(lambda x, v, t, z: sizes.force * 2 / np.pi * np.arctan(v / transition))


def _cubic(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    return Extra(lambda x, v, t, z: sizes.force * (x / sizes.position) ** 3)


def _square(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    return Extra(lambda x, v, t, z: sizes.force * (x / sizes.mean) ** 2)


def _drag(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    return Extra(lambda x, v, t, z: sizes.force * v * np.abs(v) / sizes.velocity**2)


def _asymmetric(resist: Callable[[Mapping[str, float], Array], Array]) -> Callable[..., Extra]:
    """Damping that differs in extension, as a part of itself."""
    return lambda sizes, truth: Extra(lambda x, v, t, z: resist(truth, v) * (v < 0))


def _pin(resist: Callable[[Mapping[str, float], Array], Array]) -> Callable[..., Extra]:
    """Damping that changes along the stroke, as a part of itself."""
    return lambda sizes, truth: Extra(lambda x, v, t, z: resist(truth, v) * x / sizes.position)


def _dahl(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    rate = 4.0 / sizes.position
    return Extra(
        lambda x, v, t, z: sizes.force * z[0],
        lambda x, v, t, z: rate * (v - np.abs(v) * z),
        states=1,
    )


def _stop(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    """A standard deviation above the mean: a fifth of the stroke is beyond it."""
    at, stiffness = sizes.mean + sizes.position, sizes.force / sizes.position
    return Extra(lambda x, v, t, z: stiffness * np.maximum(x - at, 0.0))


def _preload(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    width = 0.05 * sizes.position
    return Extra(lambda x, v, t, z: sizes.force * 2 / np.pi * np.arctan((x - sizes.mean) / width))


def _lag(sizes: Sizes, _: Mapping[str, float]) -> float:
    return 0.01 / sizes.frequency


def _linear_and_drag(truth: Mapping[str, float], v: Array) -> Array:
    return truth["damping"] * v + truth["drag"] * v * np.abs(v)


def _viscous(truth: Mapping[str, float], v: Array) -> Array:
    return truth["damping"] * v


def _orifice(truth: Mapping[str, float], v: Array) -> Array:
    return truth["orifice_damping"] * v * np.abs(v)


# -- terms that a model declares besides -----------------------------------------------------------

DRAG, RUB, PULL = 60.0, 15.0, 4.0


def _with_drag(model: Model) -> Model:
    known = model.with_parameters(drag=Parameter(50.0, "N*s**2/m**2", sd=50.0))
    return known.with_term("equation", "position", "drag", "drag*dot(position)*abs(dot(position))")


def _with_term(model: Model, name: str, term: str, parameter: Parameter) -> Model:
    output = model.outputs["force"]
    terms = {**model.output_terms("force"), name: term}
    known = model.with_parameters(**{name: parameter})
    return replace(known, outputs={**model.outputs, "force": Output(terms, output.unit)})


def _with_friction(model: Model) -> Model:
    return _with_term(
        model,
        "friction",
        "friction*2/pi*atan(dot(displacement)/0.002)",
        Parameter(10.0, "N", sd=20.0),
    )


def _with_offset(model: Model) -> Model:
    return _with_term(model, "offset", "offset", Parameter(0.0, "N", sd=20.0))


def _drag_there(sizes: Sizes, truth: Mapping[str, float]) -> Force:
    return lambda x, v, t, z: DRAG * v * np.abs(v)


def _friction_there(sizes: Sizes, truth: Mapping[str, float]) -> Force:
    return lambda x, v, t, z: RUB * 2 / np.pi * np.arctan(v / 0.002)


def _offset_there(sizes: Sizes, truth: Mapping[str, float]) -> Force:
    return lambda x, v, t, z: PULL + 0.0 * x


def _damper(*missing: Missing, rubs: bool = False, pulled: bool = False) -> Case:
    """The force law of a damper with a spring and its cubic part; dry friction or an offset."""
    if rubs:
        return Case("force law", missing, _with_friction, _friction_there)
    if pulled:
        return Case("force law", missing, _with_offset, _offset_there)
    return Case("force law", missing)


POSITIVE = (1.0,)
COULOMB = Missing("coulomb_friction", "position", _coulomb, POSITIVE)
CUBIC = Missing("cubic_stiffness", "position", _cubic, POSITIVE)
FASTER = Missing("direction_dependent_damping", "position", _asymmetric(_linear_and_drag))
LAGGING = Missing("sensor_lag", "displacement", _lag, POSITIVE)
FIRST_COULOMB = Missing("coulomb_friction", "first_position", _coulomb, POSITIVE)
FIRST_CUBIC = Missing("cubic_stiffness", "first_position", _cubic, POSITIVE)
FIRST_DRAG = Missing("quadratic_damping", "first_position", _drag, POSITIVE)
LOSS = Missing("quadratic_stiffness", "temperature", _square, POSITIVE)
RUBBING = Missing("coulomb_friction", "force", _coulomb, POSITIVE)
DAHL = Missing("dahl_friction", "force", _dahl, POSITIVE)
PIN = Missing("stroke_dependent_damping", "force", _pin(_viscous))
STOP = Missing("end_stop_upper", "force", _stop, POSITIVE)
PRELOAD = Missing("preload", "force", _preload, POSITIVE)
REBOUND = Missing("direction_dependent_damping", "stroke", _asymmetric(_orifice))
METERING = Missing("stroke_dependent_damping", "stroke", _pin(_orifice))
OLEO_STOP = Missing("end_stop_upper", "stroke", _stop, POSITIVE)


@cache
def singles() -> tuple[Case, ...]:
    """Twelve effects, each beside what can partly imitate it."""
    return (
        Case("linear", (COULOMB,)),  # viscous damping
        Case("linear", (CUBIC,)),  # linear stiffness
        Case("linear", (FASTER,), _with_drag, _drag_there),  # quadratic drag
        Case("linear", (LAGGING,)),  # damping
        Case("two dofs", (FIRST_COULOMB,)),  # two dampers
        Case("thermal", (LOSS,)),  # conductance and radiation
        _damper(DAHL, rubs=True),  # stiffness, damping and Coulomb friction
        _damper(PIN, rubs=True),  # Coulomb friction
        _damper(STOP),  # a cubic spring
        _damper(PRELOAD, pulled=True),  # an offset, stiffness and its cubic part
        Case("oleo", (REBOUND,)),  # friction that grows with pressure
        Case("oleo", (METERING,)),  # the same
    )


@cache
def pairs() -> tuple[Case, ...]:
    """Two effects that are missing together."""
    return (
        Case("linear", (COULOMB, CUBIC)),
        Case("linear", (CUBIC, FASTER), _with_drag, _drag_there),
        Case("linear", (COULOMB, LAGGING)),
        Case("two dofs", (FIRST_COULOMB, FIRST_CUBIC)),
        Case("two dofs", (FIRST_DRAG, FIRST_CUBIC)),
        _damper(RUBBING, PIN),
        _damper(PIN, STOP, rubs=True),
        _damper(DAHL, STOP),
        _damper(PRELOAD, RUBBING, pulled=True),
        Case("oleo", (REBOUND, OLEO_STOP)),
    )


# -- campaigns -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawn:
    """A system whose truth and runs are drawn, before anything is missing.

    Parameters
    ----------
    case : Case
    seed : int
    plain : Made
        Without what the model declares besides.
    sizes : Sizes
        Of its motion; the mean is the middle of the stroke.
    """

    case: Case
    seed: int
    plain: Made
    sizes: Sizes

    @classmethod
    def of(cls, case: Case, seed: int) -> Drawn:
        """Draw it."""
        plain = make(case.kind, seed, plan=_plan(case), noise=NOISE)
        channel = next(name for name in plain.campaign.records[0].samples if name in MOVES)
        values = [r.samples[channel] for r in plain.campaign.records if r.role == "fit"]
        middle = (min(map(np.min, values)) + max(map(np.max, values))) / 2
        return cls(case, seed, plain, replace(plain.sizes, mean=float(middle)))

    def measured(self, amplitudes: Sequence[float]) -> Made:
        """Its campaign with effects at some amplitudes, in units of :attr:`Missing.unit`."""
        case, truth = self.case, {**self.plain.truth, "drag": DRAG}
        declared = case.declared(model_of(case.kind))
        if case.also is None and not np.any(amplitudes):
            return replace(self.plain, model=declared)
        units = [item.unit(self.sizes, truth) for item in case.missing]
        forces = [(u, a) for u, a in zip(units, amplitudes, strict=True) if isinstance(u, Extra)]
        lags = [u * a for u, a in zip(units, amplitudes, strict=True) if not isinstance(u, Extra)]
        there = None if case.also is None else case.also(self.sizes, truth)
        records = {record.label: record for record in self.plain.campaign.records}

        def sensors(label: str, t: Array, values: Mapping[str, Array]) -> Mapping[str, Array]:
            late = dict(values)
            for lag in lags:
                late["displacement"] = _delayed(t, values["displacement"], records[label], lag)
            return late

        return make(
            case.kind,
            self.seed,
            plan=_plan(case),
            noise=NOISE,
            effect=lambda _: _together(forces, there),
            sensors=sensors,
            model=declared,
        )


def _plan(case: Case) -> Plan:
    return FEWER if case.kind == "two dofs" else PLAN


def _together(parts: Sequence[tuple[Extra, float]], there: Force | None) -> Extra:
    """One effect that does what several do; one of them at most has states."""
    moving = [extra for extra, _ in parts if extra.rates is not None]
    rates, states = (moving[0].rates, moving[0].states) if moving else (None, 0)

    def force(x: Array, v: Array, t: Array, z: Array) -> Array:
        found = 0.0 * x if there is None else there(x, v, t, z)
        for extra, amplitude in parts:
            found = found + amplitude * extra.force(x, v, t, z)
        return found

    return Extra(force, rates, states)


def _delayed(t: Array, values: Array, record: Record, lag: float) -> Array:
    """A periodic signal some time later, by its harmonics."""
    omega = 2 * np.pi * record.frequency * np.arange(1, HARMONICS + 1)

    def columns(at: Array) -> Array:
        turn = np.multiply.outer(at, omega)
        return np.concatenate([np.cos(turn), np.sin(turn)], axis=1)

    found = np.linalg.lstsq(columns(t), values - values.mean(), rcond=None)[0]
    return values + (columns(t - lag) - columns(t)) @ found


def sized(case: Case, seed: int, rng: np.random.Generator) -> tuple[Made, Array]:
    """A campaign with effects of sizes drawn between the limits, and what they came to, in
    detection limits."""
    count = len(case.missing)
    wanted = rng.uniform(LEAST, MOST, count)
    amplitudes = PROBE * np.array([rng.choice(item.signs) for item in case.missing])
    drawn = Drawn.of(case, seed)
    plain = drawn.measured(np.zeros(count))
    base = fitted(plain).base()
    reached = wanted
    for k in range(TRIES):  # effects are not quite linear in their amplitudes
        amplitudes = amplitudes * wanted / reached
        reached = _sizes_of(base, [_changes(base, drawn.measured(a)) for a in np.diag(amplitudes)])
        if k and np.all((reached >= LEAST) & (reached <= MOST)):
            break
    return drawn.measured(amplitudes), reached


def _sizes_of(base: Base, changes: Sequence[list[Array]]) -> Array:
    """Of each effect beside the model and the other effects, in detection limits."""
    found = []
    for k, change in enumerate(changes):
        others = [other for j, other in enumerate(changes) if j != k]
        found.append(_distance(base, change, others) / LIMIT)
    return np.array(found)


def fitted(made: Made) -> State:
    """The declared model fitted to a campaign."""
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    return fit_state(task.assembly, task.roles, NUMERICS)


def _changes(base: Base, other: Made) -> list[Array]:
    """What an effect changes in each fitted run, in units of the noise, which both have alike."""
    changes = []
    records = {record.label: record for record in other.campaign.records}
    for record, run in zip(base.fit.records, base.runs, strict=True):
        difference = [
            records[record.label].samples[name] - record.samples[name]
            for name in base.fit.predictor.outputs
        ]
        changes.append(np.concatenate(difference)[None] * run.scale)
    return changes


def _distance(base: Base, change: list[Array], others: Sequence[list[Array]]) -> float:
    """Of a change, in standard deviations, what neither the model nor the others can do."""
    stacked = [np.concatenate(rows) for rows in zip(change, *others, strict=True)]
    size = base.gram.shape[0]
    cross, own = np.zeros((size, len(others) + 1)), np.zeros((len(others) + 1,) * 2)
    for run, rows in zip(base.runs, stacked, strict=True):
        parts = run.products(rows)
        cross, own = cross + parts[0], own + parts[1]
    left = own - cross.T @ coefficients(base.gram, cross)
    alone = left[0, 0]
    if others:
        alone = alone - left[0, 1:] @ np.linalg.solve(left[1:, 1:], left[1:, 0])
    return float(np.sqrt(max(alone, 1e-12)))


# -- what the search makes of it -------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One campaign.

    Parameters
    ----------
    case : str
    seed : int
    sizes : tuple of float
        Of the missing effects, in detection limits.
    found : tuple of tuple of str
        Final effects, each with its class.
    in_class, companion : bool
        Whether every true effect is in the class of a final one, and whether a final one has none.
    certain : bool
    ratio, seconds : float
    """

    case: str
    seed: int
    sizes: tuple[float, ...]
    found: tuple[tuple[str, ...], ...]
    in_class: bool
    companion: bool
    certain: bool
    ratio: float
    seconds: float


def run(case: Case, seed: int) -> Row:
    """Simulate one campaign and close the loop on it."""
    made, sizes = sized(case, seed, np.random.default_rng([seed, len(case.name)]))
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    begin = time.process_time()
    loop = close_loop(task.assembly, task.roles, NUMERICS)
    seconds = time.process_time() - begin
    found = tuple(final_classes(loop))
    names = {f"{item.effect} @ {item.target}": item for item in case.missing}
    true = [{name, item.effect} | _twins(loop, item) for name, item in names.items()]
    return Row(
        case.name,
        seed,
        tuple(map(float, sizes)),
        found,
        all(any(_holds(group, one) for group in found) for one in true),
        any(not any(_holds(group, one) for one in true) for group in found),
        loop.certain,
        loop.final.worst_ratio,
        seconds,
    )


def final_classes(loop: ClosedLoop) -> list[tuple[str, ...]]:
    """Each final effect ``effect @ target`` with what the data cannot tell from it."""
    accepted = {
        (r.accepted.effect, r.accepted.target): r.accepted for r in loop.rounds if r.accepted
    }
    return [
        (f"{effect} @ {target}", *accepted[effect, target].same)
        for effect, target in loop.final.assembly.added
    ]


def _twins(loop: ClosedLoop, item: Missing) -> set[str]:
    """What the search calls an effect that is another one in other words."""
    told = loop.rounds[0].failed.get(f"{item.effect} at {item.target}", "")
    if not told.endswith("in other words"):
        return set()
    name = told.removeprefix("the same as ").removesuffix(" in other words")
    return {name, f"{name} @ {item.target}"}


def _holds(group: Sequence[str], names: set[str]) -> bool:
    """Whether a class has an effect: its first name is with the place, others where need be."""
    first, *rest = group
    return first in names or bool(names & set(rest))


def planned(fraction: float = 1.0) -> list[tuple[Case, int]]:
    """Cases with their seeds; of a fraction as many, evenly over all."""
    everything = [(case, SEED + k) for k in range(SINGLES) for case in singles()]
    everything += [(case, SEED + 100 + k) for k in range(PAIRS) for case in pairs()]
    count = max(1, round(fraction * len(everything)))
    chosen = np.linspace(0, len(everything) - 1, count).round().astype(int)
    return [everything[k] for k in chosen]


def figures(fraction: float = 1.0, say: Callable[[str], Any] = print) -> dict[str, float]:
    """How often the truth is in the final class, and how often a false effect is beside it.

    Parameters
    ----------
    fraction : float
        Part of the 80 campaigns, fixed ones.
    say : callable
        Told every campaign.

    Returns
    -------
    dict of str to float
        ``truth_in_class`` and ``false_companions`` as parts of all campaigns; the same of single
        effects and of pairs; how many were tried; the mean size of a class; the longest search,
        s of the processor.
    """
    rows = []
    for case, seed in planned(fraction):
        row = run(case, seed)
        rows.append(row)
        sizes = ", ".join(f"{size:.1f}" for size in row.sizes)
        found = "; ".join(" ≈ ".join(group) for group in row.found) or "nothing"
        verdict = "right" if row.in_class and not row.companion else "WRONG"
        say(f"{verdict} {row.case} #{seed} x{sizes}: {found} ({row.seconds:.1f} s)")
    single = [row for row in rows if " + " not in row.case]
    double = [row for row in rows if " + " in row.case]
    table: dict[str, float] = {}
    for prefix, chosen in (("", rows), ("single_", single), ("pair_", double)):
        if chosen:
            table[f"{prefix}truth_in_class"] = float(np.mean([row.in_class for row in chosen]))
            table[f"{prefix}false_companions"] = float(np.mean([row.companion for row in chosen]))
            table[f"{prefix}effect_campaigns"] = float(len(chosen))
    groups = [group for row in rows for group in row.found]
    return table | {
        "effect_class_size": float(np.mean([len(group) for group in groups])) if groups else 0.0,
        "certain_and_wrong": float(
            sum(row.certain and (not row.in_class or row.companion) for row in rows)
        ),
        "effect_longest_s": max(row.seconds for row in rows),
    }
