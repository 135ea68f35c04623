"""Coverage of intervals where an effect is missing, noise is coloured, or nothing is wrong.

Campaigns are linear: signatures, sensitivities and noise of real models of five kinds of system, at
their estimates, make thousands of campaigns whose truth is known at the cost of one. Parameters,
the missing effect, its size and the noise are drawn anew. Each campaign is analysed as a user's is:
the error model is the one that ``"auto"`` chooses, intervals are those that an estimate states.

An effect has one to ten times its detection limit beside the model's parameters. It is one of the
catalogue at one of the shapes that are scanned; effects by run are left out, and so are effects
larger than a third of the signal.

==================== ===============================================================================
key                  part of 90 % intervals that hold the truth, over all shared parameters
==================== ===============================================================================
coverage_inside      an effect of the catalogue is missing
coverage_outside     the same, left out of the catalogue with all that resemble it (cos^2 > 0.5
                     beside the parameters)
coverage_plain       nothing is missing
coverage_coloured    nothing is missing, AR(1) noise of coefficient 0, 0.5 or 0.9: the worst
coverage_prediction  samples of a held-out run within their predictive intervals, effect missing
==================== ===============================================================================

``coverage_inside_<word>`` and ``coverage_outside_<word>`` are the first two by an error model of a
user's choice, or BayesBag, on the same campaigns; ``width_inside_<word>`` the widths.

``width_plain`` is the mean width over that under independent errors where nothing is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from truth_effects import LIMIT, NUMERICS
from truth_systems import Noise, Plan, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.data._noise import periodic_average
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._inference import LOOKED_FOR, error_model_by
from bayesoleo.discovery._run_predictions import predict_held_out
from bayesoleo.discovery._signatures import (
    Lines,
    colour_of,
    harmonic_powers,
    lines_of,
    noise_of,
    signatures_of,
    slow_lines_p,
)
from bayesoleo.error_models import CatalogueErrors, Frame, Signatures
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._catalogue_evidence import Linearised
from bayesoleo.error_models._correlated import effective_samples
from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model import Normal
from bayesoleo.posterior import LogDensity, bayesbag
from bayesoleo.posterior._laplace import Mode, find_mode, start_coordinates
from bayesoleo.solvers._orbit import Status

Array = NDArray[np.float64]

#: Kinds of system, see :mod:`truth_systems`, and runs of a campaign.
KINDS = ("linear", "two dofs", "thermal", "force law", "oleo")
PLAN = Plan(fitted=3, held_out=1, periods=5, per_period=48.3)
RELATIVE_NOISE = 0.005
#: Sizes of an effect in detection limits, and the largest part of the signal.
SMALLEST, LARGEST, PART = 1.0, 10.0, 1 / 3
#: Half a 90 % interval in standard deviations.
HALF = 1.6448536269514722
#: AR(1) coefficients.
COLOURS = (0.0, 0.5, 0.9)
#: Draws of a predictive interval.
DRAWS = 300


@dataclass(frozen=True)
class Linear:
    """One system at its estimate.

    Parameters
    ----------
    names : tuple of str
        Unknowns.
    shared : ndarray of bool, shape (l,)
        Which are common to all runs.
    outputs, runs : tuple of str
    samples : tuple of RunSamples
    sensitivity : tuple of ndarray, each shape (s, l, n)
        By fitted run, for unknowns in units of their priors' deviations.
    signatures : Signatures
        White noise assumed.
    held_out : RunSamples
    held_label : str
    held_sensitivity : ndarray, shape (s, l, n)
    noise : ndarray, shape (s,)
        Standard deviation of a sample.
    signal : float
        Largest standard deviation of an output over its noise.
    """

    names: tuple[str, ...]
    shared: NDArray[np.bool_]
    outputs: tuple[str, ...]
    runs: tuple[str, ...]
    samples: tuple[RunSamples, ...]
    sensitivity: tuple[Array, ...]
    signatures: Signatures
    held_out: RunSamples
    held_label: str
    held_sensitivity: Array
    noise: Array
    signal: float


@cache
def system(kind: str, seed: int) -> Linear:
    """Simulate, fit and linearise."""
    made = make(kind, seed, plan=PLAN, noise=Noise(relative=RELATIVE_NOISE))
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    fit = fit_model(task.assembly.model(), task.roles.fitted, NUMERICS, check_mesh=False)
    noise = replace(noise_of(fit), colour=((0.0, 1.0),) * len(fit.predictor.outputs))
    (held,) = predict_held_out(fit, task.roles.held_out[:1])
    signatures = signatures_of(fit, task.assembly, noise, held_out=[held], jobs=1)
    scale = np.array([prior.sd for prior in fit.problem.priors])
    names = fit.predictor.layout.names
    free = [names.index(name) for name in fit.problem.names]
    columns = [p.sensitivity[:, free] * scale[:, None] for p in fit.predictions]
    solved = held.predictor.evaluate(held.vector)[0]
    theirs = held.predictor.layout.names
    other = np.zeros((len(noise.sigma), len(free), held.record.time.size))
    for k, name in enumerate(fit.problem.names):
        if name in theirs:
            other[:, k] = solved.sensitivity[:, theirs.index(name)] * scale[k]
    when = RunSamples(
        held.record.time, held.record.frequency, signatures.origins[held.record.label]
    )
    return Linear(
        tuple(fit.problem.names),
        np.array(["[" not in name for name in fit.problem.names]),
        tuple(fit.problem.outputs),
        tuple(fit.problem.runs),
        tuple(fit.problem.samples),
        tuple(columns),
        signatures,
        when,
        held.record.label,
        other,
        noise.sigma,
        signatures.largest,
    )


class Campaign:
    """Linear estimation problem ``y = J z + e`` with a standard normal prior of ``z``."""

    def __init__(self, base: Linear, y: Sequence[Array], signatures: Signatures | None) -> None:
        self.base, self.y, self.signatures = base, tuple(y), signatures
        self.names, self.outputs, self.runs = base.names, base.outputs, base.runs
        self.priors = tuple(Normal(0.0, 1.0) for _ in self.names)
        self.start = np.zeros(len(self.names))
        self.samples = base.samples
        self.effective: Array | None = None
        self.counts = np.array([[one.shape[1]] * len(self.outputs) for one in self.y])

    def residuals(self, theta: Array, run: int) -> tuple[Array, NDArray[np.int64]]:
        """Residuals (L, s, n) and statuses."""
        found = self.y[run] - np.einsum("Ll,sln->Lsn", theta, self.base.sensitivity[run])
        return found, np.zeros(len(theta), dtype=np.int64)

    def evaluate(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities."""
        left = [self.residuals(theta[None], r)[0][0] for r in range(len(self.runs))]
        outputs = range(len(self.outputs))
        return Evaluation(
            residual=tuple(np.concatenate([e[b] for e in left]) for b in outputs),
            sensitivity=tuple(
                np.concatenate([j[b].T for j in self.base.sensitivity]) for b in outputs
            ),
            status=Status.CONVERGED,
        )

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares."""
        sums = [np.sum(self.residuals(theta, r)[0] ** 2, axis=2) for r in range(len(self.runs))]
        return Misfit(np.stack(sums, axis=1), np.zeros(len(theta), dtype=np.int64))


# -- what is drawn ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawn:
    """A campaign with its truth.

    Parameters
    ----------
    campaign : Campaign
        Without signatures.
    truth : ndarray, shape (l,)
    held : ndarray, shape (s, n)
        What the held-out run measured.
    column : int or None
        Which signature is missing.
    """

    campaign: Campaign
    truth: Array
    held: Array
    column: int | None = None


def beside(base: Linear) -> tuple[Array, Array]:
    """Signatures over all fitted samples, in units of the noise, and beside the parameters."""
    unit = base.noise[:, None, None]

    def over_runs(parts: Sequence[Array]) -> Array:
        rows = [(part / unit).swapaxes(0, 1) for part in parts]
        return np.concatenate([row.reshape(len(row), -1) for row in rows], axis=1)

    columns = over_runs(base.signatures.columns)
    basis = np.linalg.qr(over_runs(base.sensitivity).T)[0]
    return columns, columns - (columns @ basis) @ basis.T


def drawn(
    kind: str, seed: int, rng: np.random.Generator, *, effect: bool, colour: float = 0.0
) -> Drawn:
    """One campaign of a system."""
    base = system(kind, seed)
    truth = rng.standard_normal(len(base.names))
    sizes = [j.shape[2] for j in base.sensitivity]
    y = [np.einsum("l,sln->sn", truth, j) for j in base.sensitivity]
    held = np.einsum("l,sln->sn", truth, base.held_sensitivity)
    y = [
        one + base.noise[:, None] * _noise(rng, (len(one), n), colour)
        for one, n in zip(y, sizes, strict=True)
    ]
    held = held + base.noise[:, None] * _noise(rng, held.shape, colour)
    column = None
    if effect:
        column, amplitude = _missing(base, rng)
        y = [e + amplitude * c[:, column] for e, c in zip(y, base.signatures.columns, strict=True)]
        when = base.held_out
        position = when.frequency * (when.time - when.time[0])
        held = held + amplitude * base.signatures.at(base.held_label, position, True)[:, column]
    return Drawn(Campaign(base, y, None), truth, held, column)


def _missing(base: Linear, rng: np.random.Generator) -> tuple[int, float]:
    """An effect and its amplitude."""
    columns, left = _columns_of(id(base), base)
    size, rest = np.linalg.norm(columns, axis=1), np.linalg.norm(left, axis=1)
    members = {}
    for k, name in enumerate(base.signatures.names):
        limit = PART * base.signal * np.sqrt(columns.shape[1])
        if "[" not in name and LIMIT * SMALLEST * size[k] < limit * rest[k]:
            members.setdefault(name, []).append(k)
    chosen = list(members)[rng.integers(len(members))]
    k = int(rng.choice(members[chosen]))
    most = min(LARGEST, PART * base.signal * np.sqrt(columns.shape[1]) * rest[k] / size[k] / LIMIT)
    limits = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(most))))
    return k, float(rng.choice((-1.0, 1.0))) * limits * LIMIT / rest[k]


_KEPT: dict[int, tuple[Array, Array]] = {}


def _columns_of(key: int, base: Linear) -> tuple[Array, Array]:
    if key not in _KEPT:
        _KEPT[key] = beside(base)
    return _KEPT[key]


def _noise(rng: np.random.Generator, shape: tuple[int, ...], colour: float) -> Array:
    """AR(1) noise of unit variance along the last axis."""
    settle = 100
    white = rng.standard_normal((*shape[:-1], shape[-1] + settle))
    found = signal.lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], white, axis=-1)
    return np.asarray(found[..., settle:])


# -- what is made of it ----------------------------------------------------------------------------


def without(base: Linear, column: int) -> Signatures:
    """Signatures without one and those that resemble it beside the parameters."""
    _, left = _columns_of(id(base), base)
    norm = np.linalg.norm(left, axis=1)
    cos = (left @ left[column]) / np.maximum(norm * norm[column], 1e-300)
    return base.signatures.keeping(cos**2 <= 0.5)


def measured_colour(
    campaign: Campaign, left: Sequence[Array]
) -> tuple[tuple[tuple[float, float], ...], Array]:
    """Colour of the noise of a campaign by what of its residuals does not repeat."""
    colours, chances = [], []
    for b in range(len(campaign.outputs)):
        lines: list[Lines] = []
        for e, when in zip(left, campaign.samples, strict=True):
            step = float((when.time[-1] - when.time[0]) / (when.time.size - 1))
            average = periodic_average(e[b], step, when.frequency)
            lines.append(lines_of(e[b] - average.values, average, step, when.frequency))
        colour, p_value = colour_of(lines)
        colours.append(colour)
        chances.append(p_value)
    return tuple(colours), np.array(chances)


@dataclass(frozen=True)
class Analysed:
    """What an estimate states: centre and covariance in coordinates, under an error model."""

    density: LogDensity
    centre: Array
    covariance: Array
    word: str


def analysed(found: Drawn, signatures: Signatures | None) -> Analysed:
    """The estimate under the error model that ``"auto"`` chooses."""
    campaign = found.campaign
    plain = LogDensity(campaign)
    first = find_mode(plain, start_coordinates(plain, np.zeros(len(campaign.names))))
    theta = plain.natural(first.centre[None])[0, : len(campaign.names)]
    left = [campaign.residuals(theta[None], r)[0][0] for r in range(len(campaign.runs))]
    colours, chances = measured_colour(campaign, left)
    white = tuple((0.0, 1.0) for _ in colours)
    looked_for = _slow_lines(campaign, left, chances.min() < 1e-3)
    given = signatures or campaign.base.signatures
    kept: list[Linearised] = []

    def log_odds(coloured: bool) -> float:
        if looked_for > LOOKED_FOR:
            return -np.inf
        kept.append(
            _linearised(
                campaign, replace(given, colour=colours if coloured else white), theta, left
            )
        )
        return kept[0].log_odds

    word, _ = error_model_by(chances, log_odds, campaign.outputs)
    if word == "independent":
        return Analysed(plain, first.centre, first.covariance, word)
    if word == "catalogue":
        campaign.signatures = replace(given, colour=colours if chances.min() < 1e-3 else white)
        density = LogDensity(campaign, errors=word)
        phi = start_coordinates(density, theta + kept[0].shift)
        size, covariance = len(theta), np.zeros((len(phi), len(phi)))
        covariance[:size, :size] = kept[0].covariance
        return Analysed(density, phi, covariance, word)
    density = LogDensity(campaign, errors=word)
    mode = find_mode(density, start_coordinates(density, theta))
    return Analysed(density, mode.centre, mode.covariance, word)


def _slow_lines(campaign: Campaign, left: Sequence[Array], coloured: bool) -> float:
    """Probability of the residuals by noise alone, as a user's estimate looks at it first."""
    lines = []
    for b in range(len(campaign.outputs)):
        lines.append([])
        for e, when in zip(left, campaign.samples, strict=True):
            step = float((when.time[-1] - when.time[0]) / (when.time.size - 1))
            found = harmonic_powers(e[b], step, when.frequency, PLAN.periods, coloured=coloured)
            lines[b].append(found)
    return slow_lines_p(lines)


