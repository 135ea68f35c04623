r"""The catalogue of effects as model discrepancy.

.. math::

    e = \epsilon + \sum_k b_k c_k + g, \qquad b_k \sim N(0, a^2 w_k), \qquad
    \operatorname{cov}(e) = N + a^2 \sum_k w_k c_k c_k^T + v \gamma^2 (G_0 + G_r).

:math:`c_k` is the signature of effect ``k`` over all runs and outputs
(:class:`~bayesoleo.error_models.Signatures`). A model that lacks an effect errs along its
signature, by the same coefficient in all runs. So a parameter that an undeclared effect could
imitate is uncertain by as much as that effect may be large; a parameter that no effect resembles
stays well determined. A discrepancy without knowledge of physics has no such preference.

:math:`g` is a small smooth function of phase for what no effect describes: one that all runs share
and one of each run, of equal variance. It is a truncated Fourier series with the spectrum of
squared exponentials of a twentieth to a fifth of a cycle. :math:`\epsilon` is the noise, of the
colour that was measured. The sizes :math:`a` and :math:`\gamma` are in units of the noise of a
sample, flat in their logarithms, and sampled with the parameters.

Signatures and colour do not depend on the parameters. Residuals are whitened, projected on an
orthogonal basis of the smooth functions of each run and on the numerical range of all signatures;
a system of the size of that range remains (matrix inversion and determinant lemmas).

References
----------
Kennedy and O'Hagan (2001), "Bayesian calibration of computer models", *Journal of the Royal
Statistical Society* B 63, eq. 5. Brynjarsdóttir and O'Hagan (2014), "Learning about physical
parameters: the importance of model discrepancy", *Inverse Problems* 30, 114007: a discrepancy needs
a prior that knows physics. Rasmussen and Williams (2006), *Gaussian Processes for Machine
Learning*, eqs. A.9-A.10 (the lemmas).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import (
    ErrorModel,
    Frame,
    Quantity,
    RunSamples,
    log_mean_squares,
)
from bayesoleo.error_models._catalogue_evidence import (
    ALONE,
    LARGEST,
    LOG_HALF,
    CatalogueEvidence,
    Linearised,
    SignatureProducts,
    Smooth,
)
from bayesoleo.error_models._correlated import draw_process, whitened
from bayesoleo.error_models._fitting import climb
from bayesoleo.error_models._signatures import (
    Rows,
    Shared,
    Signatures,
    Sums,
    project_rows,
    smooth_basis,
)
from bayesoleo.model._priors import LogUniform

#: Least size of the catalogue's part and of the remainder, over the noise of a sample.
SMALLEST = 0.01
#: Rough standard deviation of a size's coordinate: half a decade.
_SIZE_SD = 0.3
# Sizes from which the most likely ones are searched.
_GUESSES = (-1.5, 0.0)
_LOG_2_PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class _LogQuantile:
    """Map of a value that is uniform in its logarithm to a coordinate of normal density."""

    low: float
    high: float

    def natural(self, u: Array) -> Array:
        """Value at a coordinate."""
        return np.asarray(self.low * (self.high / self.low) ** ndtr(u))

    def unbounded(self, value: Array) -> Array:
        """Coordinate of a value."""
        return np.asarray(ndtri(np.log(value / self.low) / np.log(self.high / self.low)))

    def log_jacobian(self, u: Array) -> Array:
        """Logarithm of the derivative of the value."""
        slope = np.log(self.natural(u) * np.log(self.high / self.low))
        return np.asarray(slope - 0.5 * u * u - 0.5 * _LOG_2_PI)


@dataclass(frozen=True)
class _Size(Quantity):
    """A size that is uniform in its logarithm."""

    @property
    def transform(self) -> _LogQuantile:  # type: ignore[override]
        """Map from the coordinate."""
        return _LogQuantile(self.low, self.high)


class CatalogueErrors(ErrorModel):
    """Noise, all effects that a model might lack, and a smooth remainder.

    Without signatures, as for a function of the user, only noise and remainder are left.
    ``log_variance_*`` is the variance of the noise alone.
    """

    word = "catalogue"
    over_runs = True
    data_points = "one run, given the runs before it"

    def __init__(self, frame: Frame) -> None:
        samples = frame.sampled()
        super().__init__(frame)
        found = frame.signatures or _none(frame)
        # Signatures of all samples take hundreds of megabytes: they are not copied to be scaled.
        self._signatures, pairs = found.without_columns(), list(enumerate(found.colour))
        self.frame = replace(frame, signatures=self._signatures)
        self._smooth = [[Smooth.of(run, colour) for _, colour in pairs] for run in samples]
        white = [
            [whitened(columns[b], run.time, *colour)[0] for b, colour in pairs]
            for run, columns in zip(samples, found.columns, strict=True)
        ]
        products = [
            [
                SignatureProducts.of(effects, part, unit)
                for effects, part, unit in zip(*row, found.noise, strict=True)
            ]
            for row in zip(white, self._smooth, strict=True)
        ]
        self.evidence = CatalogueEvidence.of(products, self._smooth, self._signatures)
        self._tables = [
            [self._table(r, b, white[r][b]) for b, _ in pairs] for r in range(len(samples))
        ]
        # Logarithms of the determinants of the whitening, its unit included.
        logs = np.array([[part.log_sd for part in row] for row in self._smooth])
        self._scales = logs + frame.counts * np.log(found.noise)

    def _table(self, r: int, b: int, signatures: Array) -> Array:
        """Basis of the smooth functions of one output in one run, then that of its whitened
        signatures (k, n), in units of the noise: shape (n, m + R)."""
        basis = self._smooth[r][b].basis
        table = np.empty((len(basis), basis.shape[1] + self.evidence.count))
        table[:, : basis.shape[1]] = basis
        unit = self.evidence.rotation / self._signatures.noise[b]
        np.matmul(signatures.T, unit, out=table[:, basis.shape[1] :])
        return table

    def _declare(self) -> tuple[Quantity, ...]:
        found = self.frame.signatures
        high = LARGEST if found is None else max(LARGEST, found.largest)
        remainder = _Size(
            schema.REMAINDER_SIZE,
            SMALLEST,
            high,
            LogUniform(SMALLEST, high),
            long_name="size of the smooth remainder over the noise of a sample",
        )
        if found is None or not found.names:
            return (*self.frame.log_variances(), remainder)
        text = "size of the effects that the model might lack over the noise of a sample"
        size = replace(remainder, name=schema.CATALOGUE_SIZE, long_name=text)
        return (*self.frame.log_variances(), remainder, size)

    # -- density -----------------------------------------------------------------------------

    def _sizes(self, eta: Array) -> tuple[Array, Array, Array]:
        """Noise over its frozen variance (L, s), and squared sizes of remainder and effects."""
        s = len(self.frame.outputs)
        natural = self.natural(np.atleast_2d(eta))
        rho = np.exp(natural[:, :s]) / self._signatures.noise**2
        effects = natural[:, s + 1] ** 2 if natural.shape[1] > s + 1 else np.zeros(len(natural))
        return rho, natural[:, s] ** 2, effects

    def _projected(self, residuals: Sequence[Array], first: int = 0) -> Sums:
        """Residuals (L, s, n) of runs on the bases, the first of them given."""
        lanes, count = len(residuals[0]), self.evidence.count
        runs, outputs, width = self.evidence.power.shape
        sums = Sums(
            np.empty((lanes, runs, outputs)),
            np.empty((lanes, runs, outputs, width)),
            np.empty((lanes, runs, outputs, count)),
        )
        for r, e in enumerate(residuals, first):
            for b in range(outputs):
                self._of_part(sums, r, b, np.ascontiguousarray(e[:, b]))
        return sums

    def _of_part(self, sums: Sums, r: int, b: int, rows: Array) -> None:
        table, shared = self._tables[r][b], self.evidence.shared[r, b]
        width, count = len(shared), self.evidence.count
        time, colour = self.frame.sampled()[r].time, self._signatures.colour[b]
        white = whitened(rows, time, *colour)[0] / self._signatures.noise[b]
        out, squares = np.empty((len(rows), table.shape[1])), np.empty(len(rows))
        project_rows(white, table, out, squares)
        along = out[:, :width]
        sums.along[:, r, b] = along
        sums.rest[:, r, b] = squares - _by_row(along * along)
        # One row at a time: a product of matrices may round differently with another number.
        for lane in range(len(rows)):
            sums.across[lane, r, b] = out[lane, width:] - along[lane] @ shared[:, :count]

    def _system(self, sums: Sums, eta: Array, runs: slice) -> tuple[Array, list[Shared]]:
        """Of some runs: own log-likelihoods (L, N), and what the coefficients in common know."""
        rho, remainder, effects = self._sizes(eta)
        known, counts = self.evidence, self.frame.counts[runs]
        count, shared, power = known.count, known.shared[runs], known.power[runs]
        size = shared.shape[-1]
        pivot = rho[:, None, :, None] * (1 + 0.5 * remainder[:, None, None, None] * power)
        own = counts * np.log(rho)[:, None] + np.log(pivot / rho[:, None, :, None]).sum(axis=3)
        own += sums.rest[:, runs] / rho[:, None] + (sums.along[:, runs] ** 2 / pivot).sum(axis=3)
        own += counts * _LOG_2_PI + 2 * self._scales[runs]
        flat, grams, found = shared.reshape(-1, size), known.grams[runs].sum(axis=0), []
        for lane in range(len(rho)):
            weight = 1 / pivot[lane].reshape(-1)
            # A product of a table with itself takes half the work.
            half = flat * np.sqrt(weight)[:, None]
            inner = half.T @ half
            inner[:count, :count] += np.tensordot(1 / rho[lane], grams, 1)
            right = (weight * sums.along[lane, runs].reshape(-1)) @ flat
            right[:count] += (sums.across[lane, runs] / rho[lane][:, None]).sum(axis=(0, 1))
            deviation = known.deviation(rho[lane], remainder[lane], effects[lane])
            found.append(Shared.of(inner, right[None], deviation))
        return -0.5 * own.sum(axis=2), found

    def _terms(self, shared: Shared) -> tuple[Array, Array, Array]:
        """Of one effect that acts alone: log weights (q, ALONE), score and information (q,)."""
        known = self.evidence
        information, scores = shared.along(known.alone)
        score = scores[0]
        more = known.alone_squares * information[:, None]
        gain = known.alone_squares * score[:, None] ** 2 / (1 + more)
        return known.log_odds[:, None] + 0.5 * (gain - np.log1p(more)), score, information

    def _log_likelihood(self, sums: Sums, eta: Array, runs: slice) -> tuple[Array, Array]:
        """Own log-likelihood of each run (L, N), and what sharing coefficients adds (L,)."""
        own, found = self._system(sums, eta, runs)
        more = np.empty(len(eta))
        for lane, shared in enumerate(found):
            more[lane] = 0.5 * float(shared.half[0] @ shared.half[0]) - shared.log_root
            if len(self.evidence.alone):
                terms = self._terms(shared)[0]
                more[lane] += _log_sum(terms)
        return own, more

    def of_run(self, run: int, residual: Array, eta: Array) -> Array:
        """Log-likelihood of one run, whatever the others measured."""
        sums = self._projected([residual], run)
        own, shared = self._log_likelihood(sums, eta, slice(run, run + 1))
        return np.asarray(own[:, 0] + shared)

    def of_runs(self, residuals: Sequence[Array], eta: Array) -> Array:
        """Log-likelihoods of runs, shape (L, N), whose sum is the joint one.

        What runs share is counted with the last run; :meth:`of_blocks` gives each run given those
        before it, at the cost of a factorisation for each.
        """
        own, shared = self._log_likelihood(self._projected(residuals), eta, slice(None))
        own[:, -1] += shared
        return own

    def of_blocks(
        self, residuals: Sequence[Array], eta: Array, starts: Sequence[Integers]
    ) -> list[Array]:
        """Blocks are whole runs, given the runs before; outputs given the outputs before."""
        if any(len(first) != 1 for first in starts):
            raise ValueError("blocks of runs that have errors in common are whole runs")
        sums, outputs = self._projected(residuals), len(self.frame.outputs)
        before, found = np.zeros(len(eta)), []
        for r in range(len(residuals)):
            own, shared = self._log_likelihood(sums, eta, slice(0, r + 1))
            now = own.sum(axis=1) + shared
            # One density of all outputs, which share the coefficients: each gets an equal part.
            part = (now - before)[:, None, None] / outputs
            found.append(np.repeat(part, outputs, axis=1))
            before = now
        return found

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        return self._products_of({run: columns}, eta)

    def products_of_all(self, columns: Sequence[Sequence[Array]], eta: Array) -> Array:
        return self._products_of(dict(enumerate(columns)), eta)

    def _products_of(self, columns: Mapping[int, Sequence[Array]], eta: Array) -> Array:
        rho, remainder, effects = (part[0] for part in self._sizes(eta[None]))
        rows = self._rows(columns)
        return self.evidence.products(rows, rho, float(remainder), float(effects))[0]

    def _rows(self, columns: Mapping[int, Sequence[Array]]) -> list[Rows]:
        """Rows (k, n) of each output of some runs on the bases."""
        found, width = [], self.evidence.power.shape[2]
        for r, outputs in columns.items():
            for b, given in enumerate(outputs):
                time, colour = self.frame.sampled()[r].time, self._signatures.colour[b]
                white = whitened(np.ascontiguousarray(given), time, *colour)[0]
                white = white / self._signatures.noise[b]
                along, across = np.split(white @ self._tables[r][b], [width], axis=1)
                found.append(self.evidence.rows(r, b, white, along, across))
        return found

    def linearised(
        self,
        sensitivity: Sequence[Sequence[Array]],
        residual: Sequence[Sequence[Array]],
        precision: Array,
        pull: Array,
    ) -> Linearised:
        """Posterior of linearised unknowns, and the evidence of more than noise.

        Parameters
        ----------
        sensitivity : sequence over runs of sequence over outputs of ndarray, shape (l, n)
        residual : the same, each of shape (n,)
        precision : ndarray, shape (l, l)
            Of the unknowns' prior.
        pull : ndarray, shape (l,)
            Precision times prior mean less estimate.
        """
        both = {
            r: [np.vstack([j, e]) for j, e in zip(columns, left, strict=True)]
            for r, (columns, left) in enumerate(zip(sensitivity, residual, strict=True))
        }
        return self.evidence.linearised(self._rows(both), precision, pull)

    def log_evidence(self, residual: Sequence[Sequence[Array]]) -> float:
        """Logarithm of the evidence of residuals whose unknowns are known, up to a constant.

        Parameters
        ----------
        residual : sequence over runs of sequence over outputs of ndarray, shape (n,)
        """
        rows = {r: [one[None] for one in row] for r, row in enumerate(residual)}
        return self.evidence.log_evidence(self._rows(rows))

    # -- start, and draws --------------------------------------------------------------------

    def start(self, residuals: Sequence[Array]) -> Array:
        sums = self._projected([e[None] for e in residuals])
        guess = np.full(len(self.quantities), _GUESSES[0])
        outputs = len(self.frame.outputs)
        guess[:outputs] = log_mean_squares(residuals)
        if self.frame.signatures is not None and self._signatures.names:
            guess[:outputs] = np.minimum(guess[:outputs], 2 * np.log(self._signatures.noise))

        def height(trial: Array) -> Array:
            total = self.log_prior(trial)
            for k, eta in enumerate(trial):
                own, shared = self._log_likelihood(sums, eta[None], slice(None))
                total[k] += own.sum() + shared[0]
            return total

        guesses = []
        for size in _GUESSES:
            one = guess.copy()
            one[outputs:] = size
            guesses.append(one)
        return climb(height, guesses)

    def scales(self) -> Array:
        sd = super().scales()
        sd[len(self.frame.outputs) :] = _SIZE_SD
        return sd

    def common(self, residuals: Sequence[Array], eta: Array, rng: np.random.Generator) -> Array:
        """Draw the coefficients that runs share, given the residuals of the fitted runs.

        Parameters
        ----------
        residuals : sequence over runs of ndarray, shape (W, s, n)
        eta : ndarray, shape (W, m)
            Coordinates.
        rng : numpy.random.Generator

        Returns
        -------
        ndarray, shape (W, k + s m)
            Of the ``k`` signatures, then of each output's smooth functions.
        """
        _, found = self._system(self._projected(residuals), eta, slice(None))
        known, size = self.evidence, np.sqrt(self._sizes(eta)[2])
        unit, rows = np.repeat(self._signatures.noise, known.power.shape[2]), []
        for lane, shared in enumerate(found):
            effects = size[lane] * rng.standard_normal(len(known.rotation))
            place, alone = self._one_alone(shared, rng)
            given = alone * known.alone[place] if alone else np.zeros(known.count)
            drawn = shared.draw(given, rng)
            # Signatures that fitted runs do not show keep their prior.
            effects += known.rotation @ (drawn[: known.count] - effects @ known.rotation)
            if alone:
                column = self._signatures.single[place]
                effects[column] += alone / np.sqrt(self._signatures.share[column])
            rows.append(np.concatenate([effects, drawn[known.count :] * unit]))
        return np.array(rows)

    def _one_alone(self, shared: Shared, rng: np.random.Generator) -> tuple[int, float]:
        """Which effect acts alone and its coefficient; zero if none does."""
        if not len(self.evidence.alone):
            return 0, 0.0
        terms, score, information = self._terms(shared)
        weight = np.append(terms.ravel(), np.log(0.5))
        weight = np.exp(weight - logsumexp(weight))
        chosen = int(rng.choice(weight.size, p=weight / weight.sum()))
        if chosen == terms.size:
            return 0, 0.0
        place, square = chosen // ALONE, self.evidence.alone_squares[chosen % ALONE]
        variance = square / (1 + square * information[place])
        return place, float(variance * score[place] + np.sqrt(variance) * rng.standard_normal())

    def draw(
        self,
        natural: Array,
        run: str,
        samples: RunSamples,
        rng: np.random.Generator,
        common: Array | None = None,
    ) -> Array:
        outputs, count = len(self.frame.outputs), len(self.evidence.rotation)
        sd, out = np.sqrt(self.variance(natural, run)), super().draw(natural, run, samples, rng)
        for b, (share, time) in enumerate(self._signatures.colour):
            if share > 0:
                slow = draw_process(np.full(len(natural), time), samples, rng)
                out[:, b] *= np.sqrt(1 - share)
                out[:, b] += (sd[:, b] * np.sqrt(share))[:, None] * slow
        table = smooth_basis(samples.phase + self._origin(run, samples))
        size = natural[:, outputs] * np.sqrt(0.5)
        width = table.shape[1]
        if common is None:
            common = self._unconditional(natural, sd, width, rng)
        curves = self._curves(run, samples)
        for b in range(outputs):
            own = rng.standard_normal((len(natural), width)) * (size * sd[:, b])[:, None]
            first = count + b * width
            smooth = common[:, first : first + width]
            out[:, b] += (own + smooth) @ table.T
            if curves is not None:
                out[:, b] += common[:, :count] @ curves[b]
        return out

    def _unconditional(
        self, natural: Array, sd: Array, width: int, rng: np.random.Generator
    ) -> Array:
        """Coefficients that runs share, from their prior."""
        outputs = len(self.frame.outputs)
        effects = rng.standard_normal((len(natural), len(self.evidence.rotation)))
        if natural.shape[1] > outputs + 1:
            effects *= natural[:, outputs + 1][:, None]
        smooth = rng.standard_normal((len(natural), outputs, width))
        smooth *= (np.sqrt(0.5) * natural[:, outputs][:, None] * sd)[:, :, None]
        return np.hstack([effects, smooth.reshape(len(natural), -1)])

    def _origin(self, run: str, samples: RunSamples) -> float:
        """Cycles from the crest of a run's input to its first sample."""
        known = zip(self.frame.runs, self.frame.sampled(), strict=True)
        fitted = {label: item.origin for label, item in known}
        return {**self._signatures.origins, **fitted}.get(run, samples.origin)

    def _curves(self, run: str, samples: RunSamples) -> Array | None:
        """Signatures of a run at some samples, (s, k, n)."""
        if run not in self._signatures.curves:
            return None
        periodic = samples.frequency is not None
        since = samples.time - samples.time[0]
        if samples.frequency is not None:
            position = samples.frequency * since
        else:
            position = since / since[-1] if since[-1] > 0 else since
        return self._signatures.at(run, position, periodic)


def _none(frame: Frame) -> Signatures:
    """No signatures, noise of unit size."""
    outputs = len(frame.outputs)
    return Signatures(
        (),
        frame.runs,
        tuple(np.zeros((outputs, 0, int(n))) for n in frame.counts[:, 0]),
        np.ones(outputs),
        ((0.0, 1.0),) * outputs,
        {},
        np.zeros(0),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        {},
    )


def _log_sum(terms: Array) -> float:
    """Logarithm of one half, for no effect that acts alone, and the sum of exponentials.

    That of SciPy takes ten times as long for so few terms.
    """
    most = max(float(np.max(terms)), LOG_HALF)
    if not np.isfinite(most):
        return most
    return most + float(np.log(np.sum(np.exp(terms - most)) + np.exp(LOG_HALF - most)))


def _by_row(values: Array) -> Array:
    """Sums over the last axis, each by itself."""
    return np.array([float(np.sum(row)) for row in values])
