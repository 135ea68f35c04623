r"""Errors of a prediction against the noise, by run and output.

All rounds of the search use the same noise: the smallest that any of its models supports.

A test decides whether a residual agrees with its expected error. The squared ratio of the two is a
sum of squares of the noise's coefficients, which are many, and of the unknowns' errors, which may
be dominated by one direction. Its mean is one. Its variance and skewness follow from the quadratic
form, over all runs that share unknowns; the distribution is approximated by a shifted
:math:`\chi^2` variate with these three moments. Division by a measured noise makes it an F variate.

References
----------
Buckley and Eagleson (1988), Australian Journal of Statistics 30A(1), 150-159: three moments.
Satterthwaite (1946), Biometrics Bulletin 2(6), 110-114.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import stats

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array
from bayesoleo.data._noise import (
    LocalAverage,
    NoiseSpectrum,
    PeriodicAverage,
    local_average,
    local_means,
    noise_spectrum,
    periodic_average,
)
from bayesoleo.data._sample_quality import rounding_in_average
from bayesoleo.discovery._assembly import RecordNoise
from bayesoleo.discovery._fit import counted, of_those_counted, weights, without_masked
from bayesoleo.discovery._hold_out_error import Prediction, borne_out, sample_noise
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._run_errors import input_columns


@dataclass(frozen=True)
class RunError:
    """Error of one output in one run.

    Parameters
    ----------
    run, role, output : str
        Where.
    rms : float
        Root mean square over the raw samples, SI.
    average : PeriodicAverage or LocalAverage
        The residual averaged over the recorded periods; of a transient, over neighbouring samples.
    input_noise : float
        Part of the noise that comes from the input, SI.
    spectrum : NoiseSpectrum or None
        Of the noise that does not repeat; ``None`` for a transient.
    rounding : float
        Part of the noise that comes from rounding to coarse steps and repeats in every period, SI.
    input_scale : float
        Part of the noise that the input's records claim which the residual bears out, as a factor.
    expected_error : float, optional
        What noise and the unknowns' posterior let ``repeating`` be, SI; by default the noise.
    parameters : ndarray, shape (l, l)
        What independent unit errors of the unknowns add to the squared ratio to the expected error:
        a quadratic form. Empty for a run that was fitted.
    own_share : float
        Part of the squared expected error that is noise.
    own_coefficients : float, optional
        Equally noisy coefficients that this part scatters like; by default those of the output's
        own noise.
    """

    run: str
    role: str
    output: str
    rms: float
    average: PeriodicAverage | LocalAverage
    input_noise: float
    spectrum: NoiseSpectrum | None = None
    rounding: float = 0.0
    input_scale: float = 1.0
    expected_error: float | None = None
    parameters: Array = field(default_factory=lambda: np.zeros((0, 0)))
    own_share: float = 1.0
    own_coefficients: float | None = None

    @property
    def repeating(self) -> float:
        """Root mean square of the averaged residual."""
        return self.average.repeating

    @property
    def noise(self) -> float:
        """Standard error of that average, the input's noise and repeated rounding included."""
        own = self.average.noise if self.spectrum is None else self.spectrum.noise
        return float(np.sqrt(own**2 + self.input_noise**2 + self.rounding**2))

    @property
    def sigma(self) -> float:
        """Noise of a single sample, with what repeats as large as many periods would average it."""
        periods = self.average.samples / max(self.average.number, 1)
        return float(np.hypot(self.average.sigma, self.rounding * np.sqrt(periods)))

    @property
    def coefficients(self) -> float:
        """Degrees of freedom of the averaged residual, were it noise."""
        return self.average.number if self.spectrum is None else self.spectrum.coefficients

    @property
    def free(self) -> float:
        """Degrees of freedom that its noise was measured with."""
        if isinstance(self.average, LocalAverage):
            return self.average.free
        if self.spectrum is None:
            return self.average.samples - self.average.number
        return self.spectrum.free

    @property
    def ratio(self) -> float:
        """``repeating / noise``: one where nothing is missing and every parameter is known."""
        return self.repeating / self.noise

    @property
    def expected(self) -> float:
        """Root of the noise squared plus what the parameters' posterior does to this run, SI.

        A run that was fitted has lent some of its noise to the estimates, and is expected to leave
        a little less than its noise.
        """
        return self.noise if self.expected_error is None else self.expected_error

    @property
    def ratio_to_expected(self) -> float:
        """``repeating / expected``: one where nothing is missing."""
        return self.repeating / self.expected


