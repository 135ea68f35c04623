"""Gradient and Hessian of a density from one batch of rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayesoleo._types import Array

#: Finite-difference step in standard deviations: log density changes by 0.03, far above rounding
#: and solver noise.
STEP = 0.25


def derivatives(
    height: Callable[[Array], Array], phi: Array, factor: Array
) -> tuple[float, Array, Array]:
    """Height, gradient and Hessian by central differences in ``z`` of ``phi + factor @ z``.

    Parameters
    ----------
    height : callable
        Of rows, shape (W, d), shape (W,). Called once, with ``d^2 + d + 1`` rows.
    phi : ndarray, shape (d,)
    factor : ndarray, shape (d, d)
        Makes ``z`` a vector of standard deviations, roughly.

    Returns
    -------
    height : float
    gradient : ndarray, shape (d,)
    hessian : ndarray, shape (d, d)
    """
    d, h = len(phi), STEP
    unit = h * np.eye(d)
    pairs = [(i, j) for i in range(d) for j in range(i)]
    both = np.array([unit[i] + unit[j] for i, j in pairs]).reshape(-1, d)
    rows = np.concatenate([np.zeros((1, d)), unit, -unit, both, -both])
    values = height(phi + rows @ factor.T)
    centre, up, down = values[0], values[1 : d + 1], values[d + 1 : 2 * d + 1]
    with np.errstate(invalid="ignore"):
        gradient = (up - down) / (2 * h)
        hessian = np.diag((up - 2 * centre + down) / h**2)
        diagonal = up + down - 2 * centre
        twice = values[2 * d + 1 : 2 * d + 1 + len(pairs)] + values[2 * d + 1 + len(pairs) :]
        for (i, j), sum_of_two in zip(pairs, twice, strict=True):
            mixed = (sum_of_two - 2 * centre - diagonal[i] - diagonal[j]) / (2 * h**2)
            hessian[i, j] = hessian[j, i] = mixed
    return float(centre), gradient, hessian
