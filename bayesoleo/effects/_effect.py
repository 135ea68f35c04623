"""Effects: small changes of a model, with parameters, null values and checks.

An effect is a frozen value that says where in a model it applies (:attr:`Effect.places`) and how it
changes the model there (:attr:`Effect.change`). :meth:`Effect.extend` makes the extended model at
the null: with the new amplitudes at their null value it predicts the same as the old model, so that
a score test needs no refit.

The checks of a declared effect (names, null, units, scan grids) need no model.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import sympy as sp

from bayesoleo.effects._parts import Amplitude, Constant, Scales, ShapeParameter, always
from bayesoleo.effects._places import (
    is_quantity,
    measures,
    parse_unit,
    substitute,
    target_units,
    unit_of,
    unit_text,
)
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model._expressions import FUNCTIONS, derivative_symbol, parse, symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Parameter
from bayesoleo.model._priors import LogNormal

OF_THE_PLACE = ("position", "velocity", "acceleration", "direction", "spring_force", "pressure")
OF_THE_MOTION = ("largest_velocity", "lowest_position", "highest_position")
#: Units at a place where a force acts on a length, to try an expression's units with.
_UNITS = {
    "position": "m", "velocity": "m/s", "acceleration": "m/s**2", "direction": "",
    "spring_force": "N", "pressure": "Pa", "largest_velocity": "m/s", "lowest_position": "m",
    "highest_position": "m",
}  # fmt: skip


def check_names(used: Collection[str], own: Collection[str], allowed: set[str], id_: str) -> None:
    """Check that names are declared, parameters are used, and none hides a word of the place."""
    taken = sorted({*OF_THE_PLACE, *OF_THE_MOTION, "pi"} & set(own))
    if taken:
        hint = "this name stands for a quantity of the place; call the parameter something else"
        raise InputError(f"effect {id_}: name is reserved", value=taken[0], hint=hint)
    known = {*own, *allowed, *OF_THE_PLACE, *OF_THE_MOTION, "pi"}
    for name in sorted(set(used) - known):
        close = difflib.get_close_matches(name, [*known, *FUNCTIONS], 1)
        hint = f"did you mean {close[0]}?" if close else "list names of the model in requires"
        raise InputError(f"effect {id_}: unknown name", value=name, hint=hint)
    idle = sorted(set(own) - set(used))
    if idle:
        hint = "use it in the expression, or leave it out"
        raise InputError(f"effect {id_}: {idle[0]!r} is not used", hint=hint)


def check_null(
    expression: str, used: Iterable[str], amplitudes: Sequence[Amplitude], id_: str
) -> None:
    """Check that the force vanishes where its amplitudes are zero, without division by one."""
    force = _parsed(expression, used, id_)
    at_null = force.subs({symbol(item.name): sp.Integer(0) for item in amplitudes})
    if amplitudes and at_null != 0 and sp.simplify(at_null) != 0:
        raise InputError(
            f"effect {id_}: is not zero where its amplitudes are",
            value=expression,
            hint="multiply each term by an amplitude",
        )


def check_unit(
    expression: str,
    used: Iterable[str],
    amplitudes: Sequence[Amplitude],
    shapes: Sequence[ShapeParameter],
    states: Mapping[str, Any],
    id_: str,
) -> None:
    """Check that the expression is a force, if its units are stated in words of the place.

    Expressions with bare numbers, or with units in other words, are not checked.
    """
    units = {item.name: item.unit for item in amplitudes}
    units |= {shape.name: shape.unit for shape in shapes}
    if not any("force" in item.unit for item in amplitudes):
        return
    words = {"force": "N", "position": "m"}
    for name, unit in units.items():
        for word, short in words.items():
            unit = unit.replace(word, f"({short})")
        units[name] = unit
    units |= _UNITS | {name: state.unit for name, state in states.items()}
    quantities = {name: SimpleNamespace(unit=unit) for name, unit in units.items()}
    stub: Any = SimpleNamespace(
        definitions={}, inputs={}, dofs={}, parameters=quantities, conditions={}
    )
    try:
        found = unit_of(_parsed(expression, used, id_), stub)
    except (ModelError, KeyError):
        return
    if found == parse_unit("N"):
        return
    problem = (
        f"effect {id_}: is not in the unit of a force, but of {unit_text(found) or 'a number'}"
    )
    hint = "where positions are in m and forces in N"
    if len(amplitudes) == 1:
        (item,) = amplitudes
        right = _over(found / parse_unit(units[item.name]))
        hint = f"state {item.name} in {right}" if right else hint
    raise InputError(problem, value=expression, hint=hint)


def _over(unit: Any) -> str:
    """The unit of a factor of this unit that makes a force of it, in words of the place."""
    powers = {str(name): power for name, power in unit._units.items()}
    known = {"meter": "position", "second": "s"}
    if not set(powers) <= set(known):
        return ""
    parts = [f"{word}**{-powers[n]:g}" for n, word in known.items() if powers.get(n)]
    return "*".join(["force", *parts])


def check_states(states: Mapping[str, Any], used: Iterable[str], id_: str) -> None:
    """Check that each state's equation contains its rate."""
    for name, state in states.items():
        equation = _parsed(state.equation, used, id_)
        if not equation.has(derivative_symbol(name, 1)):
            hint = f"write its equation with dot({name})"
            problem = f"effect {id_}: state {name!r} has no rate"
            raise InputError(problem, value=state.equation, hint=hint)


