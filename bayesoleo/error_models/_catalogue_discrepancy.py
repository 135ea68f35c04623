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
from bayesoleo.error_models._alone_mixture import Components, moments_of
from bayesoleo.error_models._base import (
    ErrorModel,
    Frame,
    Quantity,
    RunSamples,
    log_mean_squares,
)
from bayesoleo.error_models._correlated import draw_process, whitened
from bayesoleo.error_models._fitting import climb
from bayesoleo.error_models._signatures import (
    Part,
    Rows,
    Shared,
    Signatures,
    Sums,
    project_rows,
    range_of,
    smooth_basis,
)
from bayesoleo.model._priors import LogUniform

#: Least and usual largest size of the catalogue's part and of the remainder, over the noise of a
#: sample.
SMALLEST, LARGEST = 0.01, 30.0
#: Squared singular values of a run's smooth functions, as part of the largest, that count as zero.
_NONE = 1e-12
#: Rough standard deviation of a size's coordinate: half a decade.
_SIZE_SD = 0.3
# Sizes from which the most likely ones are searched.
_GUESSES = (-1.5, 0.0)
#: Least size of an effect that acts alone, and number of sizes up to the largest one.
LEAST_ALONE, ALONE = 0.03, 8
#: Sizes over the noise at which effects and remainder are looked for.
EFFECTS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
REMAINDERS = (0.03, 0.1, 0.3, 1.0, 3.0)
#: Effects that act alone of which each has a group of its own, and its least probability.
GROUPS, LEAST_GROUP = 7, 0.01
#: Part of a sum of products below which a difference of such sums is rounding.
_LOST = 1e-12
_LOG_2_PI = float(np.log(2 * np.pi))
_LOG_HALF = float(np.log(0.5))


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


@dataclass(frozen=True)
class Linearised:
    """Posterior of linearised unknowns under noise, effects and a remainder.

    Parameters
    ----------
    log_odds : float
        Logarithm of the evidence of more than noise over that of noise alone.
    shift : ndarray, shape (l,)
        Mean, from the point of linearisation.
    covariance : ndarray, shape (l, l)
    groups : tuple of (weight, mean, covariance)
        Parts of the mixture: one for each of the likeliest effects that act alone, and one for all
        others.
    """

    log_odds: float
    shift: Array
    covariance: Array
    groups: tuple[tuple[float, Array, Array], ...] = ()


