"""Nonparametric curves: shapes, uncertainty, and parameters they absorb.

A nonparametric effect is shown as a curve with its uncertainty. A smooth function of a quantity can
produce the same change as a parameter of that quantity. While the curve is estimated, such
directions are assigned to the parameter. This is a convention; the data do not determine the
share of the parameter, and its interval does not include this uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Float
from bayesoleo.discovery._assembly import AddedEffect
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._nonparametric_quantities import (
    Forced,
    ModelQuantity,
    Motions,
    quantities_of,
    times_direction,
)
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import Prediction
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._state import State
from bayesoleo.effects._catalogue import in_sentence
from bayesoleo.effects._nonparametric import (
    Axis,
    NonparametricEffect,
    Spline,
    balance_unit_at,
    tensor,
)
from bayesoleo.errors import ModelError
from bayesoleo.solvers._orbit import Status

#: Eigenvalues of unit diagonal matrices below this are round-off.
ROUND_OFF = 1e-10

#: Points at which a function of one quantity is shown, and of each of two.
POINTS, POINTS_OF_TWO = 201, 31
#: How one quantity is laid out beside another.
POINT, QUANTITY = "point", "quantity"


@dataclass(frozen=True)
class Curve:
    """A curve in a fitted model."""

    step: AddedEffect
    spline: Spline

    @property
    def title(self) -> str:
        """What it is called in a sentence."""
        return f"{in_sentence(self.step.effect.title)} ({self.step.target})"


@dataclass(frozen=True)
class CurveFacts:
    """What is to be said of a model's curves beside their shapes.

    Parameters
    ----------
    shared : dict of str to str
        Unknowns whose own part is not known beside a curve, with what the curve is called.
    beyond : tuple of str
        Sentences about held-out runs that leave a curve's range.
    """

    shared: dict[str, str] = field(default_factory=dict)
    beyond: tuple[str, ...] = ()

    @classmethod
    def of(cls, state: State) -> CurveFacts:
        """Of a fitted model."""
        return cls(shared_parameters(state), tuple(beyond_range(state)))

    @property
    def notes(self) -> list[str]:
        """What a reader should know."""
        titles = dict.fromkeys(self.shared.values())
        groups = {title: [n for n, own in self.shared.items() if own == title] for title in titles}
        return [
            f"{', '.join(names)}: shared with {title}, which can do the same; the data do not tell"
            " their parts apart, and no interval is given"
            for title, names in groups.items()
        ] + list(self.beyond)


def curves(state: State) -> Iterator[Curve]:
    """The curves without a name that a model has."""
    for step in state.assembly.steps:
        if isinstance(step.effect, NonparametricEffect) and step.effect.spline is not None:
            yield Curve(step, step.effect.spline)


def shared_parameters(state: State) -> dict[str, str]:
    """Unknowns of which a curve can do so much that their own part is not known, with its title.

    Parameters
    ----------
    state : State
        A fitted model.
    """
    found: dict[str, str] = {}
    base = state.base() if any(True for _ in curves(state)) else None
    for curve in curves(state):
        assert base is not None
        names = list(state.fit.problem.names)
        rows = [k for k, name in enumerate(names) if name not in curve.step.amplitudes]
        products = _products(base, state, curve)
        if products is None:
            continue
        cross, own = products
        part = own_part(base.gram[np.ix_(rows, rows)], cross[rows], own, policy=base.policy)
        for k, value in zip(rows, part, strict=True):
            if value < base.policy.own_part:
                found.setdefault(names[k], curve.title)
    return found


def own_part(
    gram: Array, cross: Array, own: Array, *, policy: SearchPolicy = SearchPolicy()
) -> Array:
    """Part of what the data know of each parameter that is left beside any function of a curve.

    Parameters
    ----------
    gram : ndarray, shape (l, l)
        ``J' W J`` of the parameters.
    cross : ndarray, shape (l, K)
        ``J' W C`` with the curve's splines.
    own : ndarray, shape (K, K)
        ``C' W C``.
    policy : SearchPolicy

    Returns
    -------
    ndarray, shape (l,)
        Information beside the curve over that without it: one where the curve takes nothing over.
    """
    size = np.sqrt(np.clip(np.diag(own), 0.0, None))
    seen = size > policy.resolved_spline * size.max(initial=0.0)
    values, vectors = np.linalg.eigh(own[np.ix_(seen, seen)] / np.outer(size[seen], size[seen]))
    clear = values > policy.distinct_spline * values.max(initial=0.0)
    unit = (vectors[:, clear] / np.sqrt(values[clear])) / size[seen][:, None]
    along = cross[:, seen] @ unit
    scale = 1.0 / np.sqrt(np.clip(np.diag(gram), 1e-300, None))
    whole = gram * np.outer(scale, scale)
    rest = whole - (along * scale[:, None]) @ (along * scale[:, None]).T
    return _information(rest) / _information(whole)


def _information(gram: Array) -> Array:
    """What is known of each unknown beside the others; of unit diagonal before round-off."""
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    inverse = (vectors / values.clip(ROUND_OFF)) @ vectors.T
    return np.asarray(1.0 / np.diag(inverse))


def _products(base: Base, state: State, curve: Curve) -> tuple[Array, Array] | None:
    """``J' W C`` and ``C' W C`` of all splines of a curve; None where they cannot be computed."""
    fit, assembly, spline = state.fit, state.assembly, curve.spline
    motions = Motions(fit, assembly, quantities_of(assembly.native))
    numbers = _numbers(motions, spline)
    if numbers is None:
        return None
    try:
        forced = Forced(fit, assembly, spline.target)
    except ModelError:
        return None
    turn = None
    if spline.direction is not None:
        turn = Motions(fit, assembly, [ModelQuantity("direction", spline.direction, "")])
    parts = []
    for r, run in enumerate(base.runs):
        answer = forced.responses(r, partial(_courses, motions, turn, r, numbers, spline))
        if isinstance(answer, Status):
            return None
        flat = np.moveaxis(answer, 1, 0).reshape(answer.shape[1], -1)
        parts.append(run.products(flat * run.scale)[:2])
    return np.sum([cross for cross, _ in parts], axis=0), np.sum([own for _, own in parts], axis=0)


def _numbers(motions: Motions, spline: Spline) -> list[int] | None:
    """Numbers of a spline's quantities among those of a model."""
    names = [item.name for item in motions.quantities]
    known = [names.index(axis.name) for axis in spline.axes if axis.name in names]
    return known if len(known) == len(spline.axes) else None