def check_grid(values: tuple[float, ...], shape: str, id_: str) -> None:
    """Check that a scan grid is ascending and positive, because shapes have log-normal priors."""
    grid = np.asarray(values, dtype=float)
    if grid.size == 0 or not (
        np.isfinite(grid).all() and grid[0] > 0 and (np.diff(grid) > 0).all()
    ):
        raise InputError(
            f"effect {id_}: the scan of {shape!r} is not ascending and positive",
            value=values,
            hint="state the shape as a positive length, velocity or time",
        )


def _parsed(expression: str, used: Iterable[str], id_: str) -> sp.Expr:
    known = {name: symbol(name) for name in used}
    return parse(expression, known, tuple(known), f"effect {id_}")


#: Kinds of effects, in the order in which they are listed.
FAMILIES = (
    "damping",
    "friction",
    "stiffness",
    "contact",
    "dependence",
    "force",
    "gas",
    "thermal",
    "compliance",
    "sensor",
    "run-to-run",
    "clock",
    "nonparametric",
)

#: Source of effects that differ from run to run.
BY_RUN = "Gelman et al. (2013), Bayesian Data Analysis, chapter 5: parameters that vary by group"

#: Standard deviation of the placeholder prior of a new amplitude, in its unit. A fit of the
#: extended model rescales it to the size that the data suggest.
PLACEHOLDER_SD = 1.0


@dataclass(frozen=True)
class Candidate:
    """One effect at one place of one model.

    Parameters
    ----------
    effect, family : str
        Canonical id of the effect, and its family.
    target : str
        The place: an equation's dof, a channel, a definition or a parameter.
    model : Model
        The extended model, at the null, in the drive of the model it was made from.
    parameters : tuple of str
        The new amplitudes. At their ``value`` (the null) the extended model equals the old one.
        Their priors are placeholders with standard deviation :data:`PLACEHOLDER_SD`.
    sign : mapping of str to int
        By amplitude: +1 or -1 where only one side of the null is physical, else 0.
    shapes : mapping of str to tuple of float
        By shape parameter the values to scan, ascending, neighbours at most a factor of two apart.
        Shapes are undefined at the null; they are estimated (log-normal prior) once the effect is
        added. A grid of one value is not scanned.
    usual : mapping of str to int
        By amplitude: +1 or -1 where the other side of the null is possible, but an unlikely cause.
    """

    effect: str
    family: str
    target: str
    model: Model
    parameters: tuple[str, ...]
    sign: Mapping[str, int] = field(default_factory=dict)
    shapes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    usual: Mapping[str, int] = field(default_factory=dict)


#: Symbols of the new parameters under their names in the effect.
Names = Mapping[str, sp.Symbol]