@dataclass(frozen=True)
class _Apart:
    """Products over runs, as if these had nothing in common, and of what they have.

    Parameters
    ----------
    total : ndarray, shape (k, k)
        ``C V^-1 C'``.
    logs : float
        ``ln |V|``.
    inner, cross : ndarray, shapes (R, R) and (k, R)
        Of the columns of what runs share with each other, and with the rows.
    """

    total: Array
    logs: float
    inner: Array
    cross: Array

    def shared_with(self, deviation: Array) -> tuple[Array, float, Shared]:
        """Both with coefficients in common, of prior deviations (R,), and what is known of them."""
        shared = Shared.of(self.inner, self.cross, deviation)
        return self.total - shared.half @ shared.half.T, self.logs + 2 * shared.log_root, shared


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
        runs, outputs = frame.counts.shape
        found = frame.signatures or _none(frame)
        white = [
            [
                whitened(found.columns[r][b], samples[r].time, *found.colour[b])
                for b in range(outputs)
            ]
            for r in range(runs)
        ]
        # Signatures of all samples take hundreds of megabytes: they are not copied to be scaled.
        blocks = [[block for block, _ in row] for row in white]
        self._variances, self._rotation = range_of(blocks, found.noise)
        self._signatures = found.without_columns()
        # Coefficients of each effect that acts alone, at unit size.
        alone = self._rotation[found.single] / np.sqrt(found.share[found.single])[:, None]
        self._alone = np.ascontiguousarray(alone)
        sizes = np.exp(np.linspace(np.log(LEAST_ALONE), np.log(max(LARGEST, found.largest)), ALONE))
        self._alone_squares = sizes**2
        self._log_odds = np.log(0.5 * found.odds / ALONE)
        self.frame = replace(frame, signatures=self._signatures)
        self._parts = [
            [self._part(samples[r], b, *white[r][b]) for b in range(outputs)] for r in range(runs)
        ]
        # Products of signatures beside the smooth functions, of each output and run.
        self._grams = np.array([[self._beside(part) for part in row] for row in self._parts])
        self._shared = np.array([[part.shared for part in row] for row in self._parts])
        self._power = np.array([[part.power for part in row] for row in self._parts])

    def _part(self, samples: RunSamples, b: int, signatures: Array, log_sd: float) -> Part:
        """Basis of one output in one run, given its whitened signatures (k, n)."""
        outputs, count = len(self.frame.outputs), self._variances.size
        smooth, _ = whitened(
            smooth_basis(_phase(samples)).T, samples.time, *self._signatures.colour[b]
        )
        left, values, right = np.linalg.svd(smooth.T, full_matrices=False)
        values = np.where(values**2 > _NONE * values[0] ** 2, values, 0.0)
        width = values.size
        table = np.empty((len(left), width + count))
        table[:, :width] = left
        effects = table[:, width:]
        np.matmul(signatures.T, self._rotation / self._signatures.noise[b], out=effects)
        shared = np.zeros((width, count + outputs * width))
        shared[:, :count] = left.T @ effects
        shared[:, count + b * width : count + (b + 1) * width] = values[:, None] * right
        scale = log_sd + signatures.shape[1] * float(np.log(self._signatures.noise[b]))
        return Part(table, width, values**2, shared, scale)

    def _beside(self, part: Part) -> Array:
        count = self._variances.size
        effects, along = part.table[:, part.size :], part.shared[:, :count]
        return np.asarray(effects.T @ effects - along.T @ along)

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
        lanes, count = len(residuals[0]), self._variances.size
        runs, outputs = self._power.shape[:2]
        width = self._power.shape[2]
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
        part, count = self._parts[r][b], self._variances.size
        time, colour = self.frame.sampled()[r].time, self._signatures.colour[b]
        white = whitened(rows, time, *colour)[0] / self._signatures.noise[b]
        out, squares = np.empty((len(rows), part.table.shape[1])), np.empty(len(rows))
        project_rows(white, part.table, out, squares)
        along = out[:, : part.size]
        sums.along[:, r, b] = along
        sums.rest[:, r, b] = squares - _by_row(along * along)
        # One row at a time: a product of matrices may round differently with another number.
        for lane in range(len(rows)):
            sums.across[lane, r, b] = out[lane, part.size :] - along[lane] @ part.shared[:, :count]

    def _system(self, sums: Sums, eta: Array, runs: slice) -> tuple[Array, list[Shared]]:
        """Of some runs: own log-likelihoods (L, N), and what the coefficients in common know."""
        rho, remainder, effects = self._sizes(eta)
        count, counts = self._variances.size, self.frame.counts[runs]
        shared, power = self._shared[runs], self._power[runs]
        size = shared.shape[-1]
        pivot = rho[:, None, :, None] * (1 + 0.5 * remainder[:, None, None, None] * power)
        own = counts * np.log(rho)[:, None] + np.log(pivot / rho[:, None, :, None]).sum(axis=3)
        own += sums.rest[:, runs] / rho[:, None] + (sums.along[:, runs] ** 2 / pivot).sum(axis=3)
        own += counts * _LOG_2_PI + 2 * np.array(
            [[part.scale for part in row] for row in self._parts[runs]]
        )
        flat, grams, found = shared.reshape(-1, size), self._grams[runs].sum(axis=0), []
        for lane in range(len(rho)):
            weight = 1 / pivot[lane].reshape(-1)
            # A product of a table with itself takes half the work.
            half = flat * np.sqrt(weight)[:, None]
            inner = half.T @ half
            inner[:count, :count] += np.tensordot(1 / rho[lane], grams, 1)
            right = (weight * sums.along[lane, runs].reshape(-1)) @ flat
            right[:count] += (sums.across[lane, runs] / rho[lane][:, None]).sum(axis=(0, 1))
            deviation = self._deviation(rho[lane], remainder[lane], effects[lane])
            found.append(Shared.of(inner, right[None], deviation))
        return -0.5 * own.sum(axis=2), found

    def _terms(self, shared: Shared) -> tuple[Array, Array, Array]:
        """Of one effect that acts alone: log weights (q, ALONE), score and information (q,)."""
        information, scores = shared.along(self._alone)
        score = scores[0]
        more = self._alone_squares * information[:, None]
        gain = self._alone_squares * score[:, None] ** 2 / (1 + more)
        return self._log_odds[:, None] + 0.5 * (gain - np.log1p(more)), score, information

    def _log_likelihood(self, sums: Sums, eta: Array, runs: slice) -> tuple[Array, Array]:
        """Own log-likelihood of each run (L, N), and what sharing coefficients adds (L,)."""
        own, found = self._system(sums, eta, runs)
        more = np.empty(len(eta))
        for lane, shared in enumerate(found):
            more[lane] = 0.5 * float(shared.half[0] @ shared.half[0]) - shared.log_root
            if len(self._alone):
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
        return self._products(self._rows({run: columns}), self._sizes(eta[None]))[0]

    def products_of_all(self, columns: Sequence[Sequence[Array]], eta: Array) -> Array:
        return self._products(self._rows(dict(enumerate(columns))), self._sizes(eta[None]))[0]

    def _rows(self, columns: Mapping[int, Sequence[Array]]) -> list[Rows]:
        """Rows (k, n) of each output of some runs on the bases."""
        found, count = [], self._variances.size
        for r, outputs in columns.items():
            for b, given in enumerate(outputs):
                part, unit = self._parts[r][b], self._signatures.noise[b]
                time, colour = self.frame.sampled()[r].time, self._signatures.colour[b]
                white = whitened(np.ascontiguousarray(given), time, *colour)[0] / unit
                products = white @ part.table
                along, across = products[:, : part.size], products[:, part.size :]
                across = across - along @ part.shared[:, :count]
                found.append(Rows(r, b, white @ white.T - along @ along.T, along, across))
        return found

    def _products(
        self, rows: Sequence[Rows], sizes: tuple[Array, Array, Array]
    ) -> tuple[Array, float, Shared]:
        """``C V^-1 C'`` and ``ln |V|`` over the runs of some rows, whitening left out.

        Without effects that act alone.
        """
        rho, remainder, effects = (part[0] for part in sizes)
        known = self._apart(rows, rho, remainder)
        return known.shared_with(self._deviation(rho, remainder, effects))

    def _apart(self, rows: Sequence[Rows], rho: Array, remainder: float) -> _Apart:
        """The same of runs that have nothing in common: what no size of an effect changes."""
        count, size = self._variances.size, self._shared.shape[-1]
        number, logs = len(rows[0].along), 0.0
        total, cross = np.zeros((number, number)), np.zeros((number, size))
        inner = np.zeros((size, size))
        for one in rows:
            part, scale = self._parts[one.run][one.output], rho[one.output]
            gain = 1 / (1 + 0.5 * remainder * part.power)
            total += (one.gram + (one.along * gain) @ one.along.T) / scale
            cross += ((one.along * gain) @ part.shared) / scale
            cross[:, :count] += one.across / scale
            # A product of a table with itself takes half the work.
            half = part.shared * np.sqrt(gain / scale)[:, None]
            inner += half.T @ half
            inner[:count, :count] += self._grams[one.run, one.output] / scale
            logs += len(part.table) * float(np.log(scale)) - float(np.sum(np.log(gain)))
        return _Apart(total, logs, inner, cross)

    def _deviation(self, rho: Array, remainder: Array, effects: Array) -> Array:
        """Prior deviations of what runs share, (R,), in units of the frozen noise."""
        width = self._power.shape[2]
        smooth = np.repeat(np.sqrt(0.5 * remainder * rho), width)
        return np.concatenate([np.full(self._variances.size, float(np.sqrt(effects))), smooth])

    def linearised(
        self,
        sensitivity: Sequence[Sequence[Array]],
        residual: Sequence[Sequence[Array]],
        precision: Array,
        pull: Array,
    ) -> Linearised:
        """Posterior of linearised unknowns, and the evidence of more than noise.

        It is a mixture of normal distributions: over sizes of effects and remainder on a grid, and
        over effects that act alone. The noise's variance, in the measured ratios between outputs,
        is the most likely one of each component.

        Parameters
        ----------
        sensitivity : sequence over runs of sequence over outputs of ndarray, shape (l, n)
        residual : the same, each of shape (n,)
        precision : ndarray, shape (l, l)
            Of the unknowns' prior.
        pull : ndarray, shape (l,)
            Precision times prior mean less estimate.

        References
        ----------
        Patterson and Thompson (1971), Biometrika 58, 545-554 (restricted likelihood).
        """
        found = self._over_sizes(sensitivity, residual, precision, pull)
        heights = np.stack([one.heights for one in found]) - np.log(len(found))
        # Without anything but noise: the first component, which is no evidence of more.
        more = float(logsumexp(heights.ravel()[1:])) - float(found[0].heights[0])
        _, centre, covariance = moments_of(found, np.exp(heights - logsumexp(heights)))
        return Linearised(more, centre, covariance, self._grouped(found, heights))

    def _grouped(
        self, found: Sequence[Components], heights: Array
    ) -> tuple[tuple[float, Array, Array], ...]:
        """Moments of each of the likeliest effects that act alone, and of all else."""
        weights, count = np.exp(heights - logsumexp(heights)), len(self._alone)
        effect = np.concatenate([[-1], np.repeat(np.arange(count), ALONE)])
        by_effect = np.bincount(effect[1:], weights[:, 1:].sum(axis=0), count)
        likely = np.argsort(-by_effect, kind="stable")[:GROUPS]
        likely = likely[by_effect[likely] > LEAST_GROUP]
        group = np.where(np.isin(effect, likely), effect, -1)
        return tuple(moments_of(found, np.where(group == k, weights, 0.0)) for k in (-1, *likely))

    def log_evidence(self, residual: Sequence[Sequence[Array]]) -> float:
        """Logarithm of the evidence of residuals whose unknowns are known, up to a constant.

        Over the same sizes and effects as :meth:`linearised`.

        Parameters
        ----------
        residual : sequence over runs of sequence over outputs of ndarray, shape (n,)
        """
        none = [[np.empty((0, one.size)) for one in row] for row in residual]
        found = self._over_sizes(none, residual, np.empty((0, 0)), np.empty(0))
        return float(logsumexp(np.concatenate([one.heights for one in found])))

    def _over_sizes(
        self,
        sensitivity: Sequence[Sequence[Array]],
        residual: Sequence[Sequence[Array]],
        precision: Array,
        pull: Array,
    ) -> list[Components]:
        """The components at each size of the remainder and of effects, both zero first."""
        both = {
            r: [np.vstack([j, e]) for j, e in zip(columns, left, strict=True)]
            for r, (columns, left) in enumerate(zip(sensitivity, residual, strict=True))
        }
        rows, count = self._rows(both), int(self.frame.counts.sum())
        one, found = np.ones(len(self.frame.outputs)), []
        for remainder in np.square((0.0, *REMAINDERS)):
            known = self._apart(rows, one, remainder)
            for effects in np.square((0.0, *(EFFECTS if self._variances.size else ()))):
                parts = known.shared_with(self._deviation(one, remainder, effects))
                found.append(self._components(parts, count, precision, pull))
        return found

    def _components(
        self, parts: tuple[Array, float, Shared], count: int, precision: Array, pull: Array
    ) -> Components:
        """The components at one size of the remainder and of effects, over the noise.

        The noise's variance scales the sum of squares alone: priors do not depend on it.
        """
        gram, logs, shared = parts
        covariance = np.linalg.inv(gram[:-1, :-1] + precision)
        right = gram[:-1, -1] + pull
        mean = covariance @ right
        prior = float(pull @ mean - 0.5 * mean @ precision @ mean)
        least = _LOST * max(float(gram[-1, -1]), _LOST)
        square = float(gram[-1, -1] - right @ mean)
        left = max(square + 2 * prior, least)
        logs = logs - float(np.linalg.slogdet(covariance)[1])
        start = prior - 0.5 * (count * np.log(left) + logs)
        if not len(self._alone):
            nothing = np.empty((0, ALONE))
            return Components(
                np.array([start]), mean, covariance, left / count, np.empty((mean.size, 0)),
                nothing, nothing, nothing,
            )  # fmt: skip
        own, cross = shared.along(self._alone)
        turned = covariance @ cross[:-1]
        information = own - np.sum(cross[:-1] * turned, axis=0)
        # Of an effect that the unknowns imitate, rounding is left, and no information.
        told = information > _LOST * own
        information = np.where(told, information, 0.0)[:, None]
        score = np.where(told, cross[-1] - cross[:-1].T @ mean, 0.0)[:, None]
        gain = self._alone_squares / (1 + self._alone_squares * information)
        moved = gain * score
        pulled = ((pull - precision @ mean) @ turned)[:, None]
        curved = np.sum(turned * (precision @ turned), axis=0)[:, None]
        priors = prior - moved * pulled - 0.5 * moved**2 * curved
        rest = np.maximum(square - gain * score**2 + 2 * priors, least)
        heights = (
            self._log_odds[:, None]
            + priors
            - 0.5 * (count * np.log(rest) + logs + np.log1p(self._alone_squares * information))
        )
        return Components(
            np.append(start + _LOG_HALF, heights.ravel()), mean, covariance, left / count, turned,
            moved, gain, rest / count,
        )  # fmt: skip

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
        count, size = self._variances.size, np.sqrt(self._sizes(eta)[2])
        unit, rows = np.repeat(self._signatures.noise, self._power.shape[2]), []
        for lane, shared in enumerate(found):
            effects = size[lane] * rng.standard_normal(len(self._rotation))
            place, alone = self._one_alone(shared, rng)
            drawn = shared.draw(alone * self._alone[place] if alone else np.zeros(count), rng)
            # Signatures that fitted runs do not show keep their prior.
            effects += self._rotation @ (drawn[:count] - effects @ self._rotation)
            if alone:
                column = self._signatures.single[place]
                effects[column] += alone / np.sqrt(self._signatures.share[column])
            rows.append(np.concatenate([effects, drawn[count:] * unit]))
        return np.array(rows)

    def _one_alone(self, shared: Shared, rng: np.random.Generator) -> tuple[int, float]:
        """Which effect acts alone and its coefficient; zero if none does."""
        if not len(self._alone):
            return 0, 0.0
        terms, score, information = self._terms(shared)
        weight = np.append(terms.ravel(), np.log(0.5))
        weight = np.exp(weight - logsumexp(weight))
        chosen = int(rng.choice(weight.size, p=weight / weight.sum()))
        if chosen == terms.size:
            return 0, 0.0
        place, square = chosen // ALONE, self._alone_squares[chosen % ALONE]
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
        outputs, count = len(self.frame.outputs), len(self._rotation)
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
        effects = rng.standard_normal((len(natural), len(self._rotation)))
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


def _phase(samples: RunSamples) -> Array:
    """Cycles from the crest of the run's input; half a cycle in a run that does not repeat."""
    return samples.phase + samples.origin


def _log_sum(terms: Array) -> float:
    """Logarithm of one half, for no effect that acts alone, and the sum of exponentials.

    That of SciPy takes ten times as long for so few terms.
    """
    most = max(float(np.max(terms)), _LOG_HALF)
    if not np.isfinite(most):
        return most
    return most + float(np.log(np.sum(np.exp(terms - most)) + np.exp(_LOG_HALF - most)))


def _by_row(values: Array) -> Array:
    """Sums over the last axis, each by itself."""
    return np.array([float(np.sum(row)) for row in values])