def _courses(
    motions: Motions,
    turn: Motions | None,
    r: int,
    numbers: list[int],
    spline: Spline,
    phase: Array,
) -> Array:
    parts = zip(spline.axes, numbers, spline.pieces, strict=True)
    values = tensor([axis.basis(motions.at(r, k, phase), pieces) for axis, k, pieces in parts])
    return times_direction(turn, r, phase, values)


def _range(low: float, high: float, unit: str) -> str:
    return f"{float(low):.3g} … {float(high):.3g} {unit}".rstrip()


def beyond_range(state: State) -> list[str]:
    """Sentences about runs whose motion leaves the range in which a curve was fitted.

    Parameters
    ----------
    state : State
        A fitted model.
    """
    found = []
    for curve in curves(state):
        motions = Motions(state.fit, state.assembly, quantities_of(state.assembly.native))
        numbers = _numbers(motions, curve.spline) or []
        for prediction in state.held_out:
            for axis, k in zip(curve.spline.axes, numbers, strict=False):
                values = _along(motions, prediction, k)
                outside = (values < axis.low) | (values > axis.high)
                if np.isfinite(values).all() and outside.mean() > state.policy.beyond_curve:
                    found.append(
                        f"run {prediction.record.label} goes beyond the range in which"
                        f" {curve.title} was fitted: {axis.name}"
                        f" {_range(values.min(), values.max(), axis.unit)}, fitted"
                        f" {_range(axis.low, axis.high, axis.unit)}; its prediction there is not"
                        " known"
                    )
    return found


def _along(motions: Motions, prediction: Prediction, k: int) -> Array:
    """A quantity along a held-out run."""
    constants = prediction.predictor.constants(prediction.vector[None], 0)[0]
    return motions.along(prediction.predictor.runs[0], constants, k, prediction.record.position)


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