def either_side(model: Model, target: str) -> int:
    """Both sides of the null are equally likely."""
    return 0


@dataclass(frozen=True)
class Effect:
    r"""A physical effect that a model may lack.

    Parameters
    ----------
    id : str
        Canonical name, an identifier.
    family : str
        One of :data:`FAMILIES`.
    title : str
        A few words.
    formula : str
        LaTeX.
    amplitudes : tuple of Amplitude
        At least one; all are zero at the null.
    places : callable (model) -> sequence of str
        Targets where it applies; empty where it does not.
    change : callable (model, target, names) -> Model
        Extends the model, to which the new parameters have been added already; ``names`` maps the
        effect's own names of them to their symbols.
    shapes : tuple of ShapeParameter
        Usually none or one, at most two.
    constants : tuple of Constant
        Fixed numbers with a unit.
    source : str
        Reference.
    applies_to : str
        In words, for listings.
    own_name_per_target : bool
        Name parameters after the target even where only one target exists.
    driven : bool
        Whether it changes the model as the rig drives it; sensors and compliance always do.
    kind : str
        ``periodic`` or ``transient`` where only such runs determine it; else empty.
    shown : callable (scales) -> bool
        Whether the runs show the feature that the scan needs, such as a spectral line.
    side : callable (model, target) -> int
        +1 or -1 where one side of the null is the likely one at a place, else 0.

    Raises
    ------
    InputError
        If the id, the family or the formula cannot be used.

    See Also
    --------
    bayesoleo.effects.force_effect : a force-like effect in a few lines.
    """

    id: str
    family: str
    title: str
    formula: str
    amplitudes: tuple[Amplitude, ...]
    places: Callable[[Model], Sequence[str]]
    change: Callable[[Model, str, Names], Model]
    shapes: tuple[ShapeParameter, ...] = ()
    constants: tuple[Constant, ...] = ()
    source: str = ""
    applies_to: str = "every model"
    own_name_per_target: bool = False
    driven: bool = False
    kind: str = ""
    shown: Callable[[Scales], bool] = always
    side: Callable[[Model, str], int] = either_side

    def __post_init__(self) -> None:
        if not self.id.isidentifier():
            raise InputError("effect id is not an identifier", value=self.id, hint="e.g. play_2")
        if self.family not in FAMILIES:
            allowed = f"choose one of {', '.join(FAMILIES)}"
            raise InputError(f"effect {self.id}: unknown family", value=self.family, hint=allowed)
        if not self.amplitudes:
            raise InputError(f"effect {self.id}: no parameters", hint="state at least one")

    @property
    def on_channels(self) -> bool:
        """Whether it depends on the channel that drives the model."""
        return self.driven or self.family in ("sensor", "compliance")

    def fits(self, scales: Scales) -> bool:
        """Whether the runs are of the kind that it needs and show the feature that it scans."""
        return (not self.kind or scales.kinds == {self.kind}) and self.shown(scales)

    @property
    def _parts(self) -> tuple[Amplitude | ShapeParameter | Constant, ...]:
        return (*self.amplitudes, *self.shapes, *self.constants)

    @property
    def units(self) -> dict[str, str]:
        """Units of all new parameters, in words of the place."""
        return {part.name: part.unit for part in self._parts}

    def names(self, model: Model, target: str) -> dict[str, str]:
        """Parameter names in the model by names in the effect, before collisions are resolved."""
        many = self.own_name_per_target or len(self.places(model)) > 1
        suffix = "_" + re.sub(r"\W+", "_", target) if many else ""
        return {part.name: _with_prefix(self.id, part.name) + suffix for part in self._parts}

    def is_in(self, model: Model, target: str) -> bool:
        """Whether the model has this effect at this target."""
        present = model.parameters.get(self.names(model, target)[self.amplitudes[0].name])
        return present is not None and present.description == self.amplitudes[0].description

    def extend(self, model: Model, target: str, scales: Scales) -> Candidate:
        """The candidate of this effect at one target.

        Parameters
        ----------
        model : Model
            The model in its own drive.
        target : str
            One of ``places(model)``.
        scales : Scales
            Sizes of the motion, for the grids of shape parameters.

        Raises
        ------
        ModelError
            If the effect does not apply there.
        """
        if target not in self.places(model):
            where = ", ".join(self.places(model)) or "nowhere in this model"
            raise ModelError(f"effect {self.id} does not apply to {target!r}", hint=where)
        names = {own: free_name(name, model) for own, name in self.names(model, target).items()}
        shapes = [shape for shape in self.shapes if shape.needed(model)]
        grids = {shape.name: shape.grid(model, target, scales) for shape in shapes}
        for name, grid in grids.items():
            check_grid(grid, name, self.id)
        new = self._parameters(model, target, scales, grids)
        bare = model.with_parameters(**{names[own]: value for own, value in new.items()})
        extended = self.change(bare, target, {own: symbol(names[own]) for own in new})
        return Candidate(
            effect=self.id,
            family=self.family,
            target=target,
            model=extended,
            parameters=tuple(names[item.name] for item in self.amplitudes),
            sign={names[item.name]: item.sign for item in self.amplitudes},
            usual={names[item.name]: self.side(model, target) for item in self.amplitudes},
            shapes={names[own]: grid for own, grid in grids.items()},
        )

    def _parameters(
        self, model: Model, target: str, scales: Scales, grids: Mapping[str, tuple[float, ...]]
    ) -> dict[str, Parameter]:
        units = target_units(model, target)
        new = {}
        for item in self.amplitudes:
            new[item.name] = Parameter(
                0.0,
                units.resolve(item.unit),
                sd=PLACEHOLDER_SD,
                by_run=item.by_run,
                latex=item.latex,
                description=item.description,
            )
        for shape in self.shapes:
            if shape.name in grids:
                prior = _shape_prior(grids[shape.name])
                unit = units.resolve(shape.unit)
                new[shape.name] = Parameter(
                    prior.median,
                    unit,
                    prior=prior,
                    latex=shape.latex,
                    description=shape.description,
                )
        for constant in self.constants:
            value, unit = constant.value(model, target, scales), units.resolve(constant.unit)
            new[constant.name] = Parameter(
                value, unit, fixed=True, description=constant.description
            )
        return new


