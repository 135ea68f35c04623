"""Interface of all error models: own quantities, their prior, and the likelihood of residuals.

A problem's residuals ``e = y - yhat`` are normal. Their covariance over the samples of a run, and
over outputs, depends on a few quantities of the error model: variances, correlation times, shares.
These are sampled with the parameters, in unbounded coordinates. Given them, runs are independent of
each other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, cast

import numpy as np
from scipy.special import ndtr, ndtri

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Int, Integers
from bayesoleo.error_models._signatures import Signatures
from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import InputError
from bayesoleo.model._priors import Prior, Transform, Uniform

#: Initial scale of the logarithm of a variance for Newton's method; walkers start from the mean
#: squares of the residuals.
_LOG_VARIANCE_SD = 0.3


class Measured(Protocol):
    """Interface of a problem, as an error model uses it."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """The ``s`` output channels."""

    @property
    def runs(self) -> tuple[str, ...]:
        """The ``N`` runs."""

    @property
    def counts(self) -> Integers:
        """Number of samples, shape (N, s)."""


class Residuals(Protocol):
    """Residuals and sensitivities of all runs at one parameter vector, by output."""

    @property
    def residual(self) -> tuple[Array, ...]:
        """``e = y - yhat``, (n_b,) of each output, runs one after the other."""

    @property
    def sensitivity(self) -> tuple[Array, ...]:
        """Derivatives of ``yhat``, (n_b, l) of each output."""


@dataclass(frozen=True)
class RunSamples:
    """When the samples of a run were taken.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Ascending; in seconds, or in the unit of a regression's abscissa.
    frequency : float or None
        Frequency of a periodic motion, in cycles per unit of ``time``; None for a run that does not
        repeat.
    origin : float
        Cycles from the crest of the run's input to the first sample.
    """

    time: Array
    frequency: float | None
    origin: float = 0.0

    @property
    def phase(self) -> Array:
        """Cycles since the first sample, shape (n,).

        A run that does not repeat covers half a cycle, so that a periodic function of phase can
        have different values at its start and end.
        """
        since = self.time - self.time[0]
        if self.frequency is not None:
            return np.asarray(self.frequency * since)
        return np.asarray(0.5 * since / since[-1]) if since[-1] > 0 else since


class Probit:
    """Map of a share between zero and one by the normal quantile.

    A uniform share has normal tails in this coordinate; those in a logit are exponential."""

    def natural(self, u: Array) -> Array:
        """Share at the coordinate."""
        return np.asarray(ndtr(u))

    def unbounded(self, value: Array) -> Array:
        """Coordinate of a share; infinite at zero and one."""
        return np.asarray(ndtri(value))

    def log_jacobian(self, u: Array) -> Array:
        """Logarithm of the derivative."""
        return -0.5 * u * u - 0.5 * float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Quantity:
    """One quantity of an error model.

    Parameters
    ----------
    name : str
        Name in stored results.
    low, high : float
        Bounds of its support.
    prior : Prior or None
        None where it is flat, which is allowed for logarithms of variances only.
    unit : str
        SI; ``"{}"`` stands for the output's own.
    long_name : str
        Description.
    share : bool
        Whether it is a fraction between zero and one.
    """

    name: str
    low: float = -np.inf
    high: float = np.inf
    prior: Prior | None = None
    unit: str = "1"
    long_name: str = ""
    share: bool = False

    @property
    def transform(self) -> Transform | Probit:
        """Map from a coordinate without bounds."""
        return Probit() if self.share else Transform(self.low, self.high)

    def log_prior(self, u: Array) -> Array:
        """Log density of the coordinate, shape (W,); zero where the prior is flat."""
        if self.prior is None:
            return np.zeros(len(u))
        transform = self.transform
        return self.prior.log_density(transform.natural(u)) + transform.log_jacobian(u)


@dataclass(frozen=True)
class Frame:
    """Outputs, runs, samples and priors of a problem, for its error model.

    Parameters
    ----------
    outputs, runs : tuple of str
        ``s`` channels, ``N`` runs.
    counts : ndarray of int, shape (N, s)
        Samples.
    samples : tuple of RunSamples, length N, or None
        Times of the samples, if the problem gives them.
    log_variance_prior : mapping of str to Prior
        Prior of the logarithm of an output's variance where it is not flat.
    signatures : Signatures or None
        Of the effects that the model might lack, if they are known.
    effective : ndarray, shape (N, s), or None
        Effective number of independent samples, if it is known.
    stretch : Stretch or None
        To the covariance of the estimate by the spectra of the noise, if it is known.
    """

    outputs: tuple[str, ...]
    runs: tuple[str, ...]
    counts: Int[Integers, "runs outputs"]
    samples: tuple[RunSamples, ...] | None
    log_variance_prior: Mapping[str, Prior]
    signatures: Signatures | None = None
    effective: Array | None = None
    stretch: Stretch | None = None

    @classmethod
    def of(cls, problem: Measured, log_variance_prior: Mapping[str, Prior] | None = None) -> Frame:
        """Frame of a problem; without residuals by sample it suits models that need sums only."""
        samples = getattr(problem, "samples", None)
        return cls(
            tuple(problem.outputs),
            tuple(problem.runs),
            np.asarray(problem.counts),
            None if samples is None else tuple(samples),
            dict(log_variance_prior or {}),
            getattr(problem, "signatures", None),
            getattr(problem, "effective", None),
            getattr(problem, "stretch", None),
        )

    def log_variances(self) -> tuple[Quantity, ...]:
        """One logarithm of a variance for each output."""
        return tuple(
            Quantity(
                schema.log_variance(output),
                prior=self.log_variance_prior.get(output),
                unit="ln(({})^2)",
                long_name=f"logarithm of the error variance of {output}",
            )
            for output in self.outputs
        )

    def shares(self, name: Callable[[str], str], text: str) -> tuple[Quantity, ...]:
        """One share for each output, uniform from 0 to 1; ``text`` describes it, with ``{}``."""
        return tuple(
            Quantity(
                name(output), 0.0, 1.0, Uniform(0.0, 1.0), share=True, long_name=text.format(output)
            )
            for output in self.outputs
        )

    def lengths(
        self, name: Callable[[str], str], prior: Prior, unit: str, text: str
    ) -> tuple[Quantity, ...]:
        """One positive time or length for each output; ``text`` describes it, with ``{}``."""
        return tuple(
            Quantity(name(output), 0.0, prior=prior, unit=unit, long_name=text.format(output))
            for output in self.outputs
        )

    def sampled(self) -> tuple[RunSamples, ...]:
        """When the samples were taken.

        Raises
        ------
        InputError
            If the problem does not give them.
        """
        if self.samples is None:
            raise InputError(
                "this problem gives sums of squares only, the error model needs its residuals",
                key="error_model",
                hint='use error_model="independent", or give the problem "samples" and "residuals"',
            )
        return self.samples


class ErrorModel(ABC):
    """Density of residuals given ``m`` quantities; bound to the outputs and runs of one problem.

    Parameters
    ----------
    frame : Frame
        Of the problem.

    Attributes
    ----------
    word : str
        Name by which it is chosen.
    by_sums : bool
        Whether sums of squares by run and output suffice.
    over_runs : bool
        Whether runs share errors, so that :meth:`of_runs` needs all of them at once.
    data_points : str
        Data on which a block's log density is conditional, in words, for results.
    quantities : tuple of Quantity, length m
        The first ``s`` are the logarithms of the outputs' total variances.
    """

    word: ClassVar[str]
    by_sums: ClassVar[bool] = False
    over_runs: ClassVar[bool] = False
    data_points: ClassVar[str] = "one period of one run; independent of the others"

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.quantities = self._declare()

    @abstractmethod
    def _declare(self) -> tuple[Quantity, ...]:
        """Quantities, those of the variances first."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``m`` quantities."""
        return tuple(quantity.name for quantity in self.quantities)

    def natural(self, eta: Array) -> Array:
        """Quantities in their units from coordinates, both of shape (W, m)."""
        return self._by_column(eta, "natural")

    def coordinates(self, natural: Array) -> Array:
        """Coordinates of quantities in their units, both of shape (W, m)."""
        return self._by_column(natural, "unbounded")

    def _by_column(self, values: Array, what: str) -> Array:
        # Contiguous columns: NumPy may round a function of a strided array differently.
        out = np.empty(np.shape(values))
        for k, quantity in enumerate(self.quantities):
            column = np.ascontiguousarray(values[:, k], dtype=float)
            out[:, k] = getattr(quantity.transform, what)(column)
        return out

    def log_prior(self, eta: Array) -> Array:
        """Log prior density of the coordinates, shape (W,), from shape (W, m)."""
        total = np.zeros(len(eta))
        for k, quantity in enumerate(self.quantities):
            total += quantity.log_prior(np.ascontiguousarray(eta[:, k]))
        return total

    def sample_prior(self, rng: np.random.Generator, size: int) -> dict[str, Array]:
        """Draws of the quantities that have a proper prior, each of shape (size,)."""
        return {q.name: q.prior.sample(rng, size) for q in self.quantities if q.prior is not None}

    def moved(self, theta: Array) -> Array:
        """Where the problem's residuals are taken for unknowns (L, l): there, unless a model says
        otherwise."""
        return theta

    def slope(self, theta: Array) -> Array:
        """Derivatives of that place with respect to theta (l,), shape (l, l)."""
        return np.eye(len(theta))

    def of_sums(self, sums: Array, eta: Array) -> Array:
        """Normalised log-likelihood by run, shape (L, N), of sums (L, N, s); eta (L, m)."""
        raise NotImplementedError(f"{self.word} needs residuals")

    def of_run(self, run: int, residual: Array, eta: Array) -> Array:
        """Normalised log-likelihood of one run, shape (L,).

        Parameters
        ----------
        run : int
            Which one.
        residual : ndarray, shape (L, s, n)
            ``y - yhat`` of ``L`` parameter vectors.
        eta : ndarray, shape (L, m)
            Coordinates.
        """
        raise NotImplementedError(f"{self.word} needs sums only")

    def of_runs(self, residuals: Sequence[Array], eta: Array) -> Array:
        """Normalised log-likelihoods of runs, shape (L, N), whose sum is the joint one.

        Each is that of a run given those before it, unless a model says otherwise.

        Parameters
        ----------
        residuals : sequence over runs of ndarray, shape (L, s, n)
            ``y - yhat`` of ``L`` parameter vectors.
        eta : ndarray, shape (L, m)
            Coordinates.
        """
        return np.stack([self.of_run(r, e, eta) for r, e in enumerate(residuals)], axis=1)

    def of_blocks(
        self, residuals: Sequence[Array], eta: Array, starts: Sequence[Integers]
    ) -> list[Array]:
        """Log density of blocks of samples, given those before; their sum is the joint one.

        Parameters
        ----------
        residuals : sequence over runs of ndarray, shape (L, s, n)
            ``y - yhat`` of ``L`` parameter vectors.
        eta : ndarray, shape (L, m)
            Coordinates.
        starts : sequence over runs of ndarray of int, shape (B,)
            First sample of each block.

        Returns
        -------
        list over runs of ndarray, shape (L, s, B)
            Of an output given the outputs before it where these are correlated.
        """
        parts = zip(residuals, starts, strict=True)
        return [self.blocks_of_run(run, e, eta, first) for run, (e, first) in enumerate(parts)]

    def blocks_of_run(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        """The same of one run, shape (L, s, B), where runs are independent of each other."""
        raise NotImplementedError(f"{self.word} needs all runs at once")

    @abstractmethod
    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        """``C V^-1 C'`` of one run.

        Parameters
        ----------
        run : int
            Which one.
        columns : sequence over outputs of ndarray, shape (k, n)
            Rows ``C``.
        eta : ndarray, shape (m,)
            Coordinates.

        Returns
        -------
        ndarray, shape (k, k)
        """

    def products_of_all(self, columns: Sequence[Sequence[Array]], eta: Array) -> Array:
        """``C V^-1 C'`` over all runs, shape (k, k).

        Parameters
        ----------
        columns : sequence over runs of sequence over outputs of ndarray, shape (k, n)
            Rows ``C``.
        eta : ndarray, shape (m,)
            Coordinates.
        """
        return np.asarray(sum(self.products(run, rows, eta) for run, rows in enumerate(columns)))

    @abstractmethod
    def start(self, residuals: Sequence[Array]) -> Array:
        """Likely coordinates, shape (m,), given residuals (s, n) of each run."""

    def scales(self) -> Array:
        """Rough standard deviations of the coordinates, shape (m,): a scale for Newton's method."""
        outputs = len(self.frame.outputs)
        sd = np.full(len(self.quantities), _LOG_VARIANCE_SD)
        sd[:outputs] = np.sqrt(2.0 / self.frame.counts.sum(axis=0))
        return sd

    def variance(self, natural: Array, run: str) -> Array:
        """Total variances of the outputs in a run, shape (W, s), from quantities (W, m).

        A label that is not among the problem's denotes a new run.
        """
        return np.exp(natural[:, : len(self.frame.outputs)])

    def common(
        self, residuals: Sequence[Array], eta: Array, rng: np.random.Generator
    ) -> Array | None:
        """Draw what all runs have in common given the fitted residuals; None if they have nothing.

        Parameters
        ----------
        residuals : sequence over runs of ndarray, shape (W, s, n)
            ``y - yhat`` of ``W`` parameter vectors.
        eta : ndarray, shape (W, m)
            Coordinates.
        rng : numpy.random.Generator

        Returns
        -------
        ndarray, shape (W, c), or None
            For :meth:`draw`.
        """
        return None

    def draw(
        self,
        natural: Array,
        run: str,
        samples: RunSamples,
        rng: np.random.Generator,
        common: Array | None = None,
    ) -> Array:
        """Draw errors of a repetition of a run.

        Parameters
        ----------
        natural : ndarray, shape (W, m)
            Quantities in their units.
        run : str
            Label of the run; one that is not among the problem's is a new run.
        samples : RunSamples
            Times of the ``n`` samples, which need not be those of the problem's run.
        rng : numpy.random.Generator
        common : ndarray, shape (W, c), optional
            Of :meth:`common`; by default drawn anew.

        Returns
        -------
        ndarray, shape (W, s, n)
            White here, with :meth:`variance`.
        """
        sd = np.sqrt(self.variance(natural, run))
        return sd[:, :, None] * rng.standard_normal((*sd.shape, samples.time.size))


@dataclass(frozen=True)
class ProfiledErrorModel(ABC):
    """Covariance of the ``s`` outputs' errors, which point estimators eliminate in each iteration.

    For residuals ``e`` it gives the covariance ``V`` that maximises the objective at fixed
    parameters (the staged elimination), their likelihood given ``V``, and the rows of a
    least-squares problem that result from whitening by ``V``. A diagonal ``V`` is kept as (s,).

    References
    ----------
    Verbeek (1993), eqs. 2.25-2.35 for the models, 3.17 and 3.18 for the staging; Bard (1974),
    *Nonlinear Parameter Estimation*, section 4-9, for the determinant criterion.
    """

    def check(self, counts: Integers) -> None:
        """Raise an :class:`InputError` if samples by run and output, (N, s), do not suit."""
        return

    @abstractmethod
    def moments(self, evaluation: Residuals) -> Array:
        """Moments of the residuals that determine the likelihood."""

    @abstractmethod
    def stage(self, moments: Array, counts: Integers, unknowns: int, bias_corrected: bool) -> Array:
        """``V`` that maximises the objective at fixed parameters, (s,) or (s, s)."""

    @abstractmethod
    def log_likelihood(self, moments: Array, covariance: Array, counts: Integers) -> float:
        """Logarithm of the likelihood with ``V`` held."""

    @abstractmethod
    def rows(self, evaluation: Residuals, unit: Array, covariance: Array) -> tuple[Array, Array]:
        """Whitened rows ``J`` (k, l) in unknowns of size ``unit``, and ``e`` (k,)."""

    @abstractmethod
    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        """``V^-1 e`` of each output."""

    def eliminated(
        self, evaluation: Residuals, unit: Array, covariance: Array, counts: Integers
    ) -> Array:
        """Schur complement ``H_tv H_vv^-1 H_vt`` (l, l) that eliminating ``V`` subtracts.

        References
        ----------
        Verbeek (1993), Appendix A.
        """
        return np.zeros((unit.size, unit.size))


def normal_blocks(white: Array, log_sd: Array, starts: Integers) -> Array:
    """Log density of blocks of whitened samples.

    Parameters
    ----------
    white : ndarray, shape (L, s, n)
        Whitened samples: independent, of unit variance. Their squares take their place.
    log_sd : ndarray, shape (L, s)
        Logarithm of the standard deviation by which they were divided.
    starts : ndarray of int, shape (B,)
        First sample of each block.

    Returns
    -------
    ndarray, shape (L, s, B)
    """
    sizes = np.diff(starts, append=white.shape[2])
    squares = np.add.reduceat(np.multiply(white, white, out=white), starts, axis=2)
    return np.asarray(-0.5 * squares - sizes * (log_sd[:, :, None] + 0.5 * np.log(2 * np.pi)))


def log_mean_squares(residuals: Sequence[Array]) -> Array:
    """Logarithms of the outputs' mean squares over all runs, shape (s,), from (s, n) of each.

    References
    ----------
    Verbeek (1993), eq. 3.17.
    """
    squares = np.sum([np.sum(e * e, axis=1) for e in residuals], axis=0)
    count = sum(e.shape[1] for e in residuals)
    return cast(Array, np.log(np.maximum(squares / count, np.finfo(float).tiny)))