def _linearised(
    campaign: Campaign, given: Signatures, theta: Array, left: Sequence[Array]
) -> Linearised:
    campaign.signatures = given
    errors = CatalogueErrors(Frame.of(campaign))
    campaign.signatures = None
    sensitivity = [list(j) for j in campaign.base.sensitivity]
    return errors.linearised(sensitivity, [list(e) for e in left], np.eye(len(theta)), -theta)


#: Ways to intervals that are shown side by side.
WORDS = ("independent", "discrepancy", "catalogue", "power", "bayesbag")


def by_word(found: Drawn, word: str, signatures: Signatures | None) -> Analysed:
    """The estimate under an error model of a user's choice, or by BayesBag over runs."""
    campaign = found.campaign
    plain = LogDensity(campaign)
    first = find_mode(plain, start_coordinates(plain, np.zeros(len(campaign.names))))
    size = len(campaign.names)
    theta = plain.natural(first.centre[None])[0, :size]
    left = [campaign.residuals(theta[None], r)[0][0] for r in range(len(campaign.runs))]
    if word == "independent":
        return Analysed(plain, first.centre, first.covariance, word)
    covariance = np.zeros((len(first.centre), len(first.centre)))
    if word == "bayesbag":
        bag = bayesbag(campaign, theta)
        covariance[:size, :size] = bag.covariance
        return Analysed(plain, np.concatenate([bag.mean, first.centre[size:]]), covariance, word)
    if word == "catalogue":
        white = tuple((0.0, 1.0) for _ in campaign.outputs)
        given = replace(signatures or campaign.base.signatures, colour=white)
        kept = _linearised(campaign, given, theta, left)
        covariance[:size, :size] = kept.covariance
        centre = np.concatenate([theta + kept.shift, first.centre[size:]])
        return Analysed(plain, centre, covariance, word)
    campaign.effective = effective_samples(left, campaign.samples)
    density = LogDensity(campaign, errors=word)
    mode = find_mode(density, start_coordinates(density, theta))
    return Analysed(density, mode.centre, mode.covariance, word)


