"""Call a function of one parameter vector for many of them.

``function(x, theta)`` with ``theta[i]`` a number usually works unchanged where ``theta[i]`` is a
column of numbers, because NumPy broadcasts. Whether it does is tried, not assumed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._types import Array
from bayesoleo.errors import InputError

# A sum in another order rounds differently; a function that broadcasts wrongly is off by far more.
_SAME = 1e-9


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
                hint=f"y has {self._samples} samples: give x for as many",
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