@dataclass(frozen=True)
class ErrorTable:
    """Errors of all runs and outputs."""

    entries: tuple[RunError, ...]

    def at(self, output: str, run: str) -> RunError:
        """Error of one output in one run."""
        return next(e for e in self.entries if e.output == output and e.run == run)

    @property
    def record_noise(self) -> dict[tuple[str, str], RecordNoise]:
        """The noise of each output in each run, for later models of the same records."""
        return {
            (e.run, e.output): RecordNoise(e.average.sigma, e.input_noise) for e in self.entries
        }

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs in their order."""
        return tuple(dict.fromkeys(entry.output for entry in self.entries))

    def worst_ratio(self, role: str | None = None, key: str = "ratio_to_noise") -> float:
        """Largest ratio over outputs of the ratio pooled over runs of a role.

        Parameters
        ----------
        role : str, optional
            By default each.
        key : {"ratio_to_noise", "ratio_to_expected"}
            Which ratio.
        """
        roles = {entry.role for entry in self.entries} if role is None else {role}
        ratios = [self.pooled(r, o)[key] for r in roles for o in self.outputs]
        return float(np.max(ratios))  # not the built-in: a run that could not be solved must show

    def pooled(self, role: str, output: str) -> dict[str, float]:
        """Root mean squares over the runs of a role: ``rms``, ``repeating``, ``expected``,
        ``ratio_to_noise``, ``ratio_to_expected``."""
        chosen = [e for e in self.entries if e.role == role and e.output == output]

        def mean(values: Sequence[float]) -> float:
            return float(np.sqrt(np.mean(np.square(values))))

        return {
            "rms": mean([e.rms for e in chosen]),
            "repeating": mean([e.repeating for e in chosen]),
            "expected": mean([e.expected for e in chosen]),
            "ratio_to_noise": mean([e.ratio for e in chosen]),
            "ratio_to_expected": mean([e.ratio_to_expected for e in chosen]),
        }

    def by_run(self) -> dict[str, dict[str, dict[str, Any]]]:
        """As in the summary: output, run, then role, rms, repeating, noise, expected, ratios."""
        table: dict[str, dict[str, dict[str, Any]]] = {output: {} for output in self.outputs}
        for e in self.entries:
            table[e.output][e.run] = {
                "role": e.role,
                "rms": e.rms,
                "repeating": e.repeating,
                "noise": e.noise,
                "expected": e.expected,
                "ratio_to_noise": e.ratio,
                "ratio_to_expected": e.ratio_to_expected,
            }
        return table

    def by_role(self) -> dict[str, dict[str, dict[str, float]]]:
        """As in the summary: role, output, then what :meth:`pooled` gives."""
        roles = dict.fromkeys(entry.role for entry in self.entries)
        return {
            role: {output: self.pooled(role, output) for output in self.outputs} for role in roles
        }


def error_table(
    predictions: Sequence[Prediction],
    roles: Mapping[str, str],
    *,
    jobs: int | None = None,
    policy: SearchPolicy = SearchPolicy(),
) -> ErrorTable:
    """Compare predictions with what was measured.

    Parameters
    ----------
    predictions : sequence of Prediction
        One a run.
    roles : mapping of str to str
        Role of each run by label.
    jobs : int, optional
        Threads.
    policy : SearchPolicy

    Returns
    -------
    ErrorTable
    """
    rows = thread_map(lambda p: compared(p, roles, policy=policy)[0], predictions, jobs)
    return ErrorTable(tuple(entry for row in rows for entry in row))


def compared(
    prediction: Prediction,
    roles: Mapping[str, str],
    measured: Callable[[str, str], RecordNoise | None] = lambda output, label: None,
    *,
    policy: SearchPolicy = SearchPolicy(),
) -> tuple[list[RunError], Array]:
    """Errors of one run by output, and the input's noise in them.

    Parameters
    ----------
    prediction : Prediction
    roles : mapping of str to str
    measured : callable
        The noise of an output in a run where it was measured before; it grows no more.
    policy : SearchPolicy

    Returns
    -------
    list of RunError
    ndarray, shape (ny, k, N)
        Change of the outputs by one standard deviation of each input coefficient, as far as the
        residual bears it out, SI.
    """
    record, predictor = prediction.record, prediction.predictor
    columns = input_columns(predictor.runs[0], predictor.constants(prediction.vector[None], 0)[0])
    left = [record.samples[o] - prediction.y[b] for b, o in enumerate(predictor.outputs)]
    averages, spectra, before, shown = [], [], list[RecordNoise | None](), []
    for output, rest in zip(predictor.outputs, left, strict=True):
        residual = without_masked(record, rest)
        before.append(measured(output, record.label))
        averages.append(_average(record, output, residual, before[-1], policy))
        spectra.append(_spectrum(record, residual, averages[-1]))
        # Of a transient all samples: averages over neighbours show no fast noise, input's or not.
        shown.append(averages[-1].values if record.periodic else residual)
    averaged = columns if record.periodic else local_means(columns)
    spread = np.sqrt(np.mean(np.sum(averaged**2, axis=1), axis=1))
    scale = borne_out(columns, shown, drawn=not record.periodic, policy=policy)
    factors = [_factor(scale, size, known) for size, known in zip(spread, before, strict=True)]
    entries = [
        RunError(
            record.label,
            roles[record.label],
            output,
            float(np.sqrt(np.mean(left[b][weights(record) > 0] ** 2))),
            averages[b],
            float(factors[b] * spread[b]),
            spectra[b],
            rounding_in_average(record, output),
            factors[b],
        )
        for b, output in enumerate(predictor.outputs)
    ]
    return entries, columns * np.array(factors)[:, None, None]


def _factor(scale: float, spread: float, known: RecordNoise | None) -> float:
    """Part of the input's noise that counts: no more than was measured before, whatever a changed
    model would make of it."""
    if known is None or spread == 0:
        return scale
    return min(scale, known.input_noise / spread)


def _spectrum(
    record: Record, residual: Array, average: PeriodicAverage | LocalAverage
) -> NoiseSpectrum | None:
    if not record.periodic or not np.isfinite(residual).all():
        return None
    # What was bridged does not scatter: as much as is missing has to be made up for.
    part = counted(record) / record.time.size
    return noise_spectrum((residual - average.values) / part, record.periods)


def _average(
    record: Record,
    output: str,
    residual: Array,
    before: RecordNoise | None,
    policy: SearchPolicy,
) -> PeriodicAverage | LocalAverage:
    if not record.periodic:
        noise = sample_noise(record, output, residual, before, policy=policy)
        return local_average(residual, noise)
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    return of_those_counted(record, periodic_average(residual, step, record.frequency))


Noise = Mapping[tuple[str, str], RecordNoise]


def least_noise(one: Noise, other: Noise) -> dict[tuple[str, str], RecordNoise]:
    """By run and output the smaller of two measurements.

    A residual is nowhere smaller than the noise in it, whichever model leaves it: the least that
    was found is nearest. Where a run could not be solved nothing was measured.
    """
    found = {key: noise for key, noise in one.items() if _is_known(noise)}
    for key, noise in other.items():
        if not _is_known(noise):
            continue
        known = found.get(key, noise)
        found[key] = RecordNoise(
            min(known.sigma, noise.sigma), min(known.input_noise, noise.input_noise)
        )
    return found


def _is_known(noise: RecordNoise) -> bool:
    return bool(np.isfinite(noise.sigma) and np.isfinite(noise.input_noise))


def with_same_noise(table: ErrorTable, noise: Noise) -> ErrorTable:
    """Errors held against a noise that was found with another model."""
    return ErrorTable(
        tuple(
            _with_noise(entry, noise[entry.run, entry.output])
            if (entry.run, entry.output) in noise
            else entry
            for entry in table.entries
        )
    )


def _with_noise(entry: RunError, noise: RecordNoise) -> RunError:
    average, factor = entry.average, 1.0
    if isinstance(average, LocalAverage) and 0 < noise.sigma < average.sigma:
        factor = noise.sigma / average.sigma
        average = replace(average, sigma=noise.sigma, noise=factor * average.noise)
    if factor == 1.0 and not noise.input_noise < entry.input_noise:
        return entry
    from_input = min(entry.input_noise, noise.input_noise)
    scale = entry.input_scale * from_input / entry.input_noise if from_input else 0.0
    quiet = replace(entry, average=average, input_noise=from_input, input_scale=scale)
    if entry.expected_error is None:
        return quiet
    # What the parameters' posterior adds stays.
    square = entry.expected_error**2 - entry.noise**2 + quiet.noise**2
    square = max(square, entry.expected_error**2 * 1e-6)
    own = max(entry.own_share * entry.expected_error**2 - entry.noise**2 + quiet.noise**2, 0.0)
    return replace(
        quiet,
        expected_error=float(np.sqrt(square)),
        parameters=entry.parameters * entry.expected_error**2 / square,
        own_share=max(own / square, 1e-6),
    )


def limit(
    entries: Sequence[RunError], tests: int = 1, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Ratio to what is expected that chance hardly exceeds, at least the policy's ``floor_ratio``.

    Parameters
    ----------
    entries : sequence of RunError
        Over which the squared ratio is averaged.
    tests : int
        Ratios that are looked at together.
    policy : SearchPolicy
    """
    level = policy.floor_false_alarm / tests
    return max(policy.floor_ratio, math.sqrt(_quantile(entries, level)))


