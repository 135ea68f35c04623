"""Constant, periodic and drifting forces, and inertia."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import sympy as sp

from bayesoleo.effects._effect import BY_RUN, Effect, Names, error_of
from bayesoleo.effects._force_effect import single_force
from bayesoleo.effects._parts import Amplitude, Scales, Scan, ShapeParameter
from bayesoleo.effects._places import (
    acceleration,
    balance_terms,
    drives,
    force_places,
    moving_places,
    resistance_sense,
    resisting_places,
)
from bayesoleo.model._expressions import COSINE, SINE, TIME, symbol, within
from bayesoleo.model._model import Model

#: Name under which a model may declare the acceleration of gravity.
GRAVITY = "gravity"

CONSTANT = single_force(
    Amplitude("constant_force", "force", "F_0", "constant force"),
    "force",
    "constant_force",
    formula="F_0",
    title="Constant force (preload, weight)",
    source="Verbeek (1993), eq. 6.1: the weight",
)

OFFSET_BY_RUN = single_force(
    Amplitude("force_offset_by_run", "force", "F_{0,r}", "constant force of the run", by_run=True),
    "force",
    "force_offset_by_run",
    formula="F_{0,r}",
    title="Constant force, different in every run",
    source=BY_RUN,
)


def _side_of_mass(model: Model, target: str) -> int:
    """The likely sign of a mass error.

    A force law without inertia lacks some: the inertia force then has the sense in which the law
    resists motion, unless the rig overcompensates it. The inertia of a model that has one may be
    too large, so that both signs are likely.
    """
    place = force_places(model)[target]
    terms = balance_terms(model, place).values()
    if place.kind == "equation" or any(model.expand(one).has(acceleration(place)) for one in terms):
        return 0
    return resistance_sense(model, place)


MASS = replace(
    single_force(
        Amplitude("mass_error", "force/(position/s**2)", r"\Delta m", "added mass"),
        "force",
        "mass_error*acceleration",
        formula=r"\Delta m \, \ddot q",
        title="Mass error (inertia)",
        source="Newton (1687), second law",
    ),
    side=_side_of_mass,
)


#: Harmonics of the drive that a periodic force may have. Dry friction of equal size in every run is
#: a square wave in the drive's phase: with five harmonics the two could hardly be distinguished.
HARMONICS = 3


def _driven_balances(model: Model) -> Sequence[str]:
    """Balances of forces of driven models; a free decay has no periodic force."""
    return tuple(resisting_places(model)) if drives(model) else ()


def _add_harmonics(model: Model, target: str, names: Names) -> Model:
    """Add harmonics of the drive's phase.

    Chebyshev polynomials of the first kind in the cosine of the phase are the cosines of its
    multiples; those of the second kind, times the sine, are the sines.
    """
    place, drive = resisting_places(model)[target], drives(model)[0]
    cosine, sine = (within(part, drive) for part in (COSINE, SINE))
    c, s = symbol(cosine), symbol(sine)
    force = sp.Add(
        *(
            names[f"cosine_{k}"] * sp.chebyshevt(k, c)
            + names[f"sine_{k}"] * s * sp.chebyshevu(k - 1, c)
            for k in range(1, HARMONICS + 1)
        )
    )
    turned = replace(model, inputs={**model.inputs, cosine: "", sine: ""})
    return turned.with_term(place.kind, place.target, "periodic_force", place.sign * force)


# The amplitudes are the same in every run, whatever the size of the motion. With amplitudes by run
# the force would absorb every other effect.
PERIODIC = Effect(
    id="periodic_force",
    family="clock",
    title="Force that repeats with the drive, the same in every run",
    formula=r"\sum_{k=1}^{3} a_k \cos k\varphi + b_k \sin k\varphi",
    amplitudes=tuple(
        Amplitude(f"{part}_{k}", "force", f"{letter}_{k}", f"{part} of harmonic {k} of the drive")
        for k in range(1, HARMONICS + 1)
        for part, letter in (("cosine", "a"), ("sine", "b"))
    ),
    places=_driven_balances,
    change=_add_harmonics,
    source="Fourier series in the phase phi of the drive's first harmonic; Pintelon and Schoukens"
    " (2012), System Identification: A Frequency Domain Approach, section 2.3",
    applies_to="balances of forces, in periodic runs",
    driven=True,
    kind="periodic",
)


def _equations_of_motion(model: Model) -> Sequence[str]:
    """Equations of motion; a drift in a force law is a drift of its channel."""
    return tuple(k for k, place in moving_places(model).items() if place.kind == "equation")


def _add_drift(model: Model, target: str, names: Names) -> Model:
    place = moving_places(model)[target]
    drift = place.sign * names["drifting_force"] * TIME
    return model.with_term(place.kind, place.target, "drifting_force", drift)


DRIFTING = Effect(
    id="drifting_force",
    family="force",
    title="Force that drifts",
    formula=r"F_t \, t",
    amplitudes=(Amplitude("drifting_force", "force/s", "F_t", "rate of a force"),),
    places=_equations_of_motion,
    change=_add_drift,
    source="the first term of a Taylor series in time of what is not modelled",
    applies_to="equations of motion, in transient runs; in force laws it is sensor_drift",
    driven=True,
    kind="transient",
)


def _add_line(model: Model, target: str, names: Names) -> Model:
    place = resisting_places(model)[target]
    turn = 2 * sp.pi * names["frequency"] * TIME
    force = names["cosine"] * sp.cos(turn) + names["sine"] * sp.sin(turn)
    return model.with_term(place.kind, place.target, "humming_force", place.sign * force)


def _line(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
    """The dominant frequency; without one, that of the shortest period, for models extended by
    hand."""
    return (scales.dominant_frequency or 1.0 / scales.shortest_period,)


_LINE = Scan(_line, "that of the highest line")

HUMMING = Effect(
    id="humming_force",
    family="force",
    title="Periodic force at a frequency of its own",
    formula=r"a_r \cos 2 \pi f_h t + b_r \sin 2 \pi f_h t",
    amplitudes=tuple(
        Amplitude(part, "force", f"{letter}_r", f"{part} part of a hum, by run", by_run=True)
        for part, letter in (("cosine", "a"), ("sine", "b"))
    ),
    places=_driven_balances,
    change=_add_line,
    shapes=(ShapeParameter("frequency", "Hz", "f_h", "frequency of a hum", _LINE),),
    source="Fisher (1929), Proc. R. Soc. A 125, 54-59, for the line that it starts from",
    applies_to="balances of forces of driven models, in transient runs with a line that no input"
    " has",
    driven=True,
    kind="transient",
    shown=lambda scales: scales.dominant_frequency is not None,
)

# The quantity must be an acceleration; a force of this name does not count.
GRAVITY_ERROR = error_of(
    GRAVITY,
    "m/s**2",
    Amplitude("gravity_error", "parameter", r"\Delta g", "acceleration beyond that stated"),
    family="force",
    title="Gravity error (a rig that is not upright)",
    formula=r"g + \Delta g",
    source="Verbeek (1993), eq. 6.1: the weight",
    applies_to=f"models that declare {GRAVITY}",
)

EFFECTS = (CONSTANT, OFFSET_BY_RUN, PERIODIC, HUMMING, DRIFTING, MASS, GRAVITY_ERROR)
