r"""Fit and hold-out error: errors of a prediction against the noise, by run and output.

Hold-out runs are predicted in ``_run_predictions.py``; how large their error may be follows in
``_expected_error.py``, and whether an effect lowers it in ``_hold_out_confirmation.py``. All rounds
of the search use the same noise: the smallest that any of its models supports.

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

from bayesoleo import _distributions as distributions
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
from bayesoleo.data._sample_quality import emptied_lines, rounding_in_average
from bayesoleo.discovery._assembly import RecordNoise
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import Prediction, borne_out, sample_noise
from bayesoleo.discovery._samples_that_count import (
    counted,
    of_those_counted,
    weights,
    without_masked,
)
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._run_errors import errors_known, input_columns

Noise = Mapping[tuple[str, str], RecordNoise]


@dataclass(frozen=True)
class RunError:
    """Error of one output in one run.

    Parameters
    ----------
    run, role, output : str
        Run, its role, and output.
    rms : float
        Root mean square over the raw samples, SI.
    average : PeriodicAverage or LocalAverage
        The residual averaged over the recorded periods; of a transient, over neighbouring samples.
    input_noise : float
        Part of the noise that comes from the input, SI.
    spectrum : NoiseSpectrum or None
        Spectrum of the noise that does not repeat; ``None`` for a transient.
    rounding : float
        Part of the noise that comes from rounding to coarse steps and repeats in every period, SI.
    input_scale : float
        Factor by which the residual limits the propagated noise of the input.
    expected_error : float, optional
        Expected ``repeating`` by noise and the unknowns' posterior, SI; by default the noise.
    parameters : ndarray, shape (l, l)
        Quadratic form: the squared ratio to the expected error that independent unit errors of the
        unknowns add. Empty for a fitted run.
    own_share : float
        Part of the squared expected error that is noise.
    own_coefficients : float, optional
        Effective number of coefficients of this part; by default that of the output's own noise.
    feigned : float, optional
        Mean square beyond their noise that single samples of a transient may show by chance, by the
        input's noise and by errors of the unknowns, SI; by default any.
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
    feigned: float = np.inf

    @property
    def repeating(self) -> float:
        """Root mean square of the averaged residual.

        Averages of a transient take errors away that are fast beside them: over whole swings
        nothing is left. It is at least what noise would have with what single samples show beyond
        chance.
        """
        averaged = self.average.repeating
        beyond = self.rms**2 - self.sigma**2 - self.feigned
        if beyond > averaged**2 - self.noise**2:
            return float(np.sqrt(self.noise**2 + beyond))
        return averaged

    @property
    def noise(self) -> float:
        """Standard error of that average, the input's noise and repeated rounding included."""
        own = self.average.noise if self.spectrum is None else self.spectrum.noise
        return float(np.sqrt(own**2 + self.input_noise**2 + self.rounding**2))

    @property
    def sigma(self) -> float:
        """Noise of a single sample, including repeated rounding as if averaged over the periods."""
        periods = self.average.samples / max(self.average.number, 1)
        return float(np.hypot(self.average.sigma, self.rounding * np.sqrt(periods)))

    @property
    def coefficients(self) -> float:
        """Degrees of freedom of the averaged residual if it is noise."""
        return self.average.number if self.spectrum is None else self.spectrum.coefficients

    @property
    def free(self) -> float:
        """Degrees of freedom of the measured noise."""
        if isinstance(self.average, LocalAverage):
            return self.average.free
        if self.spectrum is None:
            return self.average.samples - self.average.number
        return self.spectrum.free

    @property
    def ratio(self) -> float:
        """``repeating / noise``: one where no effect is missing and every parameter is known."""
        return self.repeating / self.noise

    @property
    def expected(self) -> float:
        """Root of the squared noise plus the variance by the parameters' posterior, SI.

        The estimates absorb some of the noise of a fitted run, whose expected error is therefore
        slightly less than its noise.
        """
        return self.noise if self.expected_error is None else self.expected_error

    @property
    def ratio_to_expected(self) -> float:
        """``repeating / expected``: one where no effect is missing."""
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
            (e.run, e.output): RecordNoise(e.average.sigma, e.input_noise, e.rms)
            for e in self.entries
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
    """Compare predictions with measurements.

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
        Earlier noise of an output in a run, which is an upper bound; None where there is none.
    policy : SearchPolicy

    Returns
    -------
    list of RunError
    ndarray, shape (ny, k, N)
        Change of the outputs by one standard deviation of each input coefficient, limited by the
        residual, SI.
    """
    record, predictor = prediction.record, prediction.predictor
    run = predictor.runs[0]
    columns = input_columns(run, predictor.constants(prediction.vector[None], 0)[0])
    left = [record.samples[o] - prediction.y[b] for b, o in enumerate(predictor.outputs)]
    averages, spectra, before, shown = [], [], list[RecordNoise | None](), []
    for output, rest in zip(predictor.outputs, left, strict=True):
        residual = without_masked(record, rest)
        before.append(measured(output, record.label))
        averages.append(_average(record, output, residual, before[-1], policy))
        spectra.append(_spectrum(record, output, residual, averages[-1]))
        # All samples of a transient are used: averages over neighbours contain no fast noise.
        shown.append(averages[-1].values if record.periodic else residual)
    averaged = columns if record.periodic else local_means(columns, record.kept)
    spread, of_samples = (
        np.sqrt(np.mean(np.sum(part**2, axis=1), axis=1)) for part in (averaged, columns)
    )
    drawn = not (record.periodic and errors_known(run))
    scale = borne_out(columns, shown, drawn=drawn, policy=policy)
    rms = [float(np.sqrt(np.mean(rest[weights(record) > 0] ** 2))) for rest in left]
    each = zip(spread, before, rms, strict=True)
    factors = [_factor(scale, size, known, size_left) for size, known, size_left in each]
    entries = [
        RunError(
            record.label,
            roles[record.label],
            output,
            rms[b],
            averages[b],
            float(factors[b] * spread[b]),
            spectra[b],
            rounding_in_average(record, output),
            factors[b],
            feigned=_feigned(record, averages[b], factors[b] * of_samples[b], policy),
        )
        for b, output in enumerate(predictor.outputs)
    ]
    return entries, columns * np.array(factors)[:, None, None]


