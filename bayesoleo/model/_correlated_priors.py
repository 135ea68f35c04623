"""Joint normal priors over several parameters, and priors from an earlier result.

The result of an earlier campaign is not one interval for each parameter. Its posterior may
determine a product of two parameters far better than either, and a prior without their correlation
loses that information. Here the earlier posterior, condensed to mean and covariance, is the joint
prior of several parameters. Each carries a :class:`Correlated` prior, which alone is its marginal;
the priors of all of them together give the joint density.

References
----------
Verbeek (1993), section 2.2.4: the condensed posterior of an earlier experiment as prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._types import Array
from bayesoleo.errors import ModelError
from bayesoleo.model._model import Model
from bayesoleo.model._priors import Normal, Prior, TruncatedNormal

# Eigenvalues of the correlation matrix below this are rounding, not information.
_SINGULAR = 1e-12
# Draws outside the bounds are drawn again at most so often; then they are put on the bound.
_REDRAWS = 100


@dataclass(frozen=True)
class JointNormal:
    """Normal density over the parameters of these names, cut off at bounds where there are any.

    The density is that of the whole normal: what the bounds cut off is left out of its integral,
    which no estimate and no posterior depends on.

    Parameters
    ----------
    names : tuple of str, length k
    mean : tuple of float, length k
        In the parameters' units.
    covariance : tuple of tuple of float, k rows of length k
    low, high : tuple of float, length k, optional
        Bounds; by default none.

    Raises
    ------
    ModelError
        If lengths disagree, a number is not finite, or the covariance is not positive definite.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        size = len(self.names)
        object.__setattr__(self, "low", self.low or (-np.inf,) * size)
        object.__setattr__(self, "high", self.high or (np.inf,) * size)
        sizes = {len(self.mean), len(self.covariance), len(self.low), len(self.high)}
        if size == 0 or sizes | {len(row) for row in self.covariance} != {size}:
            raise ModelError("names, mean and covariance of a joint prior disagree", value=size)
        matrix, sd = np.array(self.covariance), np.sqrt(np.abs(np.diag(self.covariance)))
        if not (np.isfinite(matrix).all() and np.isfinite(self.mean).all() and (sd > 0).all()):
            raise ModelError("joint prior needs finite numbers and positive variances")
        correlation = matrix / np.outer(sd, sd)
        if np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] <= _SINGULAR:
            raise ModelError(
                "the covariance of a joint prior must be positive definite",
                hint="leave out a parameter that follows from the others",
            )

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        mean: ArrayLike,
        covariance: ArrayLike,
        bounds: Sequence[tuple[float, float]] | None = None,
    ) -> JointNormal:
        """From arrays of shape (k,) and (k, k)."""
        rows = tuple(tuple(float(value) for value in row) for row in np.asarray(covariance))
        centre = tuple(float(value) for value in np.asarray(mean))
        if bounds is None:
            return cls(tuple(names), centre, rows)
        low, high = zip(*((float(a), float(b)) for a, b in bounds), strict=True)
        return cls(tuple(names), centre, rows, low, high)

    @classmethod
    def from_draws(cls, names: Sequence[str], draws: ArrayLike) -> JointNormal:
        """Condense draws, shape (m, k), to their mean and covariance."""
        values = np.asarray(draws, dtype=float)
        return cls.of(names, values.mean(axis=0), np.atleast_2d(np.cov(values, rowvar=False)))

    def prior(self, name: str) -> Correlated:
        """Prior of one of the parameters; all of them together are the joint one."""
        if name not in self.names:
            raise ModelError(
                "not in the joint prior", key=name, hint=f"it has {', '.join(self.names)}"
            )
        return Correlated(name, self)

    def widened(self, factor: float) -> JointNormal:
        """With all standard deviations multiplied, where another campaign is only alike."""
        if not factor > 0:
            raise ModelError("a prior is widened by a positive factor", value=factor)
        rows = factor**2 * np.array(self.covariance)
        bounds = list(zip(self.low, self.high, strict=True))
        return JointNormal.of(self.names, self.mean, rows, bounds)

    def precision_root(self, members: Sequence[int]) -> Array:
        """Upper triangle ``P`` with ``P'P`` the precision of the members' marginal, (m, m)."""
        block = np.array(self.covariance)[np.ix_(members, members)]
        return np.asarray(np.linalg.cholesky(np.linalg.inv(block)).T)

    def log_density(self, members: Sequence[int], columns: Sequence[Array]) -> Array:
        """Log density of some of the parameters, each a column of shape (L,).

        Each row's value depends on that row alone, bit for bit: sums run over columns.
        """
        root = self.precision_root(members)
        away = [c - self.mean[m] for m, c in zip(members, columns, strict=True)]
        total = np.full(np.shape(columns[0]), float(np.sum(np.log(np.diag(root)))))
        total -= 0.5 * len(members) * np.log(2 * np.pi)
        with np.errstate(over="ignore", invalid="ignore"):
            for i in range(len(members)):
                row = np.zeros_like(total)
                for j in range(i, len(members)):
                    row += root[i, j] * away[j]
                total -= 0.5 * row * row
        for m, column in zip(members, columns, strict=True):
            total[(column < self.low[m]) | (column > self.high[m])] = -np.inf
        return total

    def sample(self, rng: np.random.Generator, size: int, members: Sequence[int]) -> Array:
        """Draws of some of the parameters, shape (size, m)."""
        block = np.array(self.covariance)[np.ix_(members, members)]
        factor = np.linalg.cholesky(block)
        centre, low, high = (np.array(v)[list(members)] for v in (self.mean, self.low, self.high))
        draws = centre + rng.standard_normal((size, len(members))) @ factor.T
        for _ in range(_REDRAWS):
            outside = ((draws < low) | (draws > high)).any(axis=1)
            if not outside.any():
                return draws
            fresh = rng.standard_normal((int(outside.sum()), len(members)))
            draws[outside] = centre + fresh @ factor.T
        return np.clip(draws, low, high)


