"""Force-like effects in a few lines: an expression in the position and the velocity of a place.

Constant, periodic and drifting forces, and inertia, are built in.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp

from bayesoleo.effects._effect import (
    BY_RUN,
    Effect,
    Names,
    check_names,
    check_null,
    check_states,
    check_unit,
    error_of,
    free_name,
)
from bayesoleo.effects._parts import (
    HIGHEST_LINE,
    Amplitude,
    Constant,
    Scales,
    ShapeParameter,
    coordinate_of,
    position_range,
    velocity_grid,
)
from bayesoleo.effects._places import (
    Between,
    balance_terms,
    between_places,
    drives,
    force_places,
    is_quantity,
    moving_places,
    place_at,
    resistance_sense,
    resisting_places,
    spring_force,
    with_force,
)
from bayesoleo.errors import InputError
from bayesoleo.model._expressions import COSINE, SINE, TIME, parse, symbol, within
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Coordinate, Dof

#: Corners of dry friction at zero velocity, as a reader sees them.
ARCTANGENT, HYPERBOLIC = "2/pi*atan(v/v0)", "tanh(log(3)/2*v/v0)"
ALGEBRAIC, SATURATION = "v/sqrt(v**2 + 3*v0**2)", "max(-1, min(v/v0/2, 1))"
RATIONAL = "v/(abs(v) + v0)"
#: Smooth signs by corner, over the velocity at which they are one half; the first is the usual one.
_SIGNS: dict[str, Callable[[sp.Expr], sp.Expr]] = {
    ARCTANGENT: lambda ratio: 2 / sp.pi * sp.atan(ratio),
    HYPERBOLIC: lambda ratio: sp.tanh(sp.log(3) / 2 * ratio),
    ALGEBRAIC: lambda ratio: ratio / sp.sqrt(ratio**2 + 3),
    SATURATION: lambda ratio: (sp.Abs(ratio + 2) - sp.Abs(ratio - 2)) / 4,
    RATIONAL: lambda ratio: ratio / (sp.Abs(ratio) + 1),
}
CORNERS = tuple(_SIGNS)
#: The same as formulas.
_FORMULAS = {
    ARCTANGENT: r"\frac{2}{\pi} \arctan(\dot q / v_0)",
    HYPERBOLIC: r"\tanh(\frac{\ln 3}{2} \dot q / v_0)",
    ALGEBRAIC: r"\dot q / \sqrt{\dot q^2 + 3 v_0^2}",
    SATURATION: r"\operatorname{clip}(\dot q / 2 v_0, -1, 1)",
    RATIONAL: r"\dot q / (|\dot q| + v_0)",
}

#: A model's own friction slope, in s/m: effects that need a smooth sign use it where it exists.
FRICTION_SLOPE = "friction_slope"

#: Names under which a model may declare the absolute pressure that seals and glands feel.
PRESSURES = ("gas_pressure", "pressure")

#: Words of an expression that a motion between two bodies has, and those that it has not: inertia
#: is that of a body.
_OF_A_DIFFERENCE = {"position", "velocity", "direction"}
_OF_A_BODY = {"acceleration", "spring_force"}
_NEED_VELOCITY = {"velocity", "acceleration", "direction", "largest_velocity"}
_NEED_POSITION = {"position", "lowest_position", "highest_position"}


@dataclass(frozen=True)
class InternalState:
    """A new first-order dof that an effect brings with it, such as the memory of friction.

    Parameters
    ----------
    equation : str
        Left-hand side of its equation; the state goes by its own name, ``dot(name)`` its rate.
    unit : str
        SI unit.
    description : str
        Its meaning.
    """

    equation: str
    unit: str = ""
    description: str = ""


def force_effect(
    id: str,  # noqa: A002 - the word that users of a catalogue know
    family: str,
    expression: str,
    parameters: Mapping[str, str | Amplitude],
    *,
    formula: str = "",
    title: str = "",
    shapes: tuple[ShapeParameter, ...] = (),
    states: Mapping[str, InternalState] | None = None,
    requires: tuple[str, ...] = (),
    source: str = "",
    applies_to: str = "",
) -> Effect:
    r"""An effect that adds a resisting force to the balance of forces.

    It acts in the equations of dofs that are of second order or velocities, or on the output of a
    force law. At a velocity of which no dof is the position, an effect that needs one does not act.
    In a system of other first-order dofs an effect that needs no velocity acts in every equation.
    Between two dofs it acts on both, with opposite signs (:func:`between_places`).

    Parameters
    ----------
    id : str
        Canonical name, an identifier; the new term is called so.
    family : str
        See :data:`bayesoleo.effects.FAMILIES`.
    expression : str
        The force. It may use ``position``, ``velocity``, ``acceleration``; ``direction``, a smooth
        sign of the velocity; ``spring_force``, the sum of the balance's terms that follow position
        alone; ``pressure``, the model's definition ``gas_pressure`` or ``pressure``;
        ``largest_velocity``, ``lowest_position``, ``highest_position`` along the estimated motion;
        names listed in ``requires``; and its own parameters, shapes and states.
    parameters : mapping of str to str or Amplitude
        Amplitudes, zero at the null, and their units, in which the words ``force`` and ``position``
        stand for the units of the place: ``{"k3": "force/position**3"}``.
    formula, title : str, optional
        LaTeX and a few words; by default made from the expression and the id.
    shapes : tuple of ShapeParameter
        Parameters that are undefined at the null, with their scan grids.
    states : mapping of str to InternalState
        New first-order dofs.
    requires : tuple of str
        Names that a model must declare for the effect to apply.
    source, applies_to : str
        For listings.

    Raises
    ------
    InputError
        If the expression uses an undeclared name or does not use a parameter; if it is not zero
        where its amplitudes are, or is not in the unit of a force.

    Examples
    --------
    >>> effect = force_effect(
    ...     "seventh_order_stiffness", "stiffness", "k7*position**7", {"k7": "force/position**7"}
    ... )
    >>> effect.title, effect.formula
    ('Seventh order stiffness', '\\mathrm{k7} q^{7}')
    """
    amplitudes = tuple(
        unit if isinstance(unit, Amplitude) else Amplitude(name, unit, name, f"{id}: {name}")
        for name, unit in parameters.items()
    )
    term = AddedTerm(id, expression, tuple((states or {}).items()), requires)
    term.check(amplitudes, shapes)
    return term.as_effect(
        family, amplitudes, formula=formula, title=title, shapes=shapes, source=source,
        applies_to=applies_to,
    )  # fmt: skip


def resisting_side(model: Model, target: str) -> int:
    """The likely sign of what damps: motion is resisted, unless a declared term did so too much."""
    place = place_at(model, target)
    return 1 if place.kind == "equation" else place.sign * resistance_sense(model, place)


def single_force(amplitude: Amplitude, family: str, expression: str, **more: Any) -> Effect:
    """A built-in :func:`force_effect` with one amplitude, after which it is named.

    Its checks are made by the tests: they would take a sixth of the time in which libraries load.
    """
    states, requires, over = (more.pop(k, d) for k, d in _OF_THE_TERM.items())
    term = AddedTerm(amplitude.name, expression, tuple(states.items()), requires, over)
    return term.as_effect(family, (amplitude,), **more)


_OF_THE_TERM: dict[str, Any] = {"states": {}, "requires": (), "over": ""}


def _latex(expression: str, used: set[str], effect: str) -> str:
    """LaTeX of an expression."""
    words = {"position": "q", "velocity": r"\dot q", "acceleration": r"\ddot q"}
    known = {name: symbol(name) for name in used}
    symbols = {symbol(k): words.get(k, rf"\mathrm{{{k}}}".replace("_", r"\_")) for k in used}
    return str(sp.latex(parse(expression, known, (), f"effect {effect}"), symbol_names=symbols))


def _lowest(model: Model, target: str, scales: Scales) -> float:
    return position_range(model, target, scales)[0]


def _highest(model: Model, target: str, scales: Scales) -> float:
    return position_range(model, target, scales)[1]


def _largest(model: Model, target: str, scales: Scales) -> float:
    return scales.velocity[coordinate_of(model, target)]


HIGHEST = Constant("highest_position", "position", "highest position reached", _highest)
_MOTION_CONSTANTS = (
    Constant("largest_velocity", "position/s", "reference velocity", _largest),
    Constant("lowest_position", "position", "lowest position reached", _lowest),
    HIGHEST,
)


#: What is said of the velocity of a corner.
TRANSITION = "velocity at which friction has half its final size"


def transition_velocity(name: str) -> ShapeParameter:
    """The velocity of a smooth sign, to be scanned."""
    return ShapeParameter(name, "position/s", "v_0", TRANSITION, velocity_grid(1 / 512, 1 / 4))


#: Velocity over which the sign of a dry friction force changes, where the model states no slope.
SMOOTHING = replace(
    transition_velocity("smoothing"), needed=lambda model: FRICTION_SLOPE not in model.parameters
)


def _names_in(text: str, effect: str) -> set[str]:
    try:
        tree = ast.parse(text, mode="eval")
    except SyntaxError as error:
        hint = "write it as in Python, e.g. k*position**3"
        raise InputError(f"effect {effect}: not an expression", value=text, hint=hint) from error
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    called = {function.id for function in calls if isinstance(function, ast.Name)}
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)} - called


def _places_for(used: set[str], requires: tuple[str, ...]) -> Callable[[Model], tuple[str, ...]]:
    """The places of an expression that uses these names."""

    def places(model: Model) -> tuple[str, ...]:
        if not is_quantity(model, *requires):
            return ()
        if "pressure" in used and _pressure(model) is None:
            return ()
        found = moving_places(model) if used & _NEED_VELOCITY else force_places(model)
        if "spring_force" in used:
            found = {k: item for k, item in found.items() if spring_force(model, item) != 0}
        elif used & _OF_A_DIFFERENCE and not used & _OF_A_BODY:
            found = {**found, **between_places(model)}
        if used & _NEED_POSITION:
            found = {k: item for k, item in found.items() if item.position is not None}
        return tuple(found)

    return places


def _applies_to(used: set[str], requires: tuple[str, ...]) -> str:
    base = "equations of motion and force laws"
    if used & _OF_A_DIFFERENCE and not used & _OF_A_BODY:
        base += ", between two dofs"
    if not used & _NEED_VELOCITY:
        base += ", first-order systems"
    needed = [*requires, *(["gas_pressure"] if "pressure" in used else [])]
    return base + (f" of models that declare {', '.join(needed)}" if needed else "")


def _pressure(model: Model) -> sp.Symbol | None:
    for name in PRESSURES:
        if name in model.definitions:
            return symbol(name)
    return None


@dataclass(frozen=True)
class AddedTerm:
    """The change that adds the states and the force of an effect.

    Parameters
    ----------
    effect : str
        Id of the effect.
    expression : str
        The force.
    states : tuple of (str, InternalState)
        New dofs by name.
    requires : tuple of str
        Names that a model must declare.
    over : str
        The effect's own shape over which ``direction`` changes; by default the smoothing velocity
        or the model's slope.
    corner : str
        One of :data:`CORNERS`: the form of ``direction``.
    """

    effect: str
    expression: str
    states: tuple[tuple[str, InternalState], ...] = ()
    requires: tuple[str, ...] = ()
    over: str = ""
    corner: str = ARCTANGENT

    def used(self) -> set[str]:
        """All names in the force and in the equations of the states."""
        texts = [self.expression, *(state.equation for _, state in self.states), self.over or "0"]
        return set[str]().union(*(_names_in(text, self.effect) for text in texts))

    def check(
        self, amplitudes: tuple[Amplitude, ...], shapes: tuple[ShapeParameter, ...] = ()
    ) -> None:
        """Check names, states, null and unit.

        Raises
        ------
        InputError
            See :func:`force_effect`.
        """
        used, id_ = self.used(), self.effect
        states = dict(self.states)
        own = {item.name for item in amplitudes} | {shape.name for shape in shapes} | set(states)
        check_names(used, own, set(self.requires), id_)
        check_states(states, used, id_)
        in_force = _names_in(self.expression, id_)
        check_null(self.expression, in_force, amplitudes, id_)
        check_unit(self.expression, in_force, amplitudes, shapes, states, id_)

    def as_effect(
        self,
        family: str,
        amplitudes: tuple[Amplitude, ...],
        *,
        formula: str = "",
        title: str = "",
        shapes: tuple[ShapeParameter, ...] = (),
        source: str = "",
        applies_to: str = "",
    ) -> Effect:
        """The effect; parameters as of :func:`force_effect`."""
        used = self.used()
        return Effect(
            id=self.effect,
            family=family,
            title=title or self.effect.replace("_", " ").capitalize(),
            formula=formula or _latex(self.expression, used, self.effect),
            amplitudes=amplitudes,
            places=_places_for(used, self.requires),
            change=self,
            shapes=(*shapes, SMOOTHING) if "direction" in used and not self.over else shapes,
            constants=tuple(item for item in _MOTION_CONSTANTS if item.name in used),
            source=source,
            applies_to=applies_to or _applies_to(used, self.requires),
        )

    def __call__(self, model: Model, target: str, names: Names) -> Model:
        """The model with the term at one place."""
        place, effect = place_at(model, target), self.effect
        dofs = {own: free_name(f"{effect}_{own}", model) for own, _ in self.states}
        known = _vocabulary(model, place, names) | {own: symbol(n) for own, n in dofs.items()}
        if place.velocity is not None and self._has_direction(model, names):
            over = names.get(self.over or "smoothing")
            known["direction"] = smooth_sign(model, place.velocity, over, self.corner)
        dynamic = (*model.dofs, *model.inputs, *dofs.values())
        where = f"effect {effect}"
        for own, state in self.states:
            equation = {"memory": parse(state.equation, known, dynamic, where)}
            dof = Dof(state.unit, 0.0, state.description)
            model = model.with_dof(dofs[own], dof, equation)
        force = parse(self.expression, known, dynamic, where)
        # An output shows the force itself; in an equation the force has the sign of the inertia.
        return with_force(model, place, _free_term(effect, model, place), force)

    def _has_direction(self, model: Model, names: Names) -> bool:
        return bool(self.over) or "smoothing" in names or FRICTION_SLOPE in model.parameters

    def has_corner(self, model: Model) -> bool:
        """Whether it is dry friction whose corner is not that of the model's own friction."""
        if "direction" not in self.used():
            return False
        return bool(self.over) or FRICTION_SLOPE not in model.parameters


