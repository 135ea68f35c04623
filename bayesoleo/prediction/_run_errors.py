"""Errors of a predicted run: noise of its inputs, and discretisation of its motion.

The harmonics of an input are known with a variance each. The resulting error of the prediction
repeats in every period, so the scatter between periods does not contain it. It is computed by the
same linear problem that gives parameter sensitivities. Of a broadband input with thousands of
harmonics, neighbours stand together. The smooth input of a transient has an error at every sample;
a few draws of it represent its covariance.

The mesh of a run is frozen, so that a log density is the same function everywhere. Its
discretisation error is estimated once, at the point estimate.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Protocol, cast

import numpy as np

from bayesoleo._types import Array, ComplexArray, Flags, Integers
from bayesoleo.prediction._band_limited import Smoothed
from bayesoleo.prediction._inputs import (
    harmonics_of,
    highest_derivatives,
    input_rows,
    signal_of,
    signal_of_rows,
)
from bayesoleo.prediction._kept_by_record import KeptByRecord
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._periodic_solver import SolvedRun
from bayesoleo.prediction._records import TABLE, Harmonics, Record
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._error_estimate import NONE, ErrorEstimate, estimate_error
from bayesoleo.solvers._mesh import equidistant, tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import DEFAULT_SCHEME
from bayesoleo.solvers._switched import PeriodicProblem
from bayesoleo.solvers._switching import evaluate
from bayesoleo.solvers._transient import moved_from_start

#: Draws of the error of a transient's input. The root mean square of so many is known to 20 %.
DRAWS = 16
#: Lines of the noise that a curve of a transient's input holds, and parts of the harmonics of an
#: input of a periodic run, up to which each is one error.
MOST_LINES = 256
#: Error over the swing below which nothing more is resolved: what no channel shows.
TOLERANCE = 1e-6
#: Points of a run at which its equations are looked at: every run of every fit is.
LOOKS = 16_384
#: Bytes of draws, and of changes by harmonics, that are kept for the next model of a run.
MOST_KEPT = 3e8
#: Bytes of columns that are kept.
MOST_COLUMNS = 1.5e8
#: Coefficients of an input for which states are solved together.
TOGETHER = 32


def input_columns(run: RunPredictor, p: Array, draws: int = DRAWS) -> Array:
    """Change of the outputs by one standard deviation of each input coefficient.

    Parameters
    ----------
    run : RunPredictor
        Anchored near ``p``.
    p : ndarray, shape (np,)
        Model constants.
    draws : int
        Number of draws where the errors are too many to stand one by one.

    Returns
    -------
    ndarray, shape (ny, k, N)
        Real and imaginary parts of all significant harmonics of all inputs, or sums of neighbours
        where these are very many (:func:`errors_known`). Of a transient the lines of the noise that
        its inputs hold, or where these are too many draws over the root of their number, and the
        errors of channels that its start is read from. SI; no columns where the run could not be
        solved. Not to be written to: those of a periodic run are kept.
    """
    ny, samples = run.measured.shape
    x = np.empty((1, 0, 0))
    if run.kernels.derived.dofs:
        solution = run.solve(p[None])
        if solution.status[0] != Status.CONVERGED.value:
            return np.zeros((ny, 0, samples))
        x = solution.x
    if not run.record.periodic:
        return _columns_about(run, p, x, draws)
    like = run.model.structure, run.kernels.derived.active, run.scheme_name, run.steps, MOST_LINES
    key = like, p.tobytes(), hashlib.sha256(x.tobytes()).digest()
    return _columns.of(run.record, key, lambda: _columns_about(run, p, x, draws))


def _columns_about(run: RunPredictor, p: Array, x: Array, draws: int) -> Array:
    """The columns at a solution ``x``."""
    derived = run.kernels.derived
    ny, samples = run.measured.shape
    z = np.empty((1, 0, samples))
    if derived.dofs:
        z = run.scheme.sample(x[..., None], run.plan, run.boundary.step(run.steps))[:, :, 0]
    lanes, one = np.zeros(1, dtype=np.int64), p[None]
    yz, yp = np.zeros((1, ny, z.shape[1], samples)), np.zeros((1, ny, len(derived.active), samples))
    yu = np.zeros((1, ny, len(derived.inputs), samples))
    with np.errstate(all="ignore"):
        run.kernels.output_jacobian(z, run.sample_inputs, one, lanes, yz, yp)
        run.kernels.output_inputs(z, run.sample_inputs, one, lanes, yu)
    changes = _InputChanges(run, run.record.position, draws)
    by_start = _moved_by_start(run, p, x)
    columns = np.empty((ny, changes.count + by_start.shape[1], samples))
    for part in changes.parts:
        columns[:, part] = np.einsum("yuN,ukN->ykN", yu[0], changes.of(part))
    for part, moved in _moved(run, one, x, draws) if derived.dofs else ():
        columns[:, part] += np.einsum("yzN,zkN->ykN", yz[0], moved)
    columns[:, changes.count :] = np.einsum("yzN,zkN->ykN", yz[0], by_start)
    return columns if np.isfinite(columns).all() else np.zeros((ny, 0, samples))


def _moved(run: RunPredictor, p: Array, x: Array, draws: int) -> Iterator[tuple[slice, Array]]:
    """Change of the dofs' rows at the samples, shape (nz, k, N), by some coefficients at a time.

    The states of a few coefficients stay in the cache; those of hundreds take several times as long
    each, and much memory.
    """
    boundary, d = run.boundary, len(run.scheme.orders)
    points, nz = boundary.inputs.shape[1], run.scheme.state_size + d
    lanes = np.zeros(1, dtype=np.int64)
    z, g, gz = np.zeros((1, nz, points)), np.zeros((1, d, points)), np.zeros((1, d, nz, points))
    gu = np.zeros((1, d, boundary.inputs.shape[0], points))
    step, held = boundary.step(run.steps), not run.record.periodic
    run.scheme.rows(x, lanes, step, z)
    run.kernels.jacobian(z, boundary.inputs, p, lanes, g, gz)
    run.kernels.inputs(z, boundary.inputs, p, lanes, gu)
    changes = _InputChanges(run, run.points, draws)
    for part in changes.parts:
        right = np.einsum("lduN,ukN->ldkN", gu, changes.of(part))
        states = run.scheme.linear(gz, right, None, lanes, step, initial=held)[0]
        yield part, run.scheme.sample(states, run.plan, step)[0]


def _moved_by_start(run: RunPredictor, p: Array, x: Array) -> Array:
    """Change of the dofs' rows at the samples, shape (nz, k, N), by errors of a measured start.

    One sample is smoothed with those beside it, and is still not the true state.
    """
    d, samples = len(run.scheme.orders), run.record.position.size
    nz = run.scheme.state_size + d
    none = np.zeros((nz if run.kernels.derived.dofs else 0, 0, samples))
    if not isinstance(run, TransientRun) or not run.kernels.derived.dofs:
        return none
    errors = _start_errors(run)
    if not errors.shape[1]:
        return none
    boundary, lanes, n = run.boundary, np.zeros(1, dtype=np.int64), run.steps
    points, step = boundary.inputs.shape[1], boundary.step(n)
    z, g, gz = np.zeros((1, nz, points)), np.zeros((1, d, points)), np.zeros((1, d, nz, points))
    run.scheme.rows(x, lanes, step, z)
    run.kernels.jacobian(z, boundary.inputs, p[None], lanes, g, gz)
    start = (run.initial.by_measured(p) @ errors)[None]
    right = np.zeros((1, d, errors.shape[1], points))
    states, _, _ = moved_from_start(boundary, n, gz, right, start, lanes)
    return np.asarray(run.scheme.sample(states, run.plan, step)[0])


def _start_errors(run: TransientRun) -> Array:
    """Root ``(m, k)`` of the covariance of what a start is read from."""
    items, record = run.initial.measured(), run.record
    blocks: list[Array] = []
    for channel in dict.fromkeys(channel for channel, _, _ in items):
        orders = {k: order for k, (name, order, _) in enumerate(items) if name == channel}
        curve = cast(Smoothed, signal_of(record, channel, max(*orders.values(), 1)))
        block = np.zeros((len(items), 0))
        if curve.noise > 0.0:
            asked, size = (0, *orders.values()), record.time.size
            value, *changes = _curve_changes(curve, record.rate, size, asked, np.zeros(1))
            # At the end of a record a smooth curve is also biased, by about the noise of a sample.
            factor = max(1.0, curve.noise / max(float(np.linalg.norm(value)), 1e-300))
            block = np.zeros((len(items), value.shape[0]))
            block[list(orders)] = factor * np.array(changes)[:, :, 0]
        blocks.append(block)
    every = np.concatenate(blocks, axis=1) if blocks else np.zeros((0, 0))
    if every.shape[1] <= len(items):
        return every
    # As few columns as there are values.
    values, vectors = np.linalg.eigh(every @ every.T)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


class _InputChanges:
    """Change of every input row by one standard deviation of each coefficient, some at a time.

    Parameters
    ----------
    run : RunPredictor
    phase : ndarray, shape (N,)
        Where.
    draws : int
        Number of draws of the errors of a transient's input.
    """

    def __init__(self, run: RunPredictor, phase: Array, draws: int):
        rows, record = run.kernels.derived.inputs, run.record
        self.shape, self.blocks = (len(rows), phase.size), list[tuple[list[int], _Block]]()
        highest = highest_derivatives(rows)
        for channel in run.model.inputs:
            orders = {k: order for k, (name, order) in enumerate(rows) if name == channel}
            if not orders:
                continue
            derivatives = tuple(orders.values())
            block: _Block
            if record.periodic:
                block = _Known(_changes_of(record, channel, highest[channel], derivatives, phase))
            else:
                curve = cast(Smoothed, signal_of(record, channel, highest[channel]))
                size, rate = record.time.size, record.rate
                lines = _noise_lines(curve, 1.0 / rate, size)
                block = (
                    _Known(_known_changes(curve, rate, size, derivatives, phase.tobytes(), draws))
                    if lines is None
                    else _Lines(*lines, derivatives, phase)
                )
            self.blocks.append((list(orders), block))
        self.ends = np.cumsum([0, *(block.count for _, block in self.blocks)])

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return int(self.ends[-1])

    @property
    def parts(self) -> list[slice]:
        """All coefficients, a few at a time."""
        firsts = range(0, self.count, TOGETHER)
        return [slice(first, min(first + TOGETHER, self.count)) for first in firsts]

    def of(self, part: slice) -> Array:
        """Of some coefficients, shape (nu, k, N)."""
        found = np.zeros((self.shape[0], part.stop - part.start, self.shape[1]))
        for (rows, block), begin, end in zip(self.blocks, self.ends, self.ends[1:], strict=False):
            low, high = max(part.start, begin), min(part.stop, end)
            if low < high:
                own = block.of(int(low - begin), int(high - begin))
                found[rows, low - part.start : high - part.start] = own
        return found


class _Block(Protocol):
    """Changes of some derivatives of one channel."""

    count: int

    def of(self, first: int, last: int) -> Array:
        """Of the coefficients from a first one up to a last one, shape (derivatives, k, N)."""


class _Known:
    """Those that were computed, shape (derivatives, k, N)."""

    def __init__(self, changes: Array):
        self.changes, self.count = changes, changes.shape[1]

    def of(self, first: int, last: int) -> Array:
        return self.changes[:, first:last]


class _Lines:
    """Those by lines of noise whose angles are whole multiples of half a turn in all the time.

    Of a long record all of them together take hundreds of megabytes. They are made from two tables,
    and thus faster than they would be kept.

    Parameters
    ----------
    omega, sd : ndarray, shape (k,)
        From :func:`_noise_lines`.
    derivatives : tuple of int
    position : ndarray, shape (N,)
    """

    def __init__(self, omega: Array, sd: Array, derivatives: tuple[int, ...], position: Array):
        self.omega, self.sd, self.derivatives = omega, sd, derivatives
        self.half, self.count = 0.5 * position, omega.size
        self.turns = np.exp(2j * np.pi * np.outer(np.arange(TABLE), self.half % 1.0))

    def of(self, first: int, last: int) -> Array:
        found = np.empty((len(self.derivatives), last - first, self.half.size))
        turns = _turns(np.arange(first, last), self.half, self.turns)
        for j, turn in enumerate(turns):
            for k, order in enumerate(self.derivatives):
                size = self.sd[first + j] * self.omega[first + j] ** order
                # A quarter of a turn for each derivative.
                part = turn.imag if order % 2 else turn.real
                np.multiply(part, -size if order % 4 in (1, 2) else size, out=found[k, j])
        return found


def _harmonic_changes(
    item: Harmonics, frequency: float, derivatives: Sequence[int], phase: Array
) -> Array:
    """The same by the counted parts of harmonics, shape (derivatives, k, N).

    Of more than :data:`MOST_LINES` parts some neighbours are one column, their sum with random
    signs. Sums and mean squares over all columns have the same expectation as over all parts (a
    sketch by random signs: Charikar, Chen and Farach-Colton 2002), and those of a linear answer
    over a period the same value, since its harmonics are orthogonal.
    """
    count, kept = item.orders.size, counted_parts(item, derivatives)
    place, whole = np.cumsum(kept) - 1, int(kept.sum())
    size = np.sqrt(item.variances)
    if whole > MOST_LINES:
        place = place * MOST_LINES // whole
        size = size * np.random.default_rng(0).choice([-1.0, 1.0], count)
    found = np.zeros((len(derivatives), min(whole, MOST_LINES), phase.size))
    factors = zip(item.orders, size, _turns(item.orders, phase), strict=True)
    for j, (order, sd, turn) in enumerate(factors):
        for k, derivative in enumerate(derivatives):
            changed = (2j * np.pi * frequency * order) ** derivative * sd * turn
            for at, part in ((j, changed.real), (count + j, -changed.imag)):
                if kept[at]:
                    found[k, place[at]] += part
    return found


def counted_parts(item: Harmonics, derivatives: Sequence[int]) -> Flags:
    """Which real, then which imaginary parts of coefficients change an input row: a mean has no
    derivatives and no imaginary part."""
    known, moves = item.variances > 0, item.orders > 0
    return np.concatenate([known & (moves | (0 in derivatives)), known & moves])


def _turns(
    orders: Integers, phase: Array, fine: ComplexArray | None = None
) -> Iterator[ComplexArray]:
    """``exp(2 pi i k phase)`` for one order ``k`` after the other, each of shape (N,).

    Products of two tables, since hundreds of orders at thousands of phases would take an
    exponential each.
    """
    whole = phase % 1.0
    if fine is None:
        fine = np.exp(2j * np.pi * np.outer(np.arange(TABLE), whole))
    coarse: dict[int, ComplexArray] = {}
    for order in orders:
        high, low = divmod(int(order), TABLE)
        if high not in coarse:
            coarse = {high: np.exp(2j * np.pi * TABLE * high * whole)}  # orders ascend
        yield coarse[high] * fine[low]


class _Draws:
    """Draws of the errors of curves, those asked for last: of a long record they fill the memory,
    and each new run that is predicted has curves of its own."""

    def __init__(self, most: float):
        self.most, self.lock = most, threading.Lock()
        self.kept: OrderedDict[Smoothed, tuple[Smoothed, ...]] = OrderedDict()

    def of(self, curve: Smoothed, number: int) -> tuple[Smoothed, ...]:
        """So many draws of one curve; the first few of many are the few."""
        with self.lock:
            if len(self.kept.get(curve, ())) >= number:
                self.kept.move_to_end(curve)
                return self.kept[curve][:number]
        found = tuple(curve.errors(number))
        with self.lock:
            self.kept[curve] = found
            while len(self.kept) > 1 and self._size() > self.most:
                self.kept.popitem(last=False)
        return found

    def _size(self) -> int:
        """Bytes of what is kept, with the pieces that a curve is evaluated by."""
        return sum(3 * one.states.nbytes for draws in self.kept.values() for one in draws)


_errors = _Draws(MOST_KEPT)


#: Of a broadband input changes by its harmonics take as long as the states of a model, and the
#: input at all points at which equations are looked at takes as long as the look.
_of_records = KeptByRecord(MOST_KEPT)
#: Changes of the outputs by these. A round, and what confirms its effect, begin with the estimate
#: of the last one, and ask again where its solution is the same in all digits. In a store of their
#: own: those of many models would drive out what each model asks for.
_columns = KeptByRecord(MOST_COLUMNS)


def _changes_of(
    record: Record, channel: str, highest: int, derivatives: tuple[int, ...], phase: Array
) -> Array:
    """See :func:`_harmonic_changes`; not to be written to."""

    def make() -> Array:
        item = harmonics_of(record, channel).for_derivative(highest)
        return _harmonic_changes(item, record.frequency, derivatives, phase)

    key = channel, highest, derivatives, phase.tobytes(), MOST_LINES
    return _of_records.of(record, key, make)


@lru_cache(maxsize=4)
def _known_changes(
    curve: Smoothed,
    rate: float,
    samples: int,
    orders: tuple[int, ...],
    position: bytes,
    draws: int,
) -> Array:
    """The same as :func:`_curve_changes`, kept: each model of a run asks for it again, and draws of
    a long record take longer than to solve the model."""
    found = _curve_changes(curve, rate, samples, orders, np.frombuffer(position), draws)
    found.flags.writeable = False
    return found


def _curve_changes(
    curve: Smoothed,
    rate: float,
    samples: int,
    orders: Iterable[int],
    position: Array,
    number: int = DRAWS,
) -> Array:
    """Change of some derivatives of a curve by one standard deviation of each of its errors, of a
    record of so many samples, and of a length with that reciprocal."""
    lines, found = _noise_lines(curve, 1.0 / rate, samples), []
    draws = () if lines is not None else _errors.of(curve, number)
    for order in orders:
        if lines is not None:
            omega, sd = lines
            turn = np.multiply.outer(omega, position * (1.0 / rate)) + order * np.pi / 2
            found.append((sd * omega**order)[:, None] * np.cos(turn))
        else:
            each = [draw.evaluate(position, rate, order) for draw in draws]
            found.append(np.reshape(each, (len(draws), position.size)) / np.sqrt(number))
    return np.stack(found)


def _noise_lines(curve: Smoothed, span: float, samples: int) -> tuple[Array, Array] | None:
    """Angular frequencies of the noise in a band-limited curve, and the standard deviation of each
    amplitude; None where they are too many, or the curve is a spline.

    Cosines with whole numbers of half turns in a record are orthogonal at its samples, so that
    white noise has independent amplitudes. A curve is right up to noise times the root of its gain.
    """
    band = curve.band
    if band is None or not np.isfinite(band.cut) or curve.noise == 0.0:
        return None
    count = int(2.0 * span * band.cut * (1.0 + band.fade)) + 1
    if count > MOST_LINES:
        return None
    frequency = np.asarray(0.5 * np.arange(count) / span, dtype=np.float64)
    size = np.sqrt(np.where(frequency > 0, 2.0, 1.0) / samples)
    return 2.0 * np.pi * frequency, curve.noise * size * np.sqrt(band.gain(frequency))


def errors_known(run: RunPredictor) -> bool:
    """Whether the columns of :func:`input_columns` are all errors of the inputs, each by itself,
    and not draws or sums of them."""
    rows = run.kernels.derived.inputs
    record, highest = run.record, highest_derivatives(rows)
    channels = [name for name in run.model.inputs if name in highest]
    if record.periodic:
        orders = {name: [k for channel, k in rows if channel == name] for name in channels}
        items = [harmonics_of(record, name).for_derivative(highest[name]) for name in channels]
        counts = [
            counted_parts(item, orders[name]).sum()
            for name, item in zip(channels, items, strict=True)
        ]
        return bool(max(counts, default=0) <= MOST_LINES)
    curves = [cast(Smoothed, signal_of(record, name, highest[name])) for name in channels]
    return all(
        c.noise == 0.0 or _noise_lines(c, record.span, record.time.size) is not None for c in curves
    )


def drawn_columns(run: RunPredictor, draws: int = DRAWS) -> int:
    """How many columns of :func:`input_columns`, the first ones, are draws of errors of the inputs
    or stand beside such draws; zero where each column is one error."""
    return 0 if errors_known(run) else _InputChanges(run, run.record.position, draws).count


def motion_error(run: RunPredictor, tolerance: float = TOLERANCE) -> ErrorEstimate:
    """Estimate the error of a run's anchored motion.

    Parameters
    ----------
    run : RunPredictor
        Of a periodic run or of a transient, anchored.
    tolerance : float
        Error over the swing below which it need not be known.

    Returns
    -------
    ErrorEstimate
        Its error is NaN where there is no motion, or no estimate of its error.
    """
    anchor, derived = run.anchor, run.kernels.derived
    if anchor is None or not derived.dofs:
        return NONE
    if isinstance(run, SolvedRun):
        return run.error()
    initial = not run.record.periodic
    problem = PeriodicProblem(
        equations=run.kernels,
        orders=derived.orders,
        period=run.period,
        inputs_at=_inputs_at(run),
        conditions=len(derived.admissible),
        active=len(derived.active),
    )
    scheme = run.scheme
    method, mesh = tableau(DEFAULT_SCHEME), equidistant(run.steps)
    if isinstance(scheme, Collocation):
        method, mesh = scheme.method, scheme.mesh or mesh

    return estimate_error(
        problem,
        method,
        anchor.p,
        lambda phase: run.rows(anchor.x, phase),
        mesh,
        tolerance,
        initial=initial,
        looks=LOOKS,
    )


def _inputs_at(run: RunPredictor) -> Callable[[Array], Array]:
    """Input rows at phases; harmonics by rotation, since so many phases are asked for."""
    rows, record = run.kernels.derived.inputs, run.record
    if not record.periodic:
        return lambda position: input_rows(record, rows, position)
    signal = signal_of_rows(record, rows)
    # A copy: compiled code takes what may be written to.
    return lambda phase: _of_records.of(
        record, (rows, phase.tobytes()), lambda: evaluate(signal, phase * run.period)
    ).copy()


def outputs_of(run: RunPredictor, estimate: ErrorEstimate) -> Array | None:
    """Outputs ``(ny, N)`` at the raw samples of the better motion that an estimate found."""
    better, anchor = estimate.better, run.anchor
    if better is None or anchor is None:
        return None
    position = run.record.phase if run.record.periodic else run.record.position
    plan = better.scheme.plan(position, better.mesh.steps, initial=not run.record.periodic)
    step = better.boundary.step(better.mesh.steps)
    z = better.scheme.sample(better.x[None, :, :, None], plan, step)[:, :, 0]
    y = np.empty((1, len(run.kernels.derived.outputs), position.size))
    with np.errstate(all="ignore"):
        run.kernels.output(z, run.sample_inputs, anchor.p[None], np.array([0]), y)
    return cast(Array, y[0])
