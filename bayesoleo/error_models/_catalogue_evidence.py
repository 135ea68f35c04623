"""Evidence of effects that a model might lack, about unknowns in which the outputs are linear.

Signatures act through their products alone: with each other, with the smooth functions of the
remainder, and with the rows that are asked for. A product is a number where a signature has one for
each sample, so that all that follows has the size of the numerical range of the signatures, and the
signatures themselves need not be held together.

References
----------
Rasmussen and Williams (2006), *Gaussian Processes for Machine Learning*, eqs. A.9-A.10 (the
lemmas). Patterson and Thompson (1971), Biometrika 58, 545-554 (restricted likelihood).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bayesoleo._types import Array, Integers
from bayesoleo.error_models._alone_mixture import Components, moments_of
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._correlated import whitened
from bayesoleo.error_models._signatures import Rows, Shared, Signatures, range_of, smooth_basis

#: Usual largest size of the catalogue's part and of the remainder, over the noise of a sample.
LARGEST = 30.0
#: Squared singular values of a run's smooth functions, as part of the largest, that count as zero.
_NONE = 1e-12
#: Least size of an effect that acts alone, and number of sizes up to the largest one.
LEAST_ALONE, ALONE = 0.03, 8
#: Sizes over the noise at which effects and remainder are looked for.
EFFECTS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
REMAINDERS = (0.03, 0.1, 0.3, 1.0, 3.0)
#: Effects that act alone of which each has a group of its own, and its least probability.
GROUPS, LEAST_GROUP = 7, 0.01
#: Part of a sum of products below which a difference of such sums is rounding.
_LOST = 1e-12
LOG_HALF = float(np.log(0.5))


@dataclass(frozen=True)
class Smooth:
    """Smooth functions of one output in one run, whitened: an orthonormal basis and sizes.

    Parameters
    ----------
    basis : ndarray, shape (n, m)
    values : ndarray, shape (m,)
        Singular values; zero where rounding is all there is.
    right : ndarray, shape (m, m)
        Rows are the coefficients whose functions these are.
    log_sd : float
        Half the logarithm of the determinant of the noise's correlation.
    """

    basis: Array
    values: Array
    right: Array
    log_sd: float

    @classmethod
    def of(cls, samples: RunSamples, colour: tuple[float, float]) -> Smooth:
        """Of a run's samples, for noise with such a correlated share and correlation time."""
        # Half a cycle in a run that does not repeat.
        functions = smooth_basis(samples.phase + samples.origin).T
        white, log_sd = whitened(functions, samples.time, *colour)
        basis, values, right = np.linalg.svd(white.T, full_matrices=False)
        values = np.where(values**2 > _NONE * values[0] ** 2, values, 0.0)
        return cls(basis, values, right, log_sd)


@dataclass(frozen=True)
class SignatureProducts:
    """Products of the signatures of one output in one run, whitened, in units of its noise.

    Parameters
    ----------
    present : ndarray of int, shape (p,)
        Signatures that are not zero there.
    gram : ndarray, shape (p, p)
        With each other.
    along : ndarray, shape (p, m)
        With the basis of the smooth functions.
    """

    present: Integers
    gram: Array
    along: Array

    @classmethod
    def of(cls, white: Array, smooth: Smooth, unit: float) -> SignatureProducts:
        """Of whitened signatures (k, n), with the noise's standard deviation."""
        gram, along = (white @ white.T) / unit**2, (white @ smooth.basis) / unit
        return cls(np.arange(len(white)), gram, along)


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


