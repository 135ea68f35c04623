"""Whether effects explain what is left of transients better than noise of its own spectrum.

Slow noise and noise that rings have waves as effects have them: beside white noise either explains
the other. Here the noise gets all the power that is left, at each frequency. An effect that acts
has the waveform of what is left, and not only its spectrum: along it the residual is far larger
than noise of that spectrum lets expect.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from scipy import linalg

from bayesoleo._types import Array, Flags
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._refit import noise_of_fit
from bayesoleo.discovery._transient_variance import RunNoise
from bayesoleo.error_models._signatures import Signatures

#: Part of the mean power of all lines that noise has at each of them at least.
LEAST_POWER = 1e-6
#: Part of a record at either end over which samples fade.
END = 0.1
#: Squared length beside all others below which a direction counts as one of theirs.
LEAST_BESIDE = 1e-8


def gain_beside_colour(fit: ModelFit, signatures: Signatures) -> float:
    """Rise of the log-likelihood by effects, over what unknowns without effect would raise it.

    The best effect alone counts, or all together; each unknown costs half the logarithm of the
    number of samples, and a choice among effects that of their number.

    Parameters
    ----------
    fit : ModelFit
    signatures : Signatures
        Of all effects in its runs.

    Returns
    -------
    float
        Infinite where runs that repeat are among the fitted ones: these tell noise from effects.

    References
    ----------
    Schwarz (1978), Annals of Statistics 6(2), 461-464.
    """
    if any(record.periodic for record in fit.records):
        return np.inf
    left, moved, effects = [], [], []
    for whole, record, columns in zip(
        noise_of_fit(fit), fit.records, signatures.columns, strict=True
    ):
        run, window = _tapered(whole), _window(whole)
        left.append(_whitened(run.residual, run))
        moved.append(_whitened(run.columns, run))
        effects.append(_whitened(window * _placed(columns, record.kept, run), run))
    residual = np.concatenate(left)
    basis = linalg.orth(np.concatenate(moved, axis=-1).T)
    rows = np.concatenate(effects, axis=-1)
    rows -= (rows @ basis) @ basis.T
    residual -= basis @ (basis.T @ residual)
    return _best_gain(rows, residual)


def _best_gain(rows: Array, residual: Array) -> float:
    """Largest gain of one of some rows (k, n), or of all, in noise of unit variance."""
    length = np.linalg.norm(rows, axis=1)
    there = np.isfinite(length) & (length > 0.0)
    if not there.any():
        return -np.inf
    rows = rows[there] / length[there, None]
    along, cost = rows @ residual, 0.5 * float(np.log(residual.size))
    alone = 0.5 * float(np.max(along**2)) - cost - float(np.log(len(rows)))
    size, axes = np.linalg.eigh(rows @ rows.T)
    own = size > LEAST_BESIDE * size[-1]
    together = 0.5 * float(np.sum((axes[:, own].T @ along) ** 2 / size[own]))
    return max(alone, together - cost * int(own.sum()))


def _window(run: RunNoise) -> Array:
    """Weights of the samples that fall to zero at both ends."""
    # Only transients need it, and loading it takes as long as much of a search of periodic runs.
    from scipy import signal

    return np.asarray(signal.windows.tukey(run.samples, 2.0 * END))


def _tapered(run: RunNoise) -> RunNoise:
    """The same without its ends. A transform takes a record as a part of one that repeats: the jump
    from its end to its beginning, where noise is slow, would be one wave for noise and effects."""
    window = _window(run)
    return RunNoise(window * run.residual, window * run.columns, run.covariance)


def _placed(columns: Array, kept: Flags | None, run: RunNoise) -> Array:
    """Signatures (s, k, n) of the samples that count, at all samples of a run, (k, s, N)."""
    found = np.zeros((columns.shape[1], columns.shape[0], run.samples))
    found[..., slice(None) if kept is None else kept] = np.moveaxis(columns, 1, 0)
    return found


def _whitened(values: Array, run: RunNoise) -> Array:
    """Outputs one after the other, (..., s N), by the spectrum of what is left of each."""
    level = np.maximum(run.own_level, LEAST_POWER * run.variance)
    rows = scipy.fft.irfft(scipy.fft.rfft(values) / np.sqrt(level), n=run.samples)
    return np.asarray(rows.reshape(*values.shape[:-2], values.shape[-2] * values.shape[-1]))