def _feigned(
    record: Record,
    average: PeriodicAverage | LocalAverage,
    by_input: float,
    policy: SearchPolicy,
) -> float:
    """Mean square that noise alone gives the samples of a transient beyond its own, at most."""
    if not isinstance(average, LocalAverage):
        return np.inf
    scatter = average.sigma**2 * np.sqrt(2.0 / counted(record) + 2.0 / average.free)
    chance = float(distributions.norm.isf(policy.floor_false_alarm))
    return float(chance * scatter + by_input**2)


def _factor(scale: float, spread: float, known: RecordNoise | None, left: float) -> float:
    """Factor for the input's noise, limited to the noise that was found with earlier models which
    explain as much."""
    if known is None or spread == 0 or not known.limits(left):
        return scale
    return min(scale, known.input_noise / spread)


def _spectrum(
    record: Record, output: str, residual: Array, average: PeriodicAverage | LocalAverage
) -> NoiseSpectrum | None:
    if not record.periodic or not np.isfinite(residual).all():
        return None
    # Bridged samples do not scatter, which the factor compensates.
    part = counted(record) / record.time.size
    emptied = emptied_lines(record, output)
    return noise_spectrum((residual - average.values) / part, record.periods, emptied)


def _average(
    record: Record,
    output: str,
    residual: Array,
    before: RecordNoise | None,
    policy: SearchPolicy,
) -> PeriodicAverage | LocalAverage:
    if not record.periodic:
        noise = sample_noise(record, output, residual, before, policy=policy)
        return local_average(residual, noise, record.kept)
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    return of_those_counted(record, periodic_average(residual, step, record.frequency))