def lowest(
    entries: Sequence[RunError], tests: int = 1, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Ratio to what is expected that chance hardly falls below.

    The unknowns' errors may be nothing by chance, but noise is always there: the limit is that of
    the noise alone.

    Parameters
    ----------
    entries : sequence of RunError
        Over which the squared ratio is averaged.
    tests : int
        Ratios that are looked at together.
    policy : SearchPolicy
    """
    own = float(np.mean([entry.own_share for entry in entries]))
    none = np.zeros((0, 0))
    noise = [replace(e, parameters=none, own_share=e.own_share / own) for e in entries]
    share, number, free = _variate(noise)
    level = policy.floor_false_alarm / tests
    square = 1.0 + share * (float(stats.f.ppf(level, number, free)) - 1.0)
    return math.sqrt(own * max(square, 0.0))


def chance(entries: Sequence[RunError]) -> float:
    """Probability that chance alone gives a squared ratio to what is expected as large.

    Parameters
    ----------
    entries : sequence of RunError
        Over which it is averaged; not a number where a run could not be solved.
    """
    square = float(np.mean([entry.ratio_to_expected**2 for entry in entries]))
    share, number, free = _variate(entries)
    return float(stats.f.sf(1.0 + (square - 1.0) / share, number, free))


def _quantile(entries: Sequence[RunError], above: float) -> float:
    """Squared ratio that is exceeded with a probability."""
    share, number, free = _variate(entries)
    return 1.0 + share * (float(stats.f.isf(above, number, free)) - 1.0)


def _variate(entries: Sequence[RunError]) -> tuple[float, float, float]:
    """``b`` and degrees of freedom of an F variate, ``1 - b + b F`` being the squared ratio."""
    second, third = _moments(entries)
    # Mean one, variance 2 second, third cumulant 8 third.
    number = max(second**3 / third**2, 1e-3)
    free = len(entries) ** 2 / sum(entry.own_share**2 / entry.free for entry in entries)
    return second**2 / third, number, max(free, 1e-3)


def _moments(entries: Sequence[RunError]) -> tuple[float, float]:
    """Sums of the second and third powers of the quadratic form's eigenvalues, for the mean."""
    second = third = 0.0
    together: dict[int, np.ndarray] = {}
    for entry in entries:
        own, count = entry.own_share, entry.own_coefficients or entry.coefficients
        gram = entry.parameters
        trace, square = float(np.trace(gram)), float(np.sum(gram * gram))
        # Where the unknowns' errors lie in one coefficient of the noise it is more by its own.
        second += own**2 / count + 2.0 * own * trace / count
        third += own**3 / count**2 + 3.0 * (own**2 * trace / count**2 + own * square / count)
        if gram.size:
            together[len(gram)] = together.get(len(gram), 0.0) + gram
    for gram in together.values():  # the same errors of the unknowns in all runs
        second += float(np.sum(gram * gram))
        third += float(np.sum((gram @ gram) * gram))
    size = len(entries)
    return max(second / size**2, 1e-12), max(third / size**3, 1e-18)


def is_at_floor(table: ErrorTable, *, policy: SearchPolicy = SearchPolicy()) -> bool:
    """Whether every output, pooled over each role and in each run, is down to what is expected.

    A run that could not be solved is not.
    """
    entries = table.entries
    for role in {entry.role for entry in entries}:
        for output in table.outputs:
            chosen = [e for e in entries if e.role == role and e.output == output]
            pooled = float(np.sqrt(np.mean([entry.ratio_to_expected**2 for entry in chosen])))
            if not pooled < limit(chosen, policy=policy):
                return False
    together = len(entries)
    return all(e.ratio_to_expected < limit([e], together, policy=policy) for e in entries)


def too_quiet(table: ErrorTable, *, policy: SearchPolicy = SearchPolicy()) -> tuple[str, ...]:
    """Sentences on outputs that leave less than chance allows, pooled over the runs of a role.

    A residual below the noise says that the noise is not what was measured, not that all is well.
    """
    found = []
    for role in dict.fromkeys(entry.role for entry in table.entries):
        for output in table.outputs:
            chosen = [e for e in table.entries if e.role == role and e.output == output]
            numbers = table.pooled(role, output)
            ratio = numbers["ratio_to_expected"]
            least = lowest(chosen, policy=policy)
            if ratio < min(least, policy.least_ratio):
                found.append(
                    f"{output}: the error of the {role} runs is {numbers['repeating']:.3g},"
                    f" {ratio:.2f} times the expected {numbers['expected']:.3g}, and chance allows"
                    f" {least:.2f} at least: the noise was measured too large"
                )
    return tuple(found)
