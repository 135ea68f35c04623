"""Project directions out of others by their products alone, and know when nothing is left."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array

#: A squared residual norm below this part of the squared norm is no direction of its own: the
#: sensitivities themselves are good to some seven digits beside those of the model.
LEAST = 1e-8
#: Sums of products over some 1e5 samples are good to this part of the size of what they sum.
ROUND_OFF = 1e3 * float(np.finfo(float).eps)


def coefficients(gram: Array, cross: Array) -> Array:
    """Coefficients ``(l, k)`` of directions on others, from ``J' W J`` and ``J' W C``.

    The gram matrix is brought to a unit diagonal, so that units do not matter; directions that it
    does not determine to the last digit are held back rather than cut off.
    """
    if not len(gram):
        return np.zeros_like(cross)
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    floor = 10 * len(gram) * np.finfo(float).eps * max(values.max(), 1e-300)
    inverse = vectors / np.maximum(values, floor)
    return cast(Array, (inverse @ (vectors.T @ (cross / scale[:, None]))) / scale[:, None])


def remains(gram: Array, project: Array, own: Array, information: Array) -> NDArray[np.bool_]:
    """Which directions ``(k,)`` are more than round-off beside those projected out.

    What is left of a direction's squared norm is the difference of large parts where the model's
    own directions nearly cancel each other: ``|x|' |G| |x|`` with the coefficients ``x``.

    Parameters
    ----------
    gram : ndarray, shape (l, l)
        ``J' W J``.
    project : ndarray, shape (l, k)
        Of :func:`coefficients`.
    own, information : ndarray, shape (k, k)
        ``C' W C`` before, and what is left after.
    """
    size = np.abs(project)
    parts = np.einsum("ik,ij,jk->k", size, np.abs(gram), size)
    before, left = np.diag(own), np.diag(information)
    kept: NDArray[np.bool_] = left > np.maximum(LEAST * before, ROUND_OFF * parts)
    return kept


def squared_distance(value: Array, covariance: Array) -> float:
    """``value' covariance^-1 value`` of values (k,) in units that may differ by any factor.

    Directions that the covariance does not have, to twelve digits of its correlations, are left
    out.
    """
    sd = np.sqrt(np.diag(covariance))
    unit = np.where(sd > 0, sd, 1.0)
    scaled = value / unit
    return float(
        scaled @ np.linalg.lstsq(covariance / np.outer(unit, unit), scaled, rcond=1e-12)[0]
    )
