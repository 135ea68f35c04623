"""Signatures of all effects that a fitted model might lack, and the colour of its noise.

Both are made at the estimate, for the error model that takes the catalogue as discrepancy. Effects
are those that a search would score, at the same shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy.fft
from scipy import optimize
from scipy.special import expit

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array, Flags
from bayesoleo._worker_processes import process_map
from bayesoleo.data._noise import HARMONICS, PeriodicAverage, noise_spectrum, periodic_average
from bayesoleo.discovery._assembly import Assembly, Option
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._ranking import scales_of
from bayesoleo.discovery._run_predictions import Prediction, sample_noise
from bayesoleo.discovery._samples_that_count import without_masked
from bayesoleo.discovery._scanned_columns import Columns, Scanned
from bayesoleo.discovery._score_basis import LEAST
from bayesoleo.discovery._score_tests import columns_of, cost_of
from bayesoleo.discovery._signature_products import Column, UnitProducts
from bayesoleo.effects._effect import Effect
from bayesoleo.error_models._catalogue_evidence import CatalogueEvidence
from bayesoleo.error_models._signatures import Rows, Signatures, alike, curves_of, equal_shares
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status

#: Probability that white noise is taken for coloured, over all outputs.
COLOUR_FALSE_ALARM = 1e-3
#: Numbers of lines whose power is compared with that of noise.
LEADING = (1, 2, 3, 5, 8, 13, 21, 34, 100, 10**9)
#: Least part of a signature beside the model's parameters by which it is normalised: an effect that
#: they imitate more closely is believed to be at most a hundred times its remainder.
LEAST_BESIDE = 0.01
#: Squared cosine above which two signatures count as one where an effect acts alone.
ALIKE = 0.9
#: Largest correlated share: some white noise remains, so that the filter stays regular.
MOST_SHARE = 0.999


@dataclass(frozen=True)
class Noise:
    """Noise of the outputs, measured between periods.

    Parameters
    ----------
    sigma : ndarray, shape (s,)
        Standard deviation of a sample, SI.
    colour : tuple of (float, float), length s
        Correlated share and correlation time in s; a share of zero where noise is white.
    p_value : tuple of float, length s
        Probability of a spectrum that differs as much from a flat one by chance; one where the
        spectrum is not known.
    """

    sigma: Array
    colour: tuple[tuple[float, float], ...]
    p_value: tuple[float, ...]

    @property
    def coloured(self) -> bool:
        """Whether the spectrum of an output is not flat."""
        return any(share > 0 for share, _ in self.colour)


# -- noise -----------------------------------------------------------------------------------------


def noise_of(fit: ModelFit) -> Noise:
    """Size and colour of the noise of each output, pooled over the fitted runs.

    A periodic run shows its noise in what does not repeat. That of a transient is measured by
    differences of neighbours and taken as white.
    """
    sigma, colour, chances = [], [], []
    for b, output in enumerate(fit.predictor.outputs):
        parts = [_rest(fit, r, b, output) for r in range(len(fit.records))]
        weight = np.array([part.free for part in parts])
        sigma.append(float(np.sqrt(weight @ [part.sigma**2 for part in parts] / weight.sum())))
        lines = [part for part in parts if part.power.size]
        found, p_value = colour_of(lines) if lines else ((0.0, 1.0), 1.0)
        kept = p_value < COLOUR_FALSE_ALARM / len(fit.predictor.outputs)
        colour.append(found if kept else (0.0, 1.0))
        chances.append(p_value)
    return Noise(np.array(sigma), tuple(colour), tuple(chances))


@dataclass(frozen=True)
class Lines:
    """Periodogram of the noise of a run between the harmonics.

    Parameters
    ----------
    power : ndarray, shape (q,)
        By line, in squared units of the output.
    angle : ndarray, shape (q,)
        Frequency in radians per sample.
    step : float
        Sampling interval, s.
    sigma, free : float
        Standard deviation of a sample, and degrees of freedom.
    """

    power: Array
    angle: Array
    step: float
    sigma: float
    free: float


def _rest(fit: ModelFit, r: int, b: int, output: str) -> Lines:
    """Noise of one output in one run."""
    record = fit.records[r]
    residual = without_masked(record, fit.predictor.runs[r].measured[b] - fit.predictions[r].y[b])
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    none = np.zeros(0)
    if not record.periodic:
        sigma = sample_noise(record, output, residual, policy=fit.policy)
        return Lines(none, none, step, max(sigma, 1e-300), float(residual.size))
    average = periodic_average(residual, step, record.frequency)
    return lines_of(residual - average.values, average, step, record.frequency)


def lines_of(rest: Array, average: PeriodicAverage, step: float, frequency: float) -> Lines:
    """Lines between the harmonics of what does not repeat, (n,), beside an average over periods."""
    size = rest.size
    # A repeating signal has lines at multiples of the frequency only; neighbours hold its leakage.
    cycle = np.arange(1, size // 2) / (size * step * frequency)
    between = np.abs(cycle - np.round(cycle)) > 0.75 / (size * step * frequency)
    power = np.abs(np.fft.rfft(rest)[1 : size // 2]) ** 2 / size
    angle = 2 * np.pi * np.arange(1, size // 2) / size
    free = float(average.samples - average.number)
    return Lines(power[between], angle[between], step, max(average.sigma, 1e-300), free)


def colour_of(lines: Sequence[Lines]) -> tuple[tuple[float, float], float]:
    """Correlated share and correlation time of noise, and the probability by chance.

    The Whittle likelihood of white noise and an Ornstein-Uhlenbeck process is compared with that of
    white noise alone.

    Parameters
    ----------
    lines : sequence of Lines
        By run.

    Returns
    -------
    (share, time) : tuple of float
        Time in s.
    p_value : float
        By a chi-square distribution with two degrees of freedom, which is conservative.

    References
    ----------
    Whittle (1953), Arkiv för Matematik 2, 423-434.
    """
    step = float(np.median([one.step for one in lines]))
    cosines = [np.cos(one.angle) for one in lines]

    def cost(x: Array) -> tuple[float, Array]:
        """Of log odds of the share over its limit, and the log time in steps; with its gradient."""
        part, total, slope = float(expit(x[0])), 0.0, np.zeros(2)
        for one, cosine in zip(lines, cosines, strict=True):
            steps = one.step / (step * float(np.exp(x[1])))
            density, by_share, by_steps = spectrum_of_process(cosine, MOST_SHARE * part, steps)
            ratio = one.power / density  # each run's own variance is its mean
            total += float(np.sum(np.log(density)) + ratio.size * (np.log(ratio.mean()) + 1))
            weight = (1 - ratio / ratio.mean()) / density
            slope += weight @ by_share * MOST_SHARE * part * (1 - part), weight @ by_steps * -steps
        return total, slope

    white, _ = cost(np.array([-40.0, 0.0]))
    starts = [np.array([s, np.log(t)]) for s in (-1.0, 3.0) for t in (1.0, 10.0, 60.0)]
    bounds = [(-8.0, 12.0), (np.log(0.2), np.log(1e4))]
    found = [optimize.minimize(cost, x, jac=True, method="L-BFGS-B", bounds=bounds) for x in starts]
    best = min(found, key=lambda one: float(one.fun))
    p_value = float(distributions.chi2.sf(2 * max(white - float(best.fun), 0.0), 2))
    share = MOST_SHARE * float(expit(best.x[0]))
    return (share, step * float(np.exp(best.x[1]))), p_value


def spectrum_of_process(cosine: Array, share: float, steps: float) -> tuple[Array, Array, Array]:
    """Spectrum of unit-variance noise of which a share decays by ``exp(-steps)`` per sample, and
    its derivatives by share and steps, at angles per sample with such cosines."""
    a = np.exp(-steps)
    below, above = 1 - 2 * a * cosine + a * a, -np.expm1(-2 * steps)
    process = above / below
    by_steps = share * 2 * a * (a - process * (cosine - a)) / below
    return np.asarray((1 - share) + share * process), process - 1, by_steps


def more_than_noise_p(fit: ModelFit, noise: Noise) -> float:
    """Probability that noise alone repeats as the residual does, by its slowest lines.

    Sums of squares of ever more lines are compared with what the noise lets expect: harmonics of
    periodic runs, pairs of lines of a cosine transform of transients. The least probability counts:
    noise alone is below one tenth in about one campaign of four.

    Parameters
    ----------
    fit : ModelFit
    noise : Noise
        Of the outputs.
    """
    lines: list[list[tuple[Array, float]]] = []
    for b in range(len(fit.predictor.outputs)):
        lines.append([])
        for r, record in enumerate(fit.records):
            left = fit.predictor.runs[r].measured[b] - fit.predictions[r].y[b]
            lines[b].append(_line_powers(record, without_masked(record, left), noise, b))
    return slow_lines_p(lines)


def slow_lines_p(lines: Sequence[Sequence[tuple[Array, float]]]) -> float:
    """The least probability by noise alone of any sum over the slowest lines.

    Parameters
    ----------
    lines : sequence over outputs of sequence over runs of (ndarray, float)
        Power by line in units of the noise, each of two real coefficients, and degrees of freedom
        with which the noise is known.
    """
    chances = [1.0]
    for runs in lines:
        free = sum(own for _, own in runs)
        for count in LEADING:
            some = np.concatenate([power[:count] for power, _ in runs])
            chances.append(float(distributions.f.sf(some.mean(), 2 * some.size, free)))
    return min(chances)


def _line_powers(record: Record, left: Array, noise: Noise, b: int) -> tuple[Array, float]:
    """Power of what is left of an output by line, and degrees of freedom of its noise."""
    if not record.periodic:
        power = scipy.fft.dct(left, norm="ortho")[: 2 * (left.size // 2)] ** 2
        return np.asarray(power.reshape(-1, 2).mean(axis=1) / noise.sigma[b] ** 2), float(left.size)
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    coloured = noise.colour[b][0] > 0
    return harmonic_powers(left, step, record.frequency, record.periods, coloured=coloured)


def harmonic_powers(
    left: Array, step: float, frequency: float, periods: int, *, coloured: bool
) -> tuple[Array, float]:
    """Power of what repeats of a signal (N,) by harmonic in units of its noise, which is that of
    all lines or, where coloured, of the lines next to a harmonic; and its degrees of freedom."""
    average = periodic_average(left, step, frequency)
    power = np.abs(average.coefficients[1:]) ** 2 * average.samples / 4
    if not coloured:
        return power / average.sigma**2, float(average.samples - average.number)
    level = noise_spectrum(left - average.values, periods).level
    order = np.arange(1, average.coefficients.size)
    near = level[np.minimum(order * periods, level.size - 1)]
    return power / np.maximum(near, 1e-300), 4.0 * HARMONICS * (periods - 1)


# -- signatures ------------------------------------------------------------------------------------


def signatures_of(
    fit: ModelFit,
    assembly: Assembly,
    noise: Noise,
    *,
    effects: Sequence[Effect] | None = None,
    held_out: Sequence[Prediction] = (),
    jobs: int | None = None,
) -> Signatures:
    """Signatures of every effect at every place where it applies, those of draws included.

    Parameters are those of :meth:`FittedSignatures.of`.
    """
    found = FittedSignatures.of(fit, assembly, noise, effects=effects, held_out=held_out, jobs=jobs)
    return found.with_curves(jobs)


@dataclass(frozen=True)
class FittedSignatures:
    """Signatures of all effects in the fitted runs, from which those of other runs follow.

    Parameters
    ----------
    fit : ModelFit
    others : tuple of ModelFit
        Runs that were not fitted, each by itself.
    options : sequence of Option
        The effects.
    groups : tuple of _Group
        Signatures that the model's parameters do not have.
    about : Signatures
        Without samples, and without the curves that draws need.
    products : UnitProducts
        Of the signatures.
    """

    fit: ModelFit
    others: tuple[ModelFit, ...]
    options: Sequence[Option]
    groups: tuple[_Group, ...]
    about: Signatures
    products: UnitProducts

    @classmethod
    def of(
        cls,
        fit: ModelFit,
        assembly: Assembly,
        noise: Noise,
        *,
        effects: Sequence[Effect] | None = None,
        held_out: Sequence[Prediction] = (),
        scanned: Scanned | None = None,
        jobs: int | None = None,
    ) -> FittedSignatures:
        """Of every effect at every place where it applies.

        Each signature is normalised over all fitted runs and outputs, in units of the noise: what
        it leaves beside the model's parameters has a root mean square of one. An effect that the
        parameters can largely imitate may therefore be larger than one that they cannot, as it is
        among effects that have not been noticed. The effects of a family share one variance. What
        the parameters do as well is left out.

        Parameters
        ----------
        fit : ModelFit
        assembly : Assembly
            What was fitted.
        noise : Noise
            Of the outputs.
        effects : sequence of Effect, optional
            By default the catalogue.
        held_out : sequence of Prediction
            Runs that were not fitted, for predictions.
        scanned : Scanned, optional
            What a score computed of the effects; it is taken where it is of the same fit.
        jobs : int, optional
            Processes.
        """
        labels = {record.label for record in fit.records}
        others = tuple(_as_fit(fit, one) for one in held_out if one.record.label not in labels)
        known = scanned.take(fit, assembly, effects) if scanned else None
        if known is None:
            scales = scales_of(fit, assembly.drive, assembly.native)
            options = assembly.options(scales, None if effects is None else tuple(effects))
            known = options, process_map(columns_of, fit, options, jobs, cost=partial(cost_of, fit))
        groups = list[_Group]()
        for place, (option, columns) in enumerate(zip(*known, strict=True)):
            groups += _groups(fit, others, place, option, columns)
        products = UnitProducts.of(fit, noise.sigma, _columns(groups))
        groups, kept = _sized(fit, groups, products)
        share = equal_shares([g.family for g in groups], [g.member for g in groups])
        groups = [replace(g, root=float(np.sqrt(w))) for g, w in zip(groups, share, strict=True)]
        scale = np.zeros(kept.size)
        scale[kept] = _scales(groups)
        products = products.keeping(kept, scale)
        about = _without_samples(fit, others, noise, groups, products)
        return cls(fit, others, known[0], tuple(groups), about, products)

    @cached_property
    def signatures(self) -> Signatures:
        """The signatures at all fitted samples, without curves: hundreds of megabytes."""
        columns, scales, tables = _columns(self.groups), _scales(self.groups), list[Array]()
        for r, record in enumerate(self.fit.records):
            shape = len(self.about.noise), len(columns), int(self.fit.problem.counts[r, 0])
            tables.append(np.zeros(shape))
            for k, values in enumerate(columns):
                if record.label in values:
                    np.multiply(values[record.label], scales[k], out=tables[r][:, k])
        return replace(self.about, columns=tuple(tables))

    def evidence(self, rows: Sequence[Sequence[Array]]) -> tuple[CatalogueEvidence, Sequence[Rows]]:
        """What the signatures do together, and rows ``(q, n)`` by run and output beside them; no
        table of all signatures is made."""
        columns, scales = _columns(self.groups), _scales(self.groups)
        return self.products.evidence(self.fit, self.about, columns, scales, rows)

    def with_curves(self, jobs: int | None = None) -> Signatures:
        """The signatures with the curves of all runs, those that were not fitted included."""
        curves = {
            record.label: curves_of(table, _position(self.fit, r, record), record.periodic)
            for r, (record, table) in enumerate(
                zip(self.fit.records, self.signatures.columns, strict=True)
            )
        }
        used = sorted({group.place for group in self.groups}) if self.others else []
        tasks = [(k, self.options[place]) for k in range(len(self.others)) for place in used]
        columns = iter(process_map(_columns_of_other, self.others, tasks, jobs))
        for one in self.others:
            known = {place: next(columns) for place in used}
            for r, record in enumerate(one.records):
                table = self._table(one, r, record, known)
                curves[record.label] = curves_of(table, _position(one, r, record), record.periodic)
        return replace(self.signatures, curves=curves)

    def _table(self, one: ModelFit, r: int, record: Record, known: Mapping[int, Columns]) -> Array:
        """Signatures of a run that was not fitted, shape (s, k, n); zero where there are none."""
        rows = [(group, name) for group in self.groups for name in group.columns]
        samples = int(one.problem.counts[r, 0])
        table = np.zeros((len(one.predictor.outputs), len(rows), samples))
        scale = _scales(self.groups)
        for k, (group, name) in enumerate(rows):
            columns = known[group.place]
            found = None if isinstance(columns, Status) else columns[group.shape].column(r, name)
            if found is not None:
                np.multiply(one.problem.kept(r, found), scale[k], out=table[:, k])
        return table


@dataclass(frozen=True)
class _Group:
    """Signatures of one parameter of one effect at one set of shapes; one a run if it has several.

    ``place`` and ``shape`` say of which option and set of its shapes. ``columns`` holds, by
    unknown, arrays (ny, N) by run label, which ``size`` divides and ``root`` of the share of the
    prior variance multiplies; of unknowns of runs that were not fitted it holds none.
    """

    family: str
    member: str
    place: int
    shape: int
    columns: Mapping[str, Column]
    size: float = 1.0
    root: float = 1.0


def _columns_of_other(others: Sequence[ModelFit], task: tuple[int, Option]) -> Columns:
    """Columns of an option in one of several runs that were not fitted."""
    number, option = task
    return columns_of(others[number], option)


def _groups(
    fit: ModelFit, others: Sequence[ModelFit], place: int, option: Option, columns: Columns
) -> list[_Group]:
    """Signatures of one candidate, in the outputs' units."""
    if isinstance(columns, Status):
        return []
    candidate, found = option.candidate, list[_Group]()
    member = f"{candidate.effect} at {candidate.target}"
    for k, block in enumerate(columns):
        groups: dict[str, dict[str, dict[str, Array]]] = {}
        for r, record in enumerate(fit.records):
            for name in block.names:
                column = groups.setdefault(name.split("[")[0], {}).setdefault(name, {})
                values = block.column(r, name)
                if values is not None:
                    column[record.label] = fit.problem.kept(r, values)
        for name, group in groups.items():
            if option.model.parameters[name].by_run:
                # A run that was not fitted has an unknown of its own, of which data say nothing.
                labels = [record.label for one in others for record in one.records]
                group.update({f"{name}[{label}]": {} for label in labels})
            found.append(_Group(candidate.family, f"{member}: {name}", place, k, group))
    return found