def side_by_side(
    count: int,
    seed: int,
    words: Sequence[str] = WORDS,
    kinds: Sequence[str] = KINDS,
    seeds: Sequence[int] = (1, 2),
) -> dict[str, float]:
    """Coverage and median half width, in prior deviations, of each word on the same campaigns.

    Keys are ``coverage_inside_<word>``, ``coverage_outside_<word>`` and ``width_inside_<word>``.
    Only the catalogue's differ between inside and outside: no other word knows signatures.
    """
    inside: dict[str, list[float]] = {}
    for number in range(count):
        kind = kinds[number % len(kinds)]
        rng = np.random.default_rng([seed, number, 0])
        found = drawn(kind, seeds[number // len(kinds) % len(seeds)], rng, effect=True)
        assert found.column is not None
        for word in words:
            for where in ("inside", "outside"):
                known = None if where == "inside" else without(found.campaign.base, found.column)
                if where == "inside" or word == "catalogue":
                    hits, half = covered(found, by_word(found, word, known))
                inside.setdefault(f"coverage_{where}_{word}", []).extend(hits.astype(float))
                if where == "inside":
                    inside.setdefault(f"width_inside_{word}", []).append(float(np.median(half)))
    return {key: float(np.mean(values)) for key, values in inside.items()}


def covered(found: Drawn, mode: Analysed | Mode) -> tuple[Array, Array]:
    """Whether each shared parameter lies in its 90 % interval, and the intervals' half widths."""
    size = len(found.truth)
    shared = found.campaign.base.shared
    sd = np.sqrt(np.diag(mode.covariance))[:size]
    return (np.abs(mode.centre[:size] - found.truth) <= HALF * sd)[shared], (HALF * sd)[shared]


def predicted(found: Drawn, mode: Analysed, rng: np.random.Generator) -> float:
    """Part of a held-out run's samples within their 90 % predictive intervals."""
    base = found.campaign.base
    size, density = len(found.truth), mode.density
    phi = rng.multivariate_normal(mode.centre, mode.covariance, DRAWS, method="svd")
    natural = density.natural(phi)
    theta, eta = natural[:, :size], density.split(phi)[1]
    left = [found.campaign.residuals(theta, r)[0] for r in range(len(base.runs))]
    common = density.errors.common(left, eta, rng)
    errors = density.errors.draw(natural[:, size:], base.held_label, base.held_out, rng, common)
    y = np.einsum("Wl,sln->Wsn", theta, base.held_sensitivity) + errors
    low, high = np.quantile(y, [0.05, 0.95], axis=0)
    return float(np.mean((low <= found.held) & (found.held <= high)))


# -- keys ------------------------------------------------------------------------------------------


@dataclass
class Tally:
    """Counts of one question."""

    inside: list[float]
    width: list[float]
    words: dict[str, int]

    @property
    def part(self) -> float:
        """Part of the intervals that hold the truth."""
        return float(np.mean(self.inside))


def coverage(
    count: int,
    seed: int,
    *,
    effect: bool,
    outside: bool = False,
    colour: float = 0.0,
    prediction: bool = False,
    kinds: Sequence[str] = KINDS,
    seeds: Sequence[int] = (1, 2),
) -> Tally:
    """Coverage over campaigns of all kinds, in equal numbers."""
    tally = Tally([], [], {})
    for number in range(count):
        kind = kinds[number % len(kinds)]
        rng = np.random.default_rng([seed, number, int(10 * colour)])
        found = drawn(
            kind, seeds[number // len(kinds) % len(seeds)], rng, effect=effect, colour=colour
        )
        base = found.campaign.base
        signatures = without(base, found.column) if outside and found.column is not None else None
        mode = analysed(found, signatures)
        tally.words[mode.word] = tally.words.get(mode.word, 0) + 1
        if prediction:
            tally.inside.append(predicted(found, mode, rng))
            continue
        inside, half = covered(found, mode)
        tally.inside += list(inside.astype(float))
        plain = LogDensity(found.campaign)
        other = find_mode(plain, start_coordinates(plain, np.zeros(len(base.names))))
        tally.width += list(half / covered(found, other)[1])
    return tally


def inside(count: int, seed: int) -> dict[str, float]:
    """Of campaigns that lack an effect of the catalogue."""
    return {"coverage_inside": coverage(count, seed, effect=True).part}


def outside(count: int, seed: int) -> dict[str, float]:
    """The same without the effect and its near neighbours."""
    return {"coverage_outside": coverage(count, seed, effect=True, outside=True).part}


def plain(count: int, seed: int) -> dict[str, float]:
    """Of campaigns that lack nothing."""
    found = coverage(count, seed, effect=False)
    return {"coverage_plain": found.part, "width_plain": float(np.mean(found.width))}


def coloured(count: int, seed: int) -> dict[str, float]:
    """The worst of three colours of noise."""
    parts = [coverage(count // 3, seed, effect=False, colour=c).part for c in COLOURS]
    return {"coverage_coloured": max(parts, key=lambda part: abs(part - 0.9))}


def prediction(count: int, seed: int) -> dict[str, float]:
    """Of a held-out run's samples."""
    found = coverage(count // 2, seed, effect=True, prediction=True)
    return {"coverage_prediction": found.part}