@dataclass(frozen=True)
class CatalogueEvidence:
    """What all signatures do together, on the ``R`` directions that they span.

    Parameters
    ----------
    counts : ndarray of int, shape (N, s)
        Samples by run and output.
    rotation : ndarray, shape (k, R)
        Coefficients of the directions, see :func:`range_of`.
    grams : ndarray, shape (N, s, R, R)
        Products of the directions with each other, beside the smooth functions.
    shared : ndarray, shape (N, s, m, R + s m)
        What the coefficients that runs share change along the smooth functions.
    power : ndarray, shape (N, s, m)
        Prior variances of the smooth functions' coefficients, at size one.
    alone : ndarray, shape (q, R)
        Coefficients of each effect that acts alone, at unit size.
    alone_squares : ndarray, shape (ALONE,)
        Squared sizes at which one does.
    log_odds : ndarray, shape (q,)
        Of each such effect at each of these sizes.
    """

    counts: Integers
    rotation: Array
    grams: Array
    shared: Array
    power: Array
    alone: Array
    alone_squares: Array
    log_odds: Array

    @classmethod
    def of(
        cls,
        products: Sequence[Sequence[SignatureProducts]],
        smooth: Sequence[Sequence[Smooth]],
        signatures: Signatures,
    ) -> CatalogueEvidence:
        """From products by run and output; of the signatures no samples are needed."""
        gram = np.zeros((len(signatures.names),) * 2)
        for one in (one for row in products for one in row):
            gram[np.ix_(one.present, one.present)] += one.gram
        rotation, outputs = range_of(gram), len(smooth[0])
        count, width = rotation.shape[1], smooth[0][0].values.size
        grams = np.empty((len(products), outputs, count, count))
        shared = np.zeros((len(products), outputs, width, count + outputs * width))
        for r, row in enumerate(products):
            for b, one in enumerate(row):
                turned, part = rotation[one.present], smooth[r][b]
                along = one.along.T @ turned
                grams[r, b] = turned.T @ one.gram @ turned - along.T @ along
                shared[r, b, :, :count] = along
                own = slice(count + b * width, count + (b + 1) * width)
                shared[r, b, :, own] = part.values[:, None] * part.right
        unit = rotation[signatures.single] / np.sqrt(signatures.share[signatures.single])[:, None]
        ends = np.log(LEAST_ALONE), np.log(max(LARGEST, signatures.largest))
        return cls(
            np.array([[len(part.basis) for part in row] for row in smooth]),
            rotation,
            grams,
            shared,
            np.array([[part.values**2 for part in row] for row in smooth]),
            np.ascontiguousarray(unit),
            np.exp(np.linspace(*ends, ALONE)) ** 2,
            np.log(0.5 * signatures.odds / ALONE),
        )

    @property
    def count(self) -> int:
        """``R``, the number of directions."""
        return int(self.rotation.shape[1])

    def deviation(self, rho: Array, remainder: float, effects: float) -> Array:
        """Prior deviations of what runs share, (R + s m,), in units of the frozen noise.

        Parameters
        ----------
        rho : ndarray, shape (s,)
            Noise over its frozen variance.
        remainder, effects : float
            Squared sizes.
        """
        smooth = np.repeat(np.sqrt(0.5 * remainder * rho), self.power.shape[2])
        return np.concatenate([np.full(self.count, float(np.sqrt(effects))), smooth])

    def rows(self, run: int, output: int, white: Array, along: Array, across: Array) -> Rows:
        """Rows as the evidence needs them.

        Parameters
        ----------
        run, output : int
            To which they belong.
        white : ndarray, shape (q, n)
            Whitened, in units of the noise.
        along : ndarray, shape (q, m)
            Their products with the smooth functions' basis.
        across : ndarray, shape (q, R)
            Their products with the directions.
        """
        beside = across - along @ self.shared[run, output, :, : self.count]
        return Rows(run, output, white @ white.T - along @ along.T, along, beside)

    def products(
        self, rows: Sequence[Rows], rho: Array, remainder: float, effects: float
    ) -> tuple[Array, float, Shared]:
        """``C V^-1 C'`` and ``ln |V|`` over the runs of some rows, whitening left out.

        Without effects that act alone. Parameters are those of :meth:`deviation`.
        """
        known = self._apart(rows, rho, remainder)
        return known.shared_with(self.deviation(rho, remainder, effects))

    def _apart(self, rows: Sequence[Rows], rho: Array, remainder: float) -> _Apart:
        """The same of runs that have nothing in common: what no size of an effect changes."""
        count, size = self.count, self.shared.shape[-1]
        number, logs = len(rows[0].along), 0.0
        total, cross = np.zeros((number, number)), np.zeros((number, size))
        inner = np.zeros((size, size))
        for one in rows:
            place, scale = (one.run, one.output), rho[one.output]
            gain = 1 / (1 + 0.5 * remainder * self.power[place])
            total += (one.gram + (one.along * gain) @ one.along.T) / scale
            cross += ((one.along * gain) @ self.shared[place]) / scale
            cross[:, :count] += one.across / scale
            # A product of a table with itself takes half the work.
            half = self.shared[place] * np.sqrt(gain / scale)[:, None]
            inner += half.T @ half
            inner[:count, :count] += self.grams[place] / scale
            logs += int(self.counts[place]) * float(np.log(scale)) - float(np.sum(np.log(gain)))
        return _Apart(total, logs, inner, cross)

    def linearised(self, rows: Sequence[Rows], precision: Array, pull: Array) -> Linearised:
        """Posterior of linearised unknowns, and the evidence of more than noise.

        It is a mixture of normal distributions: over sizes of effects and remainder on a grid, and
        over effects that act alone. The noise's variance, in the measured ratios between outputs,
        is the most likely one of each component.

        Parameters
        ----------
        rows : sequence of Rows
            Of all runs and outputs: sensitivities to each unknown, and the residual as the last.
        precision : ndarray, shape (l, l)
            Of the unknowns' prior.
        pull : ndarray, shape (l,)
            Precision times prior mean less estimate.
        """
        found = self._over_sizes(rows, precision, pull)
        heights = np.stack([one.heights for one in found]) - np.log(len(found))
        # Without anything but noise: the first component, which is no evidence of more.
        more = float(logsumexp(heights.ravel()[1:])) - float(found[0].heights[0])
        _, centre, covariance = moments_of(found, np.exp(heights - logsumexp(heights)))
        return Linearised(more, centre, covariance, self._grouped(found, heights))

    def log_evidence(self, rows: Sequence[Rows]) -> float:
        """Logarithm of the evidence of residuals whose unknowns are known, up to a constant.

        Over the same sizes and effects as :meth:`linearised`.

        Parameters
        ----------
        rows : sequence of Rows
            Of all runs and outputs, the residual alone.
        """
        found = self._over_sizes(rows, np.empty((0, 0)), np.empty(0))
        return float(logsumexp(np.concatenate([one.heights for one in found])))

    def _grouped(
        self, found: Sequence[Components], heights: Array
    ) -> tuple[tuple[float, Array, Array], ...]:
        """Moments of each of the likeliest effects that act alone, and of all else."""
        weights, count = np.exp(heights - logsumexp(heights)), len(self.alone)
        effect = np.concatenate([[-1], np.repeat(np.arange(count), ALONE)])
        by_effect = np.bincount(effect[1:], weights[:, 1:].sum(axis=0), count)
        likely = np.argsort(-by_effect, kind="stable")[:GROUPS]
        likely = likely[by_effect[likely] > LEAST_GROUP]
        group = np.where(np.isin(effect, likely), effect, -1)
        return tuple(moments_of(found, np.where(group == k, weights, 0.0)) for k in (-1, *likely))

    def _over_sizes(self, rows: Sequence[Rows], precision: Array, pull: Array) -> list[Components]:
        """The components at each size of the remainder and of effects, both zero first."""
        count, one, found = int(self.counts.sum()), np.ones(self.counts.shape[1]), []
        for remainder in np.square((0.0, *REMAINDERS)):
            known = self._apart(rows, one, remainder)
            for effects in np.square((0.0, *(EFFECTS if self.count else ()))):
                parts = known.shared_with(self.deviation(one, remainder, effects))
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
        if not len(self.alone):
            nothing = np.empty((0, ALONE))
            return Components(
                np.array([start]), mean, covariance, left / count, np.empty((mean.size, 0)),
                nothing, nothing, nothing,
            )  # fmt: skip
        own, cross = shared.along(self.alone)
        turned = covariance @ cross[:-1]
        information = own - np.sum(cross[:-1] * turned, axis=0)
        # Of an effect that the unknowns imitate, rounding is left, and no information.
        told = information > _LOST * own
        information = np.where(told, information, 0.0)[:, None]
        score = np.where(told, cross[-1] - cross[:-1].T @ mean, 0.0)[:, None]
        gain = self.alone_squares / (1 + self.alone_squares * information)
        moved = gain * score
        pulled = ((pull - precision @ mean) @ turned)[:, None]
        curved = np.sum(turned * (precision @ turned), axis=0)[:, None]
        priors = prior - moved * pulled - 0.5 * moved**2 * curved
        rest = np.maximum(square - gain * score**2 + 2 * priors, least)
        heights = (
            self.log_odds[:, None]
            + priors
            - 0.5 * (count * np.log(rest) + logs + np.log1p(self.alone_squares * information))
        )
        return Components(
            np.append(start + LOG_HALF, heights.ravel()), mean, covariance, left / count, turned,
            moved, gain, rest / count,
        )  # fmt: skip
