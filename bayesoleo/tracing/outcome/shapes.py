"""The shape of a nonparametric effect, with its uncertainty: what is shown instead of a name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo._types import Array, Float
from bayesoleo.effects.unnamed import Axis, NonparametricEffect, balance_unit_at
from bayesoleo.tracing.deciding.loop import ClosedLoop
from bayesoleo.tracing.deciding.state import State

#: Points at which a function of one quantity is shown, and of each of two.
POINTS, POINTS_OF_TWO = 201, 31
#: How one quantity is laid out beside another.
POINT, QUANTITY = "point", "quantity"


@dataclass(frozen=True)
class EstimatedCurve:
    """An estimated function of one or two quantities.

    Parameters
    ----------
    effect, target : str
        Its id, and the balance that it is a term of.
    axes : tuple of Axis
        The quantities.
    unit : str
        Of its values, SI.
    places : ndarray, shape (q, M)
        Values of the quantities.
    value, sd : ndarray, shape (M,)
        The function, and its standard deviation by the posterior's Laplace approximation. Values
        are beside what the model's own terms do: what they could do as well is theirs.
    """

    effect: str
    target: str
    axes: tuple[Axis, ...]
    unit: str
    places: Float[Array, "quantities points"]
    value: Float[Array, " points"]
    sd: Float[Array, " points"]


def shapes(state: State) -> Iterator[EstimatedCurve]:
    """Every nonparametric effect of a fitted model.

    Parameters
    ----------
    state : State
        Whose model may have some.
    """
    fit = state.fit
    for step in state.assembly.steps:
        effect = step.effect
        if not isinstance(effect, NonparametricEffect) or effect.spline is None:
            continue
        spline = effect.spline
        index = [fit.problem.names.index(name) for name in step.amplitudes]
        value, covariance = fit.point.theta[index], fit.point.covariance[np.ix_(index, index)]
        places = _grid(spline.axes)
        basis = spline.basis(*places)
        variance = np.einsum("kn,kl,ln->n", basis, covariance, basis)
        unit = balance_unit_at(state.assembly.native, spline.target)
        yield EstimatedCurve(
            effect.id,
            spline.target,
            spline.axes,
            unit,
            places,
            value @ basis,
            np.sqrt(np.clip(variance, 0.0, None)),
        )


def _grid(axes: tuple[Axis, ...]) -> Array:
    count = POINTS if len(axes) == 1 else POINTS_OF_TWO
    rows = [np.linspace(axis.low, axis.high, count) for axis in axes]
    return np.array([grid.ravel() for grid in np.meshgrid(*rows, indexing="ij")])


def shape_group(loop: ClosedLoop) -> xr.Dataset | None:
    """The group ``nonparametric`` of a closed loop; None where it has no such effect."""
    found = next(shapes(loop.final), None)
    if found is None:
        return None
    names = [axis.name for axis in found.axes]
    about = {schema.UNITS: found.unit, schema.LONG_NAME: f"{found.effect} in {found.target}"}
    data = {
        "place": xr.Variable((QUANTITY, POINT), found.places, {schema.LONG_NAME: "quantities"}),
        "value": xr.Variable(POINT, found.value, about),
        "sd": xr.Variable(
            POINT, found.sd, {schema.UNITS: found.unit, schema.LONG_NAME: "standard deviation"}
        ),
        "quantity_unit": xr.Variable(QUANTITY, np.array([axis.unit for axis in found.axes])),
    }
    attributes = {"effect": found.effect, "target": found.target}
    return xr.Dataset(data, coords={QUANTITY: np.array(names)}, attrs=attributes)
