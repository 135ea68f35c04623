"""Nonparametric effects: any smooth function of one or two quantities, as a term of a balance.

The function is a sum of cubic B-splines on equal pieces of the range that the motion covers. Beyond
that range the function is unknown and fades to zero within three pieces. In two quantities it is a
sum over products. A function may be multiplied by the direction of the motion, as a friction is.
What the present model can produce already is removed: some coefficients depend on the others, so
that both keep their meaning.

References
----------
de Boor (1978), A Practical Guide to Splines; Eilers and Marx (1996), Statistical Science 11(2).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.effects._effect import Effect, Names, free_name
from bayesoleo.effects._parts import Amplitude
from bayesoleo.effects._places import force_places, target_units
from bayesoleo.model._expressions import bspline, symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Coordinate

FAMILY = "nonparametric"
#: How the description of a coefficient begins, by which it is known in a model.
COEFFICIENT = "coefficient of a spline"
#: Part of the range by which splines reach beyond it, lest the motion turn on their edge.
MARGIN = 0.01
#: Digits of the numbers in an effect's expression: more than any figure shows.
DIGITS = 10


@dataclass(frozen=True)
class Axis:
    """A quantity that a nonparametric effect follows.

    Parameters
    ----------
    name : str
        As it is called: ``stroke``, ``velocity of stroke``, ``temperature``, ``gas_pressure``.
    expression : sympy.Expr
        In the names of the model.
    unit : str
        SI.
    low, high : float
        Range that the splines cover.
    """

    name: str
    expression: sp.Expr
    unit: str
    low: float
    high: float

    @classmethod
    def covering(cls, name: str, expression: sp.Expr, unit: str, values: Array) -> Axis:
        """With a range a little wider than that of some values."""
        low, high = float(values.min()), float(values.max())
        more = MARGIN * (high - low)
        return cls(name, expression, unit, low - more, high + more)

    def together(self, other: Axis) -> Axis:
        """With a range that covers another's of the same quantity too."""
        return replace(self, low=min(self.low, other.low), high=max(self.high, other.high))

    @property
    def word(self) -> str:
        """The name as part of an identifier."""
        return re.sub(r"\W+", "_", self.name).strip("_")

    def basis(self, values: Array, pieces: int) -> Array:
        """The ``pieces + 3`` splines at some values ``(N,)``, shape (K, N)."""
        place = pieces * ((np.asarray(values) - self.low) / (self.high - self.low))
        found = np.zeros((pieces + 3, place.size))
        found[:, np.isnan(place)] = np.nan
        # Four of them are not zero at a value.
        with np.errstate(invalid="ignore"):
            nearest = np.floor(place)
        for centre in (nearest - 1, nearest, nearest + 1, nearest + 2):
            inside = (centre >= -1) & (centre <= pieces + 1)
            row = centre[inside].astype(np.int64) + 1
            found[row, np.flatnonzero(inside)] = bspline_values((place - centre)[inside])
        return found

    def splines(self, pieces: int) -> list[sp.Expr]:
        """The same as expressions."""
        width = (self.high - self.low) / pieces
        place = (self.expression - _number(self.low)) / _number(width)
        return [bspline(place - int(centre)) for centre in _centres(pieces)]


def bspline_values(t: Array) -> Array:
    """The cardinal cubic B-spline; see :class:`bayesoleo.model._expressions.bspline`."""
    size = np.abs(t)
    far, near = np.maximum(2.0 - size, 0.0), np.maximum(1.0 - size, 0.0)
    # Products: a library's power takes three times as long.
    found: Array = (far * far * far - 4.0 * near * near * near) / 6.0
    return found


def tensor(bases: Sequence[Array]) -> Array:
    """Products of splines in one or two quantities, shapes (K_i, N) to (K_1 K_2, N)."""
    found = bases[0]
    for other in bases[1:]:
        found = (found[:, None] * other[None]).reshape(-1, found.shape[1])
    return found


@dataclass(frozen=True)
class NonparametricEffect(Effect):
    """An effect that remembers of which function it is made."""

    spline: Spline | None = None