@dataclass(frozen=True)
class Correlated:
    """One parameter of a :class:`JointNormal`; alone it is the marginal."""

    name: str
    joint: JointNormal

    @cached_property
    def index(self) -> int:
        """Place in the joint prior."""
        return self.joint.names.index(self.name)

    @cached_property
    def marginal(self) -> Normal | TruncatedNormal:
        """Prior of this parameter when nothing is known of the others."""
        k = self.index
        centre, sd = self.joint.mean[k], float(np.sqrt(self.joint.covariance[k][k]))
        low, high = self.joint.low[k], self.joint.high[k]
        if np.isinf(low) and np.isinf(high):
            return Normal(centre, sd)
        return TruncatedNormal(centre, sd, low, high)

    @property
    def mean(self) -> float:
        return self.joint.mean[self.index]

    @property
    def sd(self) -> float:
        return float(np.sqrt(self.joint.covariance[self.index][self.index]))

    @property
    def support(self) -> tuple[float, float]:
        return self.joint.low[self.index], self.joint.high[self.index]

    def log_density(self, value: ArrayLike) -> Array:
        return self.marginal.log_density(value)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        return self.marginal.sample(rng, size)


def joint_groups(priors: Sequence[Prior]) -> list[tuple[JointNormal, list[int], list[int]]]:
    """Joint priors among the priors of ``l`` unknowns.

    Returns
    -------
    list of tuple
        The joint prior, the positions of its parameters among the unknowns, and in the joint
        prior. A parameter of it that is not among the unknowns is integrated out.
    """
    found: dict[JointNormal, tuple[list[int], list[int]]] = {}
    for position, prior in enumerate(priors):
        if isinstance(prior, Correlated):
            positions, members = found.setdefault(prior.joint, ([], []))
            positions.append(position)
            members.append(prior.index)
    return [(joint, *places) for joint, places in found.items()]


def log_density_of(priors: Sequence[Prior], theta: ArrayLike) -> Array:
    """Log prior density of vectors, shape (L, l); each row's depends on that row alone."""
    # A copy without strides: NumPy may round a function of a strided array differently.
    columns = [np.ascontiguousarray(column) for column in np.asarray(theta, dtype=float).T]
    total = np.zeros(np.shape(theta)[0])
    with np.errstate(invalid="ignore"):
        for prior, column in zip(priors, columns, strict=True):
            if not isinstance(prior, Correlated):
                total += prior.log_density(column)
        for joint, positions, members in joint_groups(priors):
            total += joint.log_density(members, [columns[p] for p in positions])
    return total


def sample_of(priors: Sequence[Prior], rng: np.random.Generator, size: int) -> Array:
    """Draws of all unknowns, shape (size, l)."""
    draws = np.empty((size, len(priors)))
    for position, prior in enumerate(priors):
        if not isinstance(prior, Correlated):
            draws[:, position] = prior.sample(rng, size)
    for joint, positions, members in joint_groups(priors):
        draws[:, positions] = joint.sample(rng, size, members)
    return draws


def scaled_root(priors: Sequence[Prior], sd: Array) -> Array:
    """Rows ``P`` with ``P'P`` the prior's precision where unknowns are in units of ``sd``, (l, l).

    The identity where no prior is joint.
    """
    root = np.eye(len(priors))
    for joint, positions, members in joint_groups(priors):
        root[np.ix_(positions, positions)] = joint.precision_root(members) * sd[positions]
    return root


def with_joint_prior(model: Model, joint: JointNormal) -> Model:
    """The model with this prior of some of its parameters, which start at its mean.

    Parameters
    ----------
    model : Model
    joint : JointNormal
        E.g. ``JointNormal.of(point.names, point.theta, point.covariance)`` after an estimate, or
        ``JointNormal.from_draws(names, draws)`` after sampling.

    Returns
    -------
    Model

    Raises
    ------
    ModelError
        If the model has no such parameter, or has it for each run anew: then what was found in the
        earlier runs says nothing of a new one.

    References
    ----------
    Verbeek (1993), section 2.2.4.
    """
    changed = {}
    for name, centre in zip(joint.names, joint.mean, strict=True):
        if name not in model.parameters:
            raise ModelError(
                "the model has no such parameter",
                key=name,
                hint="use " + ", ".join(model.parameters),
            )
        if model.parameters[name].by_run:
            raise ModelError(
                "a parameter by run has no earlier value", key=name, hint="leave it out"
            )
        changed[name] = replace(
            model.parameters[name], value=centre, prior=joint.prior(name), fixed=False
        )
    return model.with_parameters(**changed)