def _shape_prior(grid: tuple[float, ...]) -> LogNormal:
    """Prior about the grid's geometric mean, with the ends at one standard deviation."""
    middle = float(np.sqrt(grid[0] * grid[-1]))
    # The prior of a single value has a spread of a factor of two.
    return LogNormal(middle, max(0.5 * float(np.log(grid[-1] / grid[0])), float(np.log(2.0))))


def _with_prefix(effect: str, name: str) -> str:
    return name if name.startswith(effect) else f"{effect}_{name}"


def free_name(name: str, model: Model) -> str:
    """The name, or the first of ``name_2, name_3, …`` that the model does not use yet."""
    if not is_quantity(model, name):
        return name
    numbered = (f"{name}_{number}" for number in itertools.count(2))
    return next(one for one in numbered if not is_quantity(model, one))


def error_of(
    quantity: str, unit: str, amplitude: Amplitude, *, relative: bool = False, **more: Any
) -> Effect:
    """An effect that corrects a stated quantity by a new parameter, wherever a model uses it.

    Parameters
    ----------
    quantity, unit : str
        Its name, and the unit that it must have where one is declared.
    amplitude : Amplitude
        The error; the effect is named after it.
    relative : bool
        Whether it multiplies the quantity by one plus itself; else it is added.
    **more
        Further fields of the effect.
    """

    def places(model: Model) -> Sequence[str]:
        declared = is_quantity(model, quantity) and measures(model, quantity, unit)
        return (quantity,) if declared else ()

    def change(model: Model, target: str, names: Names) -> Model:
        old, error = symbol(target), names[amplitude.name]
        return substitute(model, {old: old * (1 + error) if relative else old + error})

    return Effect(id=amplitude.name, amplitudes=(amplitude,), places=places, change=change, **more)