@dataclass(frozen=True, eq=False)
class Spline:
    """A smooth function of one or two quantities, in a balance.

    Parameters
    ----------
    target : str
        The equation or output that it is a term of.
    axes : tuple of Axis
    pieces : tuple of int
        Equal parts of each range.
    weights : ndarray, shape (K, r)
        Coefficients of all splines from the free ones, which are the new parameters: column ``i``
        has a one where its own stands.
    direction : sympy.Expr, optional
        By which the function is multiplied: a smooth sign of the velocity there.
    """

    target: str
    axes: tuple[Axis, ...]
    pieces: tuple[int, ...]
    weights: Array
    direction: sp.Expr | None = None

    @property
    def id(self) -> str:
        """Canonical id of the effect, an identifier."""
        name = "_and_".join([f"{FAMILY}_{self.axes[0].word}", *(a.word for a in self.axes[1:])])
        return name if self.direction is None else f"{name}_by_direction"

    @property
    def quantities(self) -> str:
        """What it follows, in words."""
        names = " and ".join(axis.name for axis in self.axes)
        return names if self.direction is None else f"{names}, times the direction"

    def basis(self, *values: Array) -> Array:
        """What each new parameter adds at some values of the quantities, shape (r, N)."""
        parts = [a.basis(v, n) for a, v, n in zip(self.axes, values, self.pieces, strict=True)]
        found: Array = self.weights.T @ tensor(parts)
        return found

    def effect(self) -> NonparametricEffect:
        """The effect, to be estimated like any other."""
        size = self.weights.shape[1]
        unit = "force"
        return NonparametricEffect(
            id=self.id,
            family=FAMILY,
            title=f"Nonparametric: a smooth function of {self.quantities}",
            formula=r"\sum_k a_k B_k("
            + ", ".join(map(_latex, self.axes))
            + ")"
            + ("" if self.direction is None else r" \, s(\dot q)"),
            amplitudes=tuple(
                Amplitude(f"{self.id}_{k}", unit, f"a_{{{k}}}", f"{COEFFICIENT}, {self.id}")
                for k in range(1, size + 1)
            ),
            places=lambda model: (self.target,) if self.target in balance_places(model) else (),
            change=self._add,
            source="de Boor (1978), A Practical Guide to Splines",
            applies_to="the model that it was found for",
            spline=self,
        )

    def _add(self, model: Model, target: str, names: Names) -> Model:
        """A definition that holds the sum, and a term that is its name."""
        place = balance_places(model)[target]
        parts = [a.splines(n) for a, n in zip(self.axes, self.pieces, strict=True)]
        amplitudes = list(names.values())
        sums = [
            sp.Add(*(_number(w) * a for w, a in zip(row, amplitudes, strict=True) if w))
            for row in self.weights
        ]
        # One axis after the other, as compiled code would not group them: fewer products, and the
        # inner sums serve slopes too.
        for splines in reversed(parts):
            count = len(splines)
            rows = [sums[k : k + count] for k in range(0, len(sums), count)]
            sums = [sp.Add(*(b * c for b, c in zip(splines, row, strict=True))) for row in rows]
        (total,) = sums
        name = free_name(self.id, model)
        turned = sp.Integer(1) if self.direction is None else self.direction
        extended = model.with_definition(name, turned * total)
        return extended.with_term(place.kind, place.target, name, place.sign * symbol(name))


def balance_places(model: Model) -> dict[str, Coordinate]:
    """Where a nonparametric effect can act: as a force does, in the equation of any other dof, and
    in a law whose inputs are no motion."""
    places = force_places(model)
    alone = not places and not model.dofs
    for item in model.coordinates():
        if item.target not in places and (item.kind == "equation" or alone):
            places[item.target] = item
    return places


def balance_unit_at(model: Model, target: str) -> str:
    """Unit of a nonparametric effect at a target."""
    return target_units(model, target).resolve("force")


def _centres(pieces: int) -> NDArray[np.int64]:
    return np.arange(-1, pieces + 2)


def _number(value: float) -> sp.Expr:
    return sp.Integer(1) if value == 1 else sp.Float(float(f"{value:.{DIGITS}g}"))


def _latex(axis: Axis) -> str:
    upright = axis.name.replace("_", r"\_").replace(" ", r"\ ")
    return rf"\mathrm{{{upright}}}"