def has_corner(effect: Effect, model: Model) -> bool:
    """Whether an effect is dry friction whose corner the model does not state."""
    return isinstance(effect.change, AddedTerm) and effect.change.has_corner(model)


def with_corner(effect: Effect, corner: str) -> Effect:
    """An effect with another corner of dry friction; any other effect as it is.

    The velocity at which friction has half its final size stays the parameter of the corner.

    Parameters
    ----------
    effect : Effect
    corner : str
        One of :data:`CORNERS`.
    """
    term = effect.change
    if not isinstance(term, AddedTerm) or term.corner == corner or "direction" not in term.used():
        return effect
    formula = effect.formula.replace(_FORMULAS[term.corner], _FORMULAS[corner])
    return replace(effect, change=replace(term, corner=corner), formula=formula)


def _free_term(name: str, model: Model, place: Coordinate) -> str:
    """A name that no term of the balance has: an effect may act on a body and between bodies."""
    taken = set(balance_terms(model, place))
    if isinstance(place, Between):
        taken |= set(model.equations.get(place.other, {}))
    return name if name not in taken else f"{name} {place.name}"


def _vocabulary(model: Model, place: Coordinate, names: Names) -> dict[str, sp.Expr]:
    """The names that an effect's expression may use, as expressions of the model."""
    own: tuple[str, ...] = (*model.inputs, *model.dofs, *model.parameters)
    own += (*model.conditions, *model.definitions)
    known: dict[str, sp.Expr] = {name: symbol(name) for name in own}
    if place.position is not None:
        known |= {"position": place.position}
    if not isinstance(place, Between):
        known["spring_force"] = place.sign * spring_force(model, place)
    pressure = _pressure(model)
    if pressure is not None:
        known["pressure"] = pressure
    if place.velocity is not None:
        known |= {"velocity": place.velocity, "acceleration": place.acceleration}
    return known | dict(names)


def smooth_sign(
    model: Model, velocity: sp.Expr, over: sp.Symbol | None, corner: str = ARCTANGENT
) -> sp.Expr:
    r"""Sign of a velocity, :math:`\frac{2}{\pi}\arctan(v/v_0)` (Verbeek 1993, eq. 6.1), or with
    another corner.

    Without a velocity to change over, the model's own ``friction_slope`` is :math:`1/v_0`, and the
    corner is the arctangent of the model's own friction.
    """
    if over is None:
        return _SIGNS[ARCTANGENT](symbol(FRICTION_SLOPE) * velocity)
    return _SIGNS[corner](velocity / over)


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
    if place.kind == "equation" or any(model.expand(one).has(place.acceleration) for one in terms):
        return 0
    return place.sign * resistance_sense(model, place)


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
    shapes=(ShapeParameter("frequency", "Hz", "f_h", "frequency of a hum", HIGHEST_LINE),),
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
