"""An explicit regression ``y = f(x, theta)`` as a problem with one run and one output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesoleo.errors import InputError
from bayesoleo.estimation.problem import Array, Evaluation, Misfit
from bayesoleo.model.priors import Prior
from bayesoleo.solvers.status import Status

# Sixth-order central difference. At a relative step of 1e-3 rounding costs about 1e-13 of a
# derivative, and truncation stays below 1e-8 even where the function changes e-fold within 1 % of
# a parameter.
_OFFSETS = (1, 2, 3)
_WEIGHTS = (45 / 60, -9 / 60, 1 / 60)
_RELATIVE_STEP = 1e-3


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

    Raises
    ------
    InputError
        If lengths disagree or the data are not finite.
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
    ) -> None:
        self._function, self._x, self._jacobian = function, x, jacobian
        self._y = np.array(y, dtype=float)
        if self._y.ndim != 1 or not np.isfinite(self._y).all():
            raise InputError("measured output must be one column of finite numbers", key="y")
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
        self._output = output
        self._sd = np.array([prior.sd for prior in self._priors])
        self._support = np.array([prior.support for prior in self._priors])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return self._names

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
    def counts(self) -> NDArray[np.int64]:
        """Number of samples, shape (1, 1)."""
        return np.array([[self._y.size]], dtype=np.int64)

    def predict(self, theta: ArrayLike) -> Array:
        """Prediction at one vector, shape (n,); NaN or infinite where the function fails."""
        with np.errstate(all="ignore"):
            prediction = np.asarray(self._function(self._x, np.array(theta, dtype=float)))
        return np.broadcast_to(prediction.astype(float, copy=False), self._y.shape)

    def evaluate(self, theta: Array) -> Evaluation:
        """Residual and sensitivity at one vector, shape (l,)."""
        theta = np.array(theta, dtype=float)
        residual = self._y - self.predict(theta)
        sensitivity = np.full((self._y.size, theta.size), np.nan)
        if np.isfinite(residual).all():
            sensitivity = self._sensitivity(theta)
        if np.isfinite(sensitivity).all():
            return Evaluation((residual,), (sensitivity,), Status.CONVERGED)
        failed = (np.full_like(residual, np.nan),), (np.full_like(sensitivity, np.nan),)
        return Evaluation(*failed, Status.NOT_FINITE)

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors, shape (L, l)."""
        vectors = np.atleast_2d(np.asarray(theta, dtype=float))
        sums = np.empty((len(vectors), 1, 1))
        for row, vector in enumerate(vectors):
            residual = self._y - self.predict(vector)
            # a residual that overflows when squared is as unusable as one that is not finite
            with np.errstate(over="ignore", invalid="ignore"):
                sums[row] = np.sum(residual * residual)
        failed = ~np.isfinite(sums[:, 0, 0])
        sums[failed] = np.nan
        return Misfit(sums, np.where(failed, Status.NOT_FINITE, Status.CONVERGED).astype(np.int64))

    def _sensitivity(self, theta: Array) -> Array:
        if self._jacobian is not None:
            with np.errstate(all="ignore"):
                return np.array(self._jacobian(self._x, theta), dtype=float)
        columns = [self._difference(theta, index) for index in range(theta.size)]
        return np.column_stack(columns)

    def _difference(self, theta: Array, index: int) -> Array:
        step = _RELATIVE_STEP * max(abs(theta[index]), _RELATIVE_STEP * self._sd[index])
        room = np.abs(self._support[index] - theta[index]).min()
        if room > 0:  # keep the stencil inside the support, where the function is defined
            step = min(step, room / (_OFFSETS[-1] + 1))
        total = np.zeros(self._y.size)
        for offset, weight in zip(_OFFSETS, _WEIGHTS, strict=True):
            ahead, behind = theta.copy(), theta.copy()
            ahead[index] += offset * step
            behind[index] -= offset * step
            # the step that floating point really took, not the one that was asked for
            taken = (ahead[index] - behind[index]) / (2 * offset)
            with np.errstate(invalid="ignore", over="ignore"):
                total += weight * (self.predict(ahead) - self.predict(behind)) / taken
        return total
