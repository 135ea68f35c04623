r"""Residuals and changes of the outputs by spectral line, where the noise is independent.

Noise that is stationary has nearly independent coefficients in a Fourier basis, each with the
variance that its spectrum gives. Measured noise of any colour is therefore diagonal here. A
periodic run keeps its harmonics and the lines below the first one; a transient keeps the lines of
its cosine transform on which its signals lie. All transforms are orthonormal, so that white noise
has the variance of a sample on every line.

References
----------
Pintelon and Schoukens (2012), *System Identification: A Frequency Domain Approach*, section 2.4:
distribution of the coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft

from bayesoleo._types import Array, Integers
from bayesoleo.discovery._error_table import RunError
from bayesoleo.discovery._fit import ModelFit, weights
from bayesoleo.prediction._records import Record

#: Harmonics of a periodic run, and lines of a transient, that are kept at most.
MOST_HARMONICS, MOST_COSINES = 600, 1500
#: Harmonics that are kept whether the outputs reach them or not, since corners of friction have a
#: hundred-thousandth of their power beyond; part of an output's power that may lie beyond the last.
FEWEST_HARMONICS, BEYOND = 60, 1e-5
#: Lines of a transient that are kept whether its signals lie there or not.
FIRST_COSINES = 300
#: A measured level of few lines is averaged with that of all lines as if it had so many more.
PRIOR_LINES = 8.0
#: Lengths, in cycles, of the squared exponentials whose mean is the spectrum of a smooth remainder.
SMOOTHNESS = (0.02, 0.05, 0.2)


@dataclass(frozen=True)
class RunLines:
    """Lines of one run that are kept.

    Parameters
    ----------
    record : Record
    lines : ndarray of int, shape (n,)
        Numbers of the lines, in a Fourier transform of all samples or in a cosine transform.
    """

    record: Record
    lines: Integers

    @classmethod
    def of(cls, record: Record, outputs: Array, sensitivity: Array) -> RunLines:
        """Choose lines.

        Parameters
        ----------
        record : Record
        outputs : ndarray, shape (ny, N)
            As predicted.
        sensitivity : ndarray, shape (ny, l, N)
        """
        size = record.time.size
        if record.periodic:
            harmonics = np.arange(0, size // 2 + 1, record.periods)
            power = np.abs(scipy.fft.rfft(outputs, axis=-1)[:, harmonics]) ** 2
            share = np.cumsum(power, axis=1) / np.maximum(power.sum(axis=1, keepdims=True), 1e-300)
            reached = int(np.max(np.sum(share < 1.0 - BEYOND, axis=1)))
            last = min(max(reached, FEWEST_HARMONICS), MOST_HARMONICS)
            return cls(record, np.union1d(harmonics[: last + 1], np.arange(record.periods)))
        signals = np.concatenate([outputs, sensitivity.reshape(-1, size)])
        power = scipy.fft.dct(signals, norm="ortho", axis=-1) ** 2
        largest = np.max(power / np.maximum(power.sum(axis=1, keepdims=True), 1e-300), axis=0)
        chosen = np.argsort(-largest)[:MOST_COSINES]
        return cls(record, np.union1d(chosen, np.arange(min(FIRST_COSINES, size))))

    @property
    def size(self) -> int:
        """Number of real coefficients of one output."""
        return self.lines.size * (2 if self.record.periodic else 1)

    @property
    def cycles(self) -> Array:
        """Cycles of each coefficient, per period or per twice the length of a transient, (size,).

        Not a number for what does not repeat in a periodic run.
        """
        if not self.record.periodic:
            return np.asarray(0.5 * self.lines)
        order = np.where(self.lines % self.record.periods == 0, self.lines, np.nan)
        return np.tile(order / self.record.periods, 2)

    def transformed(self, values: Array) -> Array:
        """Coefficients ``(..., size)`` of signals ``(..., N)``; masked samples count as zero."""
        kept = np.asarray(values) * weights(self.record)
        if not self.record.periodic:
            found: Array = scipy.fft.dct(kept, norm="ortho", axis=-1)[..., self.lines]
            return found
        size = kept.shape[-1]
        single = (self.lines == 0) | (2 * self.lines == size)
        root = np.where(single, 1.0, np.sqrt(2.0))
        chosen = scipy.fft.rfft(kept, norm="ortho", axis=-1)[..., self.lines] * root
        return np.concatenate([chosen.real, chosen.imag], axis=-1)

    def level(self, error: RunError) -> Array:
        """Variance of the noise on each coefficient of an output, SI, shape (size,)."""
        spectrum = error.spectrum
        if not self.record.periodic or spectrum is None:
            return np.full(self.size, max(error.sigma, 1e-300) ** 2)
        mean, free = error.sigma**2, max(2.0 * spectrum.lines, 1.0)
        level = (free * spectrum.level + PRIOR_LINES * mean) / (free + PRIOR_LINES)
        chosen = level[np.minimum(self.lines, level.size - 1)]
        return np.maximum(np.tile(chosen, 2), 1e-6 * max(mean, 1e-300))

    def smooth(self) -> Array:
        """Variance on each coefficient of a smooth function of unit mean square, shape (size,)."""
        cycles = self.cycles
        power = np.zeros(cycles.size)
        for length in SMOOTHNESS:
            own = np.exp(-0.5 * (2 * np.pi * length * np.nan_to_num(cycles)) ** 2)
            own = np.where(np.isnan(cycles), 0.0, own)
            power += own / own.sum() / len(SMOOTHNESS)
        return self.record.time.size * power


@dataclass(frozen=True)
class SpectralData:
    """Lines of all runs, and how signals are laid out on them: runs, in each its outputs.

    Parameters
    ----------
    runs : tuple of RunLines
    outputs : tuple of str
    """

    runs: tuple[RunLines, ...]
    outputs: tuple[str, ...]

    @classmethod
    def of(cls, fit: ModelFit) -> SpectralData:
        """Lines of the fitted runs."""
        runs = [
            RunLines.of(record, predicted.y, predicted.sensitivity)
            for record, predicted in zip(fit.records, fit.predictions, strict=True)
        ]
        return cls(tuple(runs), tuple(fit.predictor.outputs))

    @property
    def samples(self) -> int:
        """Number of samples of all runs and outputs."""
        return sum(run.record.time.size for run in self.runs) * len(self.outputs)

    @property
    def output_of(self) -> Integers:
        """Number of the output that each coefficient belongs to, shape (n,)."""
        return np.concatenate([np.repeat(np.arange(len(self.outputs)), r.size) for r in self.runs])

    def columns(self, by_run: Sequence[Array]) -> Array:
        """Coefficients ``(k, n)`` of signals ``(outputs, k, N)`` of each run."""
        parts = []
        for run, values in zip(self.runs, by_run, strict=True):
            found = np.moveaxis(run.transformed(values), 1, 0)  # (k, outputs, size)
            parts.append(found.reshape(found.shape[0], -1))
        return np.concatenate(parts, axis=1)

    def residual(self, fit: ModelFit) -> Array:
        """Coefficients ``(n,)`` of the residual of a fit to these runs, SI."""
        pairs = zip(fit.predictor.runs, fit.predictions, strict=True)
        rows = self.columns([(run.measured - p.y)[:, None] for run, p in pairs])
        return np.asarray(rows[0])

    def signal(self, fit: ModelFit) -> Array:
        """Root mean square of each output about its mean, largest over the runs, SI, (outputs,)."""
        every = [np.std(run.measured, axis=1) for run in fit.predictor.runs]
        return np.asarray(np.max(every, axis=0))

    def noise(
        self,
        errors: Mapping[tuple[str, str], RunError],
        inputs: Callable[[int], Array] | None = None,
    ) -> Array:
        """Variance of the noise on each coefficient, shape (n,), SI.

        Parameters
        ----------
        errors : mapping of (run, output) to RunError
        inputs : callable, optional
            Change of the outputs ``(outputs, k, N)`` of a run, by its number, by one standard
            deviation of each of its input's coefficients. Their variances are added; what they
            have in common over lines and outputs is not counted.
        """
        parts = []
        for r, run in enumerate(self.runs):
            moved = None if inputs is None else run.transformed(inputs(r))
            for b, output in enumerate(self.outputs):
                level = run.level(errors[run.record.label, output])
                parts.append(level if moved is None else level + np.sum(moved[b] ** 2, axis=0))
        return np.concatenate(parts)

    def smooth(self) -> Array:
        """Variance on each coefficient of a smooth remainder of unit mean square, shape (n,)."""
        return np.concatenate([np.tile(run.smooth(), len(self.outputs)) for run in self.runs])