def _columns(groups: Sequence[_Group]) -> list[Column]:
    """The signatures one after the other, unscaled."""
    return [values for group in groups for values in group.columns.values()]


def _scales(groups: Sequence[_Group]) -> Array:
    """What multiplies each of them, shape (k,)."""
    return np.array([group.root / group.size for group in groups for _ in group.columns])


def _sized(
    fit: ModelFit, groups: Sequence[_Group], products: UnitProducts
) -> tuple[list[_Group], Flags]:
    """Groups at unit size beside the model's parameters, and which signatures are theirs, (k,);
    without those that are zero, or that the parameters do as well."""
    found, kept, first = list[_Group](), np.zeros(len(products.whole), dtype=np.bool_), 0
    samples, left = int(fit.problem.counts.sum()), np.diag(products.beside)
    for group in groups:
        own = slice(first, first + len(group.columns))
        first, whole, beside = own.stop, float(products.whole[own].sum()), float(left[own].sum())
        if np.isfinite(whole) and whole > 0 and beside > LEAST * whole:
            size = max(beside**0.5, LEAST_BESIDE * whole**0.5) / samples**0.5
            found.append(replace(group, size=size))
            kept[own] = True
    return found, kept


def _without_samples(
    fit: ModelFit,
    others: Sequence[ModelFit],
    noise: Noise,
    groups: Sequence[_Group],
    products: UnitProducts,
) -> Signatures:
    """All signatures in the order of their groups, without samples and curves."""
    shares = np.array([group.root**2 for group in groups for _ in group.columns])
    usable = np.flatnonzero([len(g.columns) == 1 for g in groups for _ in g.columns])
    length = np.sqrt(np.diag(products.beside)[usable])
    cosines = products.beside[np.ix_(usable, usable)] / np.outer(length, length)
    first, odds = alike(np.square(cosines), shares[usable], ALIKE)
    origins = {
        record.label: one.problem.samples[r].origin
        for one in (fit, *others)
        for r, record in enumerate(one.records)
    }
    swing = [
        np.concatenate([run.measured[b] for run in fit.predictor.runs]).std()
        for b in range(len(noise.sigma))
    ]
    return Signatures(
        tuple(f"{group.member} {name}" for group in groups for name in group.columns),
        tuple(fit.problem.runs),
        (),
        noise.sigma,
        noise.colour,
        {},
        shares,
        usable[first],
        odds,
        origins,
        float(np.max(np.array(swing) / noise.sigma)),  # no effect exceeds the signal
    )


def _position(fit: ModelFit, r: int, record: Record) -> Array:
    """Cycles since the first sample that counts, or parts of a transient's length."""
    samples = fit.problem.samples[r]
    since = samples.time - samples.time[0]
    return np.asarray(since * record.frequency if record.periodic else since / since[-1])


def _as_fit(fit: ModelFit, prediction: Prediction) -> ModelFit:
    """A run that was not fitted, at its prediction, as sensitivities need it."""
    problem = CampaignProblem(prediction.predictor)
    point = replace(fit.point, theta=prediction.vector)
    return replace(fit, problem=problem, point=point)
