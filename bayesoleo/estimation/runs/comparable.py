"""Which runs and parameters can be compared: those that are determined by enough of each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError

#: A run says nothing of a parameter where its data alone leave the standard deviation a thousand
#: times larger than the prior does: in a mean over runs its weight would be a millionth.
UNDETERMINED = 1e-6
#: Smallest eigenvalue of a matrix of correlations, a parameter, that rounding can be told from.
SINGULAR = 10 * float(np.finfo(float).eps)


@dataclass(frozen=True)
class Comparable:
    """What of some per-run estimates can be compared.

    Parameters
    ----------
    runs : ndarray of bool, shape (N,)
    parameters : ndarray of bool, shape (l,)
    left_out : tuple of str
        The others, each with the reason.
    """

    runs: NDArray[np.bool_]
    parameters: NDArray[np.bool_]
    left_out: tuple[str, ...]


def comparable(each: xr.Dataset) -> Comparable:
    """Parameters that most runs determine, and the runs that determine all of those.

    Parameters
    ----------
    each : xarray.Dataset
        From :func:`~bayesoleo.estimation.estimate_each`.
    """
    good = each["status"].values == "converged"
    names = each[schema.PARAMETER].values.astype(str)
    runs = each[schema.RUN].values.astype(str)
    covariances = each["covariance_likelihood"].values
    determined = _determined(each)
    # A run whose covariance is lost as a whole tells no parameter from another.
    regular = good & np.isfinite(np.diagonal(covariances, axis1=1, axis2=2)).any(axis=1)
    kept = 2 * determined[regular].sum(axis=0) > regular.sum()
    usable = regular & determined[:, kept].all(axis=1)
    usable[usable] = [_is_definite(S) for S in covariances[usable][:, kept][:, :, kept]]
    held = str(each.attrs.get("held", "")).split(", ")
    left_out = _left_out(names, runs, good, regular, determined, kept, usable, held)
    return Comparable(usable, kept, left_out)


def _determined(each: xr.Dataset) -> NDArray[np.bool_]:
    """Which parameters a run's data determine beside the prior, shape (N, l)."""
    alone, with_prior = (
        np.diagonal(each[name].values, axis1=1, axis2=2)
        for name in ("covariance_likelihood", schema.COVARIANCE)
    )
    possible = np.isfinite(alone) & (alone > 0)
    # Without a finite covariance under the prior there is nothing to compare with.
    compared = np.isfinite(with_prior) & (with_prior > 0)
    return possible & ~(compared & (with_prior < UNDETERMINED * np.where(possible, alone, 1.0)))


def check_definite(run: str, covariance: Array, names: Sequence[str]) -> None:
    """Raise where a covariance is singular, with the parameters that are to blame."""
    if _is_definite(covariance):
        return
    variance = np.diag(covariance)
    lacking = [n for n, v in zip(names, variance, strict=True) if not (np.isfinite(v) and v > 0)]
    raise InputError(
        "the covariance of this run's estimate is not positive definite",
        run=run,
        key=", ".join(lacking or names),
        hint="leave the run or the parameter out",
    )


def _is_definite(covariance: Array) -> bool:
    """Whether a covariance is positive definite, in the units of its own standard deviations."""
    variance = np.diag(covariance)
    if not (variance.size and np.isfinite(covariance).all() and (variance > 0).all()):
        return False
    sd = np.sqrt(variance)
    return bool(np.linalg.eigvalsh(covariance / np.outer(sd, sd))[0] > SINGULAR * sd.size)


def _left_out(
    names: NDArray[np.str_],
    runs: NDArray[np.str_],
    good: NDArray[np.bool_],
    regular: NDArray[np.bool_],
    determined: NDArray[np.bool_],
    kept: NDArray[np.bool_],
    usable: NDArray[np.bool_],
    held: Sequence[str],
) -> tuple[str, ...]:
    """What is not compared, and why, a clause each."""
    said = []
    for k in np.flatnonzero(~kept) if regular.any() else ():
        if names[k] in held:
            said.append(f"parameter {names[k]}, held: a constant known to a tolerance")
            continue
        where = ", ".join(runs[regular & ~determined[:, k]])
        said.append(f"parameter {names[k]}, not determined by run {where}")
    for n in np.flatnonzero(~usable):
        lacking = ", ".join(names[kept & ~determined[n]])
        if not good[n]:
            said.append(f"run {runs[n]}, did not converge")
        elif regular[n] and lacking:
            said.append(f"run {runs[n]}, does not determine {lacking}")
        elif kept.any() or not regular[n]:
            said.append(f"run {runs[n]}, does not tell {', '.join(names)} apart")
    return tuple(said)
