"""Inputs of a run with their exact derivatives at any phase, for solvers and integrators."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np
from scipy.fft import next_fast_len

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError, ModelError
from bayesoleo.model._derivatives import analytic_pieces
from bayesoleo.model._expressions import COSINE, SINE, WITHIN
from bayesoleo.model._kernels import kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._band_limited import Smoothed, declared
from bayesoleo.prediction._kept_by_record import KeptByRecord
from bayesoleo.prediction._records import Harmonics, Record, Signal
from bayesoleo.solvers._initial_value import Dynamics
from bayesoleo.solvers._switching import InputSignal, periodic_signal

#: Rows computed before, by grid, channel, derivative and the highest that the model takes; models
#: of the same run share them.
RowCache = dict[tuple[str, str, int, int], Array]
#: Rows of all models of periodic runs, up to so many bytes.
_rows = KeptByRecord(3e8)
#: With more harmonics than these their sum costs an integrator more than all else: a rough motion
#: takes it from cubic pieces, so many in a cycle of the highest one (wrong by 2e-7 of it).
MANY_HARMONICS, PIECES_PER_CYCLE = 32, 64
#: Curves that are cut off where another channel is, by the whole curve and the frequency, with the
#: samples they are of. Candidates that feed the same channel back share the curve.
_CUT: WeakKeyDictionary[Smoothed, dict[float, tuple[Array, Smoothed]]] = WeakKeyDictionary()


def harmonics_of(record: Record, channel: str) -> Harmonics:
    """A channel's periodic representation.

    Raises
    ------
    CampaignError
        If the record lacks the channel.
    """
    if channel not in record.harmonics:
        restricted = _restricted(record, channel)
        if isinstance(restricted, Harmonics):
            return restricted
        raise CampaignError(
            f"the model needs channel {channel!r}",
            run=record.label,
            hint=f"channels there are: {', '.join(record.harmonics) or 'none'}",
        )
    return record.harmonics[channel]


def signal_of(record: Record, channel: str, highest: int = 0) -> Signal:
    """A channel as an input, periodic or not.

    Parameters
    ----------
    record : Record
        A run.
    channel : str
        Of it.
    highest : int
        The highest derivative that is taken of the channel: noise grows with it, so that less of
        what is near the noise may stay.

    Raises
    ------
    CampaignError
        If the record lacks the channel.
    """
    if channel not in record.signals:
        restricted = _restricted(record, channel, highest)
        if restricted is not None:
            return restricted.for_derivative(highest)
        raise CampaignError(
            f"the model needs channel {channel!r}",
            run=record.label,
            hint=f"channels there are: {', '.join(record.signals) or 'none'}",
        )
    return record.signals[channel].for_derivative(highest)


def lacking(inputs: Iterable[str], records: Iterable[Record]) -> str | None:
    """Why a model with these inputs has no solution in some run; None where all runs have them.

    The phase of a channel is that of its first harmonic, which a multisine may not have.
    """
    for record in records:
        for name in inputs:
            if name in record.signals or _restricted(record, name) is not None:
                continue
            part, _, other = name.partition(WITHIN)
            if part in (COSINE, SINE) and other in record.harmonics:
                return f"run {record.label}: {other} has no first harmonic, whose phase it needs"
            return f"run {record.label} has no channel {name!r}"
    return None


def highest_derivatives(rows: tuple[tuple[str, int], ...]) -> dict[str, int]:
    """The highest derivative that is taken of each channel of some rows."""
    highest: dict[str, int] = {}
    for channel, derivative in rows:
        highest[channel] = max(derivative, highest.get(channel, 0))
    return highest


def _restricted(record: Record, name: str, highest: int = 0) -> Signal | None:
    """One channel at the harmonics of another, as :func:`~bayesoleo.model._expressions.within`
    names it; of a transient, in the band of the other."""
    channel, _, other = name.partition(WITHIN)
    if channel in (COSINE, SINE) and other in record.harmonics:
        return _turning(record.harmonics[other], channel)
    if channel not in record.signals or other not in record.signals:
        return None
    if not record.periodic:
        return _in_band_of(record, channel, other, highest)
    item = record.harmonics[channel]
    like = record.harmonics[other]
    kept = np.isin(item.orders, like.orders)
    return replace(
        item,
        limits=like.limits,
        orders=item.orders[kept],
        coefficients=item.coefficients[kept],
        variances=item.variances[kept],
    )


def _in_band_of(record: Record, channel: str, other: str, highest: int) -> Signal:
    """A channel of a transient, cut off where another one is.

    The channel is an output of the model. Its noise above the band of what moves the model would
    be noise of the prediction as well: the two can cancel, and what feeds an output back would
    seem to explain it.
    """
    own = record.signals[channel].for_derivative(highest)
    like = record.signals[other].for_derivative(highest)
    if not (isinstance(own, Smoothed) and isinstance(like, Smoothed)) or like.band is None:
        return own
    if own.band is not None and own.band.cut <= like.band.cut:
        return own
    if not np.isfinite(like.band.cut):
        return own
    values, cut = record.samples[channel], like.band.cut
    kept = _CUT.setdefault(own, {}).get(cut)
    if kept is None or kept[0] is not values:
        step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
        kept = _CUT[own][cut] = values, declared(values, step, cut)
    return kept[1]


def _turning(item: Harmonics, part: str) -> Harmonics | None:
    """The first harmonic with unit amplitude, or a quarter of a turn behind it."""
    first = np.flatnonzero(item.orders == 1)
    if first.size == 0 or item.coefficients[first[0]] == 0:
        return None
    c, variance = item.coefficients[first], item.variances[first]
    quarter = 1.0 if part == COSINE else -1j
    size = np.abs(c)
    return Harmonics(item.orders[first], quarter * c / size, variance / size**2)


def input_rows(
    record: Record,
    rows: tuple[tuple[str, int], ...],
    phase: Array,
    grid: str = "",
    cache: RowCache | None = None,
) -> Array:
    """Values of input rows ``(channel, derivative)``, shape (nu, N).

    Parameters
    ----------
    record : Record
        A run.
    rows : tuple of (str, int)
        As in ``Derived``; the channel ``time`` gives seconds since the
        first sample.
    phase : ndarray, shape (N,)
        Cycles since the first sample; of a transient, parts of its length.
    grid : str
        Names ``phase`` in the cache, of a periodic run also among all its models.
    cache : dict, optional
        Taken from and added to.
    """
    known = {} if cache is None else cache
    highest = highest_derivatives(rows)
    table = np.empty((len(rows), phase.size))
    for k, (channel, derivative) in enumerate(rows):
        if channel == "time":
            table[k] = phase / record.rate
        else:
            key = (grid, channel, derivative, highest[channel])
            if key not in known:
                make = partial(_row, record, channel, highest[channel], derivative, phase)
                # A mesh of a transient is its model's own.
                shared = bool(grid) and record.periodic
                known[key] = _rows.of(record, key, make) if shared else make()
            table[k] = known[key]
    return table


def _row(record: Record, channel: str, highest: int, derivative: int, phase: Array) -> Array:
    return signal_of(record, channel, highest).evaluate(phase, record.rate, derivative)


def signal_of_transient(record: Record, rows: tuple[tuple[str, int], ...]) -> InputSignal:
    """Input rows of a transient in cubic pieces between its samples, for an integrator.

    Parameters
    ----------
    record : Record
        A transient run; its first sample is time zero.
    rows : tuple of (str, int)
        As in ``Derived``.
    """
    edges = np.interp(np.arange(0, record.time.size - 0.75, 0.5), np.arange(record.time.size),
                      record.position)  # fmt: skip
    length = np.diff(edges)
    inside = edges[:-1, None] + length[:, None] * np.arange(3) / 3.0
    values = input_rows(record, rows, np.append(inside.ravel(), edges[-1]))
    y = np.stack([values[:, k : values.shape[1] - 3 + k : 3] for k in range(3)])
    y = np.concatenate([y, values[None, :, 3::3]])
    powers = np.array([[6, 0, 0, 0], [-11, 18, -9, 2], [6, -15, 12, -3], [-1, 3, -3, 1]]) / 6.0
    scale = (3.0 / (length / record.rate)) ** np.arange(4)[:, None]
    pieces = np.einsum("jk,krm,jm->mrj", powers, y, scale)
    nothing = np.zeros((len(rows), 0))
    return InputSignal(0.0, nothing, nothing, edges / record.rate, np.ascontiguousarray(pieces))


def dynamics_of(
    model: Model,
    record: Record,
    active: Sequence[str] | None = None,
    backend: str = "numba",
    *,
    exact: bool = True,
) -> Dynamics:
    """The equations of a periodic run in analytic pieces, with its harmonics as inputs.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    record : Record
        A periodic run; its first sample is time zero.
    active : sequence of str, optional
        Parameters to differentiate by; by default those that are estimated.
    backend : {"numba", "numpy"}
        Of the kernels; NumPy's are called back from compiled code at every step, which is slow.
    exact : bool
        Sum all harmonics; else many of them may be cubic pieces of one period from time zero.

    Returns
    -------
    Dynamics
        Its constants ``p`` are the model's parameters and conditions in the model's order.

    Raises
    ------
    ModelError
        If there is nothing to integrate, or an output needs higher derivatives of a dof than the
        equations.
    """
    pieces = analytic_pieces(model)
    derived = kernels(pieces.model, active, backend).derived
    if not model.dofs:
        raise ModelError(f"model {model.name!r} has no dof", hint="evaluate its outputs instead")
    for dof, order in zip(derived.dofs, derived.orders, strict=True):
        if order != model.order(dof):
            raise ModelError(
                f"model {model.name!r}: an output needs a higher derivative of {dof!r} than its"
                " equation",
                hint="write the output in terms of what the equations contain, or use another "
                "solver than shooting: collocation or adaptive",
            )
    return Dynamics(
        kernels=kernels(pieces.model, active, backend),
        orders=derived.orders,
        signal=signal_of_rows(record, derived.inputs, exact=exact),
        active=len(derived.active),
        conditions=len(derived.admissible),
        switches=pieces.switches,
    )


def signal_of_rows(
    record: Record, rows: tuple[tuple[str, int], ...], *, exact: bool = True
) -> InputSignal:
    """Fourier coefficients of input rows; the time itself, which no equation has, is left zero.

    Where it need not be exact, one period in pieces that are as good as a start has to be.
    """
    used = {
        name: harmonics_of(record, name).for_derivative(highest)
        for name, highest in highest_derivatives(rows).items()
        if name != "time"
    }
    count = 1 + max((int(item.orders.max(initial=0)) for item in used.values()), default=0)
    table = np.zeros((len(rows), count), dtype=complex)
    for row, (name, derivative) in zip(table, rows, strict=True):
        if name == "time":
            continue
        item = used[name]
        rates = (2j * np.pi * record.frequency * item.orders) ** derivative
        row[item.orders] = np.where((item.orders == 0) & (derivative > 0), 0, rates)
        row[item.orders] *= item.coefficients
    if not exact and count > MANY_HARMONICS:
        return _signal_in_pieces(record.frequency, table)
    return periodic_signal(record.frequency, table.real, -table.imag)


def _signal_in_pieces(frequency: float, table: Array) -> InputSignal:
    """Cubic pieces of one period with the values and slopes of harmonics ``(nu, K)``."""
    size = next_fast_len(PIECES_PER_CYCLE * table.shape[1], real=True)
    step = 1.0 / (frequency * size)
    half = 0.5 * size * table
    half[:, 0] *= 2.0
    rates = 2j * np.pi * frequency * np.arange(table.shape[1])
    value, slope = (np.fft.irfft(part, size) for part in (half, rates * half))
    ahead, later = (np.roll(part, -1, axis=1) for part in (value, slope))
    chord = (ahead - value) / step
    square, cube = 3 * chord - 2 * slope - later, slope + later - 2 * chord
    pieces = np.stack([value, slope, square / step, cube / step**2], axis=-1)
    nothing = np.zeros((table.shape[0], 0))
    knots = step * np.arange(size + 1)
    return InputSignal(
        0.0, nothing, nothing, knots, np.ascontiguousarray(np.moveaxis(pieces, 1, 0))
    )