def least_noise(one: Noise, other: Noise) -> dict[tuple[str, str], RecordNoise]:
    """The smaller of two measurements of the noise, by run and output.

    A residual is not smaller than the noise in it, whatever the model, so that the smallest
    measurement is the best; the inputs' noise is that of the model which leaves least. A run
    without a solution has no measurement.
    """
    found = {key: noise for key, noise in one.items() if _is_known(noise)}
    for key, noise in other.items():
        if not _is_known(noise):
            continue
        known = found.get(key, noise)
        limits = [n.input_noise for n in (known, noise) if n.limits(min(known.left, noise.left))]
        found[key] = RecordNoise(
            min(known.sigma, noise.sigma), min(limits), min(known.left, noise.left)
        )
    return found


def _is_known(noise: RecordNoise) -> bool:
    return bool(np.isfinite([noise.sigma, noise.input_noise, noise.left]).all())


def with_same_noise(table: ErrorTable, noise: Noise) -> ErrorTable:
    """The errors relative to a noise that was found with another model."""
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
    limited = noise.limits(entry.rms) and noise.input_noise < entry.input_noise
    if factor == 1.0 and not limited:
        return entry
    from_input = noise.input_noise if limited else entry.input_noise
    scale = entry.input_scale * from_input / entry.input_noise if from_input else 0.0
    quiet = replace(entry, average=average, input_noise=from_input, input_scale=scale)
    if entry.expected_error is None:
        return quiet
    # The variance by the parameters' posterior is unchanged.
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
    """Upper limit by chance of the ratio to the expected error, at least ``floor_ratio``.

    Parameters
    ----------
    entries : sequence of RunError
        Errors over which the squared ratio is averaged.
    tests : int
        Number of ratios that are tested together.
    policy : SearchPolicy
    """
    level = policy.floor_false_alarm / tests
    return max(policy.floor_ratio, math.sqrt(_quantile(entries, level)))


def lowest(
    entries: Sequence[RunError], tests: int = 1, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Lower limit by chance of the ratio to the expected error.

    The unknowns' errors may be zero by chance, but noise is always present: the limit is that of
    the noise alone.

    Parameters
    ----------
    entries : sequence of RunError
        Errors over which the squared ratio is averaged.
    tests : int
        Number of ratios that are tested together.
    policy : SearchPolicy
    """
    own = float(np.mean([entry.own_share for entry in entries]))
    none = np.zeros((0, 0))
    noise = [replace(e, parameters=none, own_share=e.own_share / own) for e in entries]
    share, number, free = _variate(noise)
    level = policy.floor_false_alarm / tests
    square = 1.0 + share * (float(distributions.f.ppf(level, number, free)) - 1.0)
    return math.sqrt(own * max(square, 0.0))


def chance(entries: Sequence[RunError]) -> float:
    """Probability by chance of a squared ratio to the expected error that is as large.

    Parameters
    ----------
    entries : sequence of RunError
        Errors over which it is averaged; not a number where a run could not be solved.
    """
    square = float(np.mean([entry.ratio_to_expected**2 for entry in entries]))
    share, number, free = _variate(entries)
    return float(distributions.f.sf(1.0 + (square - 1.0) / share, number, free))


def _quantile(entries: Sequence[RunError], above: float) -> float:
    """Squared ratio that is exceeded with this probability."""
    share, number, free = _variate(entries)
    return 1.0 + share * (float(distributions.f.isf(above, number, free)) - 1.0)


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
        # Mixed terms of the noise and the unknowns' errors.
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
    """Whether the error of every output agrees with the expected one, pooled over each role and in
    each run. A run that could not be solved does not agree.
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
    """Sentences on outputs whose error is smaller than chance allows, pooled over a role.

    Such a residual shows that the noise was overestimated, not that the model is good.
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
