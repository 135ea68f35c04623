"""Explicit regression ``y = f(x, theta)`` as a problem with one run and one output.

The function is written for one parameter vector. Because NumPy broadcasts, it usually also accepts
a column of numbers for each ``theta[i]``, and then evaluates many vectors in one call. This is
tested for each function, and a loop is used where it fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import RunSamples
from bayesoleo.errors import InputError, number_of
from bayesoleo.estimation._least_squares import BatchNormalEquations, reduce_rows
from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model._priors import Prior
from bayesoleo.solvers._orbit import Status

# A sum in another order rounds differently; a function that broadcasts wrongly is off by far more.
_SAME = 1e-9
# Sixth-order central difference, and the fourth order below it. At a relative step of 1e-3 rounding
# costs about 1e-13 of a derivative, and truncation stays below 1e-8 even where the function changes
# e-fold within 1 % of a parameter.
_OFFSETS = np.array([1.0, 2.0, 3.0])
_WEIGHTS = np.array([[45.0, -9.0, 1.0], [40.0, -5.0, 0.0]]) / 60
_RELATIVE_STEP = 1e-3
# Where the fourth order differs from the sixth by more than this part of the largest derivative,
# the step is longer than the function is smooth - the prior may be far wider than it - and is
# shortened.
_ROUGH, _FINER, _REFINEMENTS = 1e-8, 10.0, 4
# Numbers of one batch of predictions: about what stays in a core's cache.
_BATCH = 2**17


class Broadcast:
    """A function of known inputs and one vector, called for many vectors at once where it can be.

    Parameters
    ----------
    function : callable
        ``function(x, theta)`` returns the prediction, shape (n,), for ``theta`` of shape (l,).
    x
        Known inputs.
    samples : int
        ``n``.
    """

    def __init__(self, function: Callable[[Any, Array], ArrayLike], x: Any, samples: int) -> None:
        self._function, self._x, self._samples = function, x, samples
        self._together: bool | None = None

    def one(self, theta: Array) -> Array:
        """Prediction at one vector, shape (n,); not finite where the function fails.

        Raises
        ------
        InputError
            If the function returns another number of predictions than there are samples.
        """
        with np.errstate(all="ignore"):
            prediction = np.asarray(self._function(self._x, theta))
        if prediction.dtype != np.longdouble:
            prediction = prediction.astype(float, copy=False)
        if prediction.shape not in ((), (1,), (self._samples,)):
            raise InputError(
                "function must return one prediction for each sample of y",
                key="x",
                value=prediction.shape,
                hint=f"y has {number_of(self._samples, 'sample')}: give x for as many",
            )
        return np.broadcast_to(prediction, (self._samples,))

    def many(self, theta: Array) -> Array:
        """Predictions at vectors of shape (L, l), shape (L, n)."""
        if len(theta) == 1:
            return self.one(theta[0])[None]
        if self._together is None:
            self._together = self._try(theta[:2])
        return self._at_once(theta) if self._together else self._by_row(theta)

    def _by_row(self, theta: Array) -> Array:
        return np.array([self.one(row) for row in theta])

    def _at_once(self, theta: Array) -> Array:
        with np.errstate(all="ignore"):
            prediction = np.asarray(self._function(self._x, theta.T[:, :, None]))
        return np.broadcast_to(prediction, (len(theta), self._samples))

    def _try(self, theta: Array) -> bool:
        """Whether two vectors give the same together as apart."""
        apart = self._by_row(theta)
        try:
            together = self._at_once(theta)
        except Exception:  # the function is the user's: whatever it raises means "one by one"
            return False
        scale = np.nanmax(np.abs(apart), initial=0.0)
        close = np.allclose(together, apart, rtol=_SAME, atol=_SAME * scale, equal_nan=True)
        return bool(np.isfinite(scale) and close)


class FunctionProblem:
    """A function of known inputs fitted to one measured output.

    Parameters
    ----------
    function : callable
        ``function(x, theta)`` returns the prediction, shape (n,).
    x : array_like
        Known inputs in any form that ``function`` reads.
    y : array_like, shape (n,)
        Measured output.
    priors : sequence of Prior, length l
        Prior of each unknown.
    names : sequence of str, optional
        Names of the unknowns; by default ``theta1``, ``theta2`` ...
    start : array_like, shape (l,), optional
        Where an estimate starts; by default the priors' means.
    jacobian : callable, optional
        ``jacobian(x, theta)`` returns the derivatives, shape (n, l); by default sixth-order central
        differences with steps scaled to the value, or to the prior where the value is near zero.
    output : str, optional
        Name of the output.
    nuisances : sequence of str, optional
        Unknowns whose prior is a measurement, such as constants known to a tolerance: it counts in
        every estimator, where another only scales the steps of MBE.

    Raises
    ------
    InputError
        If lengths disagree, the data are empty or not finite, or there is no such unknown.
    """

    def __init__(
        self,
        function: Callable[[Any, Array], ArrayLike],
        x: Any,
        y: ArrayLike,
        priors: Sequence[Prior],
        names: Sequence[str] | None = None,
        start: ArrayLike | None = None,
        jacobian: Callable[[Any, Array], ArrayLike] | None = None,
        output: str = "y",
        nuisances: Sequence[str] = (),
    ) -> None:
        # Data of extended precision keep it until the residual is formed: where a model fits to the
        # last digits, the residual would else be the rounding of the two numbers it comes from.
        measured = np.array(y)
        self._y = measured if measured.dtype == np.longdouble else measured.astype(float)
        if self._y.ndim != 1 or not np.isfinite(self._y).all():
            raise InputError("measured output must be one column of finite numbers", key="y")
        if not self._y.size:
            raise InputError("measured output has no sample", key="y")
        self._x, self._jacobian = x, jacobian
        self._prediction = Broadcast(function, x, self._y.size)
        self._priors = tuple(priors)
        length = len(self._priors)
        self._names = tuple(names or (f"theta{i}" for i in range(1, length + 1)))
        centre = [prior.mean for prior in self._priors]
        self._start = np.array(centre if start is None else start, dtype=float)
        if len(self._names) != length or self._start.shape != (length,):
            raise InputError(
                "names, start and priors must have one entry per unknown",
                value=(len(self._names), self._start.shape, length),
            )
        for name in nuisances:
            if name not in self._names:
                raise InputError(
                    "there is no such unknown",
                    key="nuisances",
                    value=name,
                    hint=f"use {', '.join(self._names)}",
                )
        self._nuisances = frozenset(nuisances)
        # Only the function knows how it reads x: where the lengths differ, ask it.
        if isinstance(x, np.ndarray | list | tuple) and len(x) != self._y.size and length:
            self._prediction.one(self._start)
        self._output = output
        #: Effective number of samples by run and output, if it was computed.
        self.effective: Array | None = None
        self._sd = np.array([prior.sd for prior in self._priors])
        self._support = np.array([prior.support for prior in self._priors])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return self._names

    @property
    def nuisances(self) -> frozenset[str]:
        """Unknowns whose prior is a measurement."""
        return self._nuisances

    @property
    def priors(self) -> tuple[Prior, ...]:
        """Prior of each unknown."""
        return self._priors

    @property
    def start(self) -> Array:
        """Where an estimate starts, shape (l,)."""
        return self._start.copy()

    @property
    def outputs(self) -> tuple[str, ...]:
        """Name of the one output."""
        return (self._output,)

    @property
    def runs(self) -> tuple[str, ...]:
        """Label of the one run."""
        return ("1",)

    @property
    def counts(self) -> Integers:
        """Number of samples, shape (1, 1)."""
        return np.array([[self._y.size]], dtype=np.int64)

    @property
    def data(self) -> tuple[Array, ...]:
        """Measured samples, one array of shape (n,)."""
        return (self._y,)

    @property
    def has_derivatives(self) -> bool:
        """Whether the user gave derivatives; those by differences take many evaluations each."""
        return self._jacobian is not None

    @property
    def lanes(self) -> int:
        """Vectors whose predictions with their differences fit the cache."""
        stencil = 1 + (2 * _OFFSETS.size * len(self._names) if self._jacobian is None else 0)
        return max(1, _BATCH // (self._y.size * stencil))

    def with_data(self, data: Sequence[Array]) -> FunctionProblem:
        """The same problem with other measured samples, shape (n,).

        Raises
        ------
        InputError
            If their number is another, or they are not finite.
        """
        (y,) = data
        if np.shape(y) != self._y.shape or not np.isfinite(y).all():
            raise InputError(
                "data must be finite and as many as the problem's",
                key="data",
                value=np.shape(y),
                hint=f"give {number_of(self._y.size, 'sample')}",
            )
        other = copy(self)
        other._y = np.array(y)
        return other

    def predict(self, theta: ArrayLike) -> Array:
        """Prediction at one vector, shape (n,); NaN or infinite where the function fails."""
        return self._prediction.one(np.array(theta, dtype=float))

    def evaluate(self, theta: Array) -> Evaluation:
        """Residual and sensitivity at one vector, shape (l,)."""
        theta = np.array(theta, dtype=float)
        residual = self._residual(theta)
        sensitivity = np.full((self._y.size, theta.size), np.nan)
        if np.isfinite(residual).all():
            sensitivity = self._sensitivity(theta[None])[0]
        if np.isfinite(sensitivity).all():
            return Evaluation((residual,), (sensitivity,), Status.CONVERGED)
        failed = (np.full_like(residual, np.nan),), (np.full_like(sensitivity, np.nan),)
        return Evaluation(*failed, Status.NOT_FINITE)

    def normal_equations(self, theta: Array, data: Sequence[Array]) -> BatchNormalEquations:
        """Equations at vectors (L, l), each compared with its own row of data (L, n)."""
        with np.errstate(all="ignore"):
            residual = np.asarray(data[0] - self._prediction.many(theta), dtype=float)
            sensitivity = self._sensitivity(theta)
            gram, slope, sums = reduce_rows(residual, sensitivity)
            finite = np.isfinite(sums) & np.isfinite(gram).all(axis=(1, 2))
        status = np.where(finite, Status.CONVERGED, Status.NOT_FINITE).astype(np.int64)
        return BatchNormalEquations(gram[:, None], slope[:, None], sums[:, None], status)

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors, shape (L, l)."""
        vectors = np.atleast_2d(np.asarray(theta, dtype=float))
        sums = np.empty((len(vectors), 1, 1))
        for row, vector in enumerate(vectors):
            residual = self._residual(vector)
            # a residual that overflows when squared is as unusable as one that is not finite
            with np.errstate(over="ignore", invalid="ignore"):
                sums[row] = np.sum(residual * residual)
        failed = ~np.isfinite(sums[:, 0, 0])
        sums[failed] = np.nan
        return Misfit(sums, np.where(failed, Status.NOT_FINITE, Status.CONVERGED).astype(np.int64))

    @property
    def samples(self) -> tuple[RunSamples, ...]:
        """Where the samples lie: along ``x`` if it is one ascending column, else one after the
        other."""
        x = np.asarray(self._x) if isinstance(self._x, np.ndarray | list | tuple) else np.empty(0)
        usable = x.shape == self._y.shape and x.dtype.kind in "iuf" and bool((np.diff(x) > 0).all())
        place = x.astype(float) if usable else np.arange(self._y.size, dtype=float)
        return (RunSamples(place, None),)

    def residuals(self, theta: Array, run: int) -> tuple[Array, Integers]:
        """Residuals (L, 1, n) at vectors (L, l), and statuses (L,)."""
        rows = np.stack([self._residual(vector) for vector in np.asarray(theta, dtype=float)])
        failed = ~np.isfinite(rows).all(axis=1)
        status = np.where(failed, Status.NOT_FINITE, Status.CONVERGED).astype(np.int64)
        return rows[:, None], status

    def _residual(self, theta: Array) -> Array:
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray(self._y - self.predict(theta), dtype=float)

    def _sensitivity(self, theta: Array) -> Array:
        """Derivatives of the prediction at vectors (L, l), shape (L, n, l)."""
        if self._jacobian is not None:
            with np.errstate(all="ignore"):
                rows = [np.array(self._jacobian(self._x, row), dtype=float) for row in theta]
            return np.stack(rows)
        step = self._steps(theta)
        found, error = self._differences(theta, step)
        for _ in range(_REFINEMENTS):
            rough = np.flatnonzero((error > _ROUGH).any(axis=1))
            if not rough.size:
                break
            step[rough] = np.where(error[rough] > _ROUGH, step[rough] / _FINER, step[rough])
            again, left = self._differences(theta[rough], step[rough])
            better = left < error[rough]
            found[rough] = np.where(better[:, None], again, found[rough])
            error[rough] = np.where(better, left, error[rough])
        return found

    def _differences(self, theta: Array, step: Array) -> tuple[Array, Array]:
        """Derivatives (L, n, l) with steps (L, l), and how far a lower order is off, (L, l)."""
        # vectors (offset, L, unknown, l): each moves one unknown by a multiple of its step
        moved = _OFFSETS[:, None, None, None] * (step[:, :, None] * np.eye(theta.shape[1]))
        ahead, behind = theta[:, None] + moved, theta[:, None] - moved
        # the steps that floating point really took, not the ones that were asked for
        taken = np.einsum("olkk->olk", ahead - behind) / (2 * _OFFSETS[:, None, None])
        both = np.concatenate((ahead, behind)).reshape(-1, theta.shape[1])
        ends = self._prediction.many(both).reshape(2, *moved.shape[:3], -1)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            slopes = np.asarray((ends[0] - ends[1]) / taken[..., None], dtype=float)
            sixth, fourth = np.einsum("wo,olkn->wlnk", _WEIGHTS, slopes)
            error = np.abs(sixth - fourth).max(axis=1) / np.abs(sixth).max(axis=1)
        return sixth, np.nan_to_num(error, nan=0.0, posinf=0.0)

    def _steps(self, theta: Array) -> Array:
        """Steps of the differences, shape (L, l): the stencil stays inside the support."""
        step = _RELATIVE_STEP * np.maximum(np.abs(theta), _RELATIVE_STEP * self._sd)
        room = np.abs(self._support - theta[..., None]).min(axis=-1)
        return np.where(room > 0, np.minimum(step, room / (_OFFSETS[-1] + 1)), step)
