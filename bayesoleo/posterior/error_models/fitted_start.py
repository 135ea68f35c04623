"""Where the quantities of an error model are most likely, with the residuals held."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

Array = NDArray[np.float64]

# Step of the differences, in coordinates of about unit spread.
_STEP = 1e-4
# A walker need not start at the top: the sampler goes on from here.
_TOLERANCE, _ITERATIONS = 1e-2, 60
# Furthest from the first guess: beyond it a share is zero or one for any purpose.
_REACH = 12.0


def climb(height: Callable[[Array], Array], guesses: Sequence[Array]) -> Array:
    """The best of the maxima that are reached from some guesses.

    Parameters
    ----------
    height : callable
        Of coordinates (W, m), shape (W,); what is not finite is taken for very low.
    guesses : sequence of ndarray, shape (m,)

    Returns
    -------
    ndarray, shape (m,)
    """

    def negative(eta: Array) -> tuple[float, Array]:
        steps = _STEP * np.eye(eta.size)
        values = height(np.concatenate([eta[None], eta + steps, eta - steps]))
        values = np.nan_to_num(values, nan=-1e12, neginf=-1e12)
        ahead, behind = values[1 : eta.size + 1], values[eta.size + 1 :]
        return -float(values[0]), -(ahead - behind) / (2 * _STEP)

    found = []
    for guess in guesses:
        bounds = [(u - _REACH, u + _REACH) for u in guess]
        options = {"maxiter": _ITERATIONS, "gtol": _TOLERANCE}
        found.append(
            optimize.minimize(
                negative, guess, jac=True, method="L-BFGS-B", bounds=bounds, options=options
            )
        )
    return np.asarray(min(found, key=lambda item: item.fun).x)
