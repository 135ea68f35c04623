r"""Residuals, changes of the outputs and linearised models by spectral line, where the noise is
independent.

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
from dataclasses import dataclass, field

import numpy as np
import scipy.fft
from scipy.special import digamma

from bayesoleo._types import Array, Integers
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import RunError
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.model._priors import LogNormal, LogUniform, Prior
from bayesoleo.prediction._records import Record

#: Harmonics of a periodic run, and lines of a transient, that are kept at most.
MOST_HARMONICS, MOST_COSINES = 600, 1500
#: Harmonics that are kept whether the outputs reach them or not, since corners of friction have a
#: hundred-thousandth of their power beyond; part of an output's power that may lie beyond the last.
FEWEST_HARMONICS, BEYOND = 60, 1e-5
#: Lines of a transient that are kept whether its signals lie there or not.
FIRST_COSINES = 300
#: A measured level of few lines is averaged with that of more lines around, as if it had so many
#: more: of lines from half to twice the frequency, and so many harmonics on either side.
PRIOR_LINES, SPREAD = 8.0, 3
#: Directions of the errors of the inputs that are kept in a run.
MOST_INPUTS = 40
#: Draws of an input's noise of which the first half shows directions, and the other half how much
#: noise lies along them.
INPUT_DRAWS = 64
#: Variance along a direction, over that of the outputs' own noise, from which it is kept as it is.
WORTH_A_DIRECTION = 2.0
#: Lines on either side over which the variance by draws of an input's noise is averaged.
NEIGHBOURS = 4
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
        """Variance of the noise on each coefficient of an output, SI, shape (size,).

        Rounding that repeats from period to period lies on the harmonics alone, where its power
        grows with the number of periods.
        """
        spectrum, mean = error.spectrum, max(error.average.sigma, 1e-300) ** 2
        if not self.record.periodic:
            return np.full(self.size, max(error.sigma, 1e-300) ** 2)
        repeats = np.tile(self.lines % self.record.periods == 0, 2)
        periods = error.average.samples / max(error.average.number, 1)
        rounding = np.where(repeats, error.rounding**2 * periods, 0.0)
        if spectrum is None:
            return mean + rounding
        free = max(2.0 * spectrum.lines, 1.0)
        around = _around(spectrum.level, SPREAD * spectrum.lines)
        level = (free * spectrum.level + PRIOR_LINES * around) / (free + PRIOR_LINES)
        chosen = level[np.minimum(self.lines, level.size - 1)]
        return np.maximum(np.tile(chosen, 2), 1e-6 * mean) + rounding

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

    def columns(
        self,
        by_run: Sequence[Array],
        acting: Sequence[Integers] | None = None,
        count: int | None = None,
    ) -> Array:
        """Coefficients ``(k, n)`` of signals ``(outputs, q, N)`` of each run.

        Parameters
        ----------
        by_run : sequence of ndarray, shape (outputs, q, N)
        acting : sequence of ndarray of int, shape (q,), optional
            Which of the rows these are in each run: all others are zero there.
        count : int, optional
            ``k``, the number of rows; of as many as each run has if they are all.
        """
        parts = []
        for r, (run, values) in enumerate(zip(self.runs, by_run, strict=True)):
            found = np.moveaxis(run.transformed(values), 1, 0)  # (q, outputs, size)
            rows = found.reshape(found.shape[0], -1)
            if acting is not None and count is not None:
                every = np.zeros((count, rows.shape[1]))
                every[acting[r]] = rows
                rows = every
            parts.append(rows)
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

    def noise(self, errors: Mapping[tuple[str, str], RunError]) -> Array:
        """Variance of the outputs' noise on each coefficient, shape (n,), SI.

        Parameters
        ----------
        errors : mapping of (run, output) to RunError
        """
        levels = [
            run.level(errors[run.record.label, output])
            for run in self.runs
            for output in self.outputs
        ]
        return np.concatenate(levels)

    def input_noise(
        self, inputs: Callable[[int], tuple[Array, int]], variance: Array
    ) -> tuple[Array, Array]:
        """Errors of the outputs by noise of measured inputs.

        An input's harmonic has one error, which all outputs and all their harmonics share, and
        which may be large where a force changes with the direction of motion. The largest of their
        principal directions are therefore kept as they are. So are those along which draws lie, as
        where a contact amplifies what came before it; of the rest of draws the variances are taken.

        Parameters
        ----------
        inputs : callable
            Change of the outputs ``(outputs, k, N)`` of a run, by its number, by one standard
            deviation of each of its inputs' coefficients, SI; how many of them, the first ones, are
            draws of errors and no errors.
        variance : ndarray, shape (n,)
            Of the outputs' own noise, SI.

        Returns
        -------
        ndarray, shape (k, n)
            Changes by one standard deviation of each of the kept errors.
        ndarray, shape (n,)
            Variance by the others.
        """
        rows, variances = [], []
        sizes = [run.size * len(self.outputs) for run in self.runs]
        for r, run in enumerate(self.runs):
            found, drawn = inputs(r)
            moved = np.moveaxis(run.transformed(found), 1, 0).reshape(-1, sizes[r])
            before, after = sum(sizes[:r]), sum(sizes[r + 1 :])
            kept, left = _along_draws(moved[:drawn], variance[before : before + sizes[r]])
            rest = _of_neighbours(np.sum(left**2, axis=0), run.size, len(left))
            known = moved[drawn:]
            shared = _principal(known)
            rest += np.maximum(np.sum(known**2, axis=0) - np.sum(shared**2, axis=0), 0.0)
            every = np.concatenate([kept, shared])
            rows.append(np.pad(every, ((0, 0), (before, after))))
            variances.append(rest)
        return np.concatenate(rows), np.concatenate(variances)

    def smooth(self) -> Array:
        """Variance on each coefficient of a smooth remainder of unit mean square, shape (n,)."""
        return np.concatenate([np.tile(run.smooth(), len(self.outputs)) for run in self.runs])


def _principal(rows: Array) -> Array:
    """The largest principal directions of changes ``(k, n)`` by independent errors, as changes."""
    if len(rows) <= MOST_INPUTS:
        return rows
    values, vectors = np.linalg.eigh(rows @ rows.T)
    order = np.argsort(-values)[:MOST_INPUTS]
    return np.asarray(vectors[:, order].T @ rows)


def _along_draws(moved: Array, variance: Array) -> tuple[Array, Array]:
    """Errors ``(k, n)`` along the directions that draws ``(m, n)`` have in common, and what draws
    are beside these ``(m // 2, n)``; sums of squares of either are variances.

    Directions are those of the first half, their variances those of the other half: along its own
    directions a few draws of any noise seem to lie altogether.
    """
    if not moved.any():
        return moved[:0], moved
    # Alternately: the draws of one channel follow those of another.
    first, other = (
        part * np.sqrt(len(moved) / len(part)) / np.sqrt(variance)
        for part in (moved[::2], moved[1::2])
    )
    directions = np.linalg.svd(first, full_matrices=False)[2]
    along = other @ directions.T
    values, vectors = np.linalg.eigh(along.T @ along)
    chosen = np.flatnonzero(values > WORTH_A_DIRECTION)[::-1][:MOST_INPUTS]
    axes = vectors[:, chosen].T @ directions
    kept = np.sqrt(values[chosen])[:, None] * axes
    left = other - (other @ axes.T) @ axes
    return kept * np.sqrt(variance), left * np.sqrt(variance)


def _around(level: Array, more: int) -> Array:
    """Mean level of the lines from half to twice each line's number, and some more, shape (K,).

    The mean of all lines would be too small where noise is slow, and promise too much there.
    """
    line = np.arange(level.size)
    low, high = np.maximum(line // 2 - more, 0), np.minimum(2 * line + more + 1, level.size)
    total = np.concatenate([[0.0], np.cumsum(level)])
    return np.asarray((total[high] - total[low]) / (high - low))


def _of_neighbours(variance: Array, size: int, draws: int) -> Array:
    """Variances of a few draws on lines ``(outputs * size,)``, averaged over neighbouring lines.

    A line that some draws happen to miss would count what is left there many times. Logarithms are
    averaged: beside a resonance the level falls by decades over a few lines.
    """
    if not draws or not variance.any():
        return variance
    # The logarithm of a variance of n draws lies this much below that of its mean.
    low = float(digamma(0.5 * draws) - np.log(0.5 * draws))
    logs = np.log(np.maximum(variance.reshape(-1, size), 1e-12 * variance.max())) - low
    window = np.ones(min(2 * NEIGHBOURS + 1, size))
    count = np.convolve(np.ones(size), window, "same")
    return np.exp([np.convolve(row, window, "same") / count for row in logs]).ravel()


@dataclass(frozen=True)
class EstimatedModel:
    """An estimated model, about which structures are compared.

    Parameters
    ----------
    fit : ModelFit
    effects : mapping of (effect, target) to tuple of str
        Those that it has, with the names of their amplitudes.
    shapes : mapping of str to tuple of float
        Scanned values of their shape parameters. A shape has a prior that is normal in its
        logarithm, with the centre and the spread of the whole scan, as scores have.
    """

    fit: ModelFit
    effects: Mapping[Added, tuple[str, ...]]
    shapes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def amplitudes(self) -> list[int]:
        """Numbers of the amplitudes among the unknowns, effect by effect."""
        return [
            k
            for names in self.effects.values()
            for k, name in enumerate(self.fit.problem.names)
            if name.split("[")[0] in names
        ]


@dataclass(frozen=True)
class LinearisedModel:
    """Outputs about an estimate.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        With the amplitudes of the anchor's effects at zero.
    unknowns : ndarray, shape (l, n)
        Columns of unknowns in units of their priors.
    offset : ndarray, shape (l,)
        Centres of their priors.
    own : ndarray, shape (k, n)
        Columns of the amplitudes of the anchor's effects.
    names : tuple of str, length l
    theta : ndarray, shape (l,)
        Estimates, SI.
    change : ndarray, shape (l, l)
        Changes of the parameters (rows), SI, by the unknowns.
    priors : tuple of Prior, length l
    """

    residual: Array
    unknowns: Array
    offset: Array
    own: Array
    names: tuple[str, ...]
    theta: Array
    change: Array
    priors: tuple[Prior, ...]


def linearised(anchor: EstimatedModel, data: SpectralData) -> LinearisedModel:
    """Residual and columns about an anchor."""
    fit = anchor.fit
    problem, theta = fit.problem, fit.point.theta
    place = [fit.predictor.layout.names.index(name) for name in problem.names]
    rows = data.columns([p.sensitivity[:, place] for p in fit.predictions])
    amplitudes = anchor.amplitudes
    rest = [k for k in range(len(problem.names)) if k not in amplitudes]
    scale = PriorScale.of(problem.priors, problem.names)
    precision = (scale.root.T @ scale.root)[np.ix_(rest, rest)]
    # An estimator's slope is of the density per unit of a parameter. What is integrated out here is
    # its logarithm where the prior is log-normal.
    slope = scale.slope(theta) + np.where(scale.logarithmic, scale.spread, 0.0)
    unit, slope = scale.unit(theta)[rest], np.nan_to_num(slope[rest])
    priors = [problem.priors[k] for k in rest]
    for k, index in enumerate(rest):
        scan, prior = anchor.shapes.get(problem.names[index]), priors[k]
        if scan is not None:
            centre, spread = scan_prior(scan)
            priors[k] = LogNormal(float(np.exp(centre)), spread)
        elif isinstance(prior, LogUniform):
            # Near its lower limit its slope is no prior of normal form.
            centre = 0.5 * float(np.log(prior.low * prior.high))
            spread = float(np.log(prior.high / prior.low)) / np.sqrt(12.0)
        else:
            continue
        unit[k], slope[k] = theta[index] * spread, (centre - np.log(theta[index])) / spread
    root = np.linalg.cholesky(precision)  # lower, of the precision: root' delta has unit variance
    unknowns = np.linalg.solve(root, rows[rest] * unit[:, None])
    offset = np.linalg.solve(root, slope)
    own = rows[amplitudes]
    return LinearisedModel(
        # The prior of an effect's amplitude is centred on its absence, not on its estimate.
        data.residual(fit) + theta[amplitudes] @ own,
        unknowns,
        offset,
        own,
        tuple(problem.names[k] for k in rest),
        theta[rest],
        unit[:, None] * np.linalg.inv(root).T,
        tuple(priors),
    )


def scan_prior(values: Sequence[float]) -> tuple[float, float]:
    """Centre and standard deviation of the logarithm of a shape, as wide as its scan."""
    logs = np.log(np.asarray(values, dtype=float))
    # Each value stands for the range half way to its neighbours.
    step = np.mean(np.diff(logs)) if logs.size > 1 else 1.0
    return float(logs.mean()), float((np.ptp(logs) + step) / np.sqrt(12.0))
