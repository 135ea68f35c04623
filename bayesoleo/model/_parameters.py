"""Parameters, dofs, conditions and outputs: the parts from which a model is declared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from bayesoleo.errors import ModelError, check_number
from bayesoleo.model._expressions import derivative_symbol, split_derivative
from bayesoleo.model._priors import Normal, Prior, TruncatedNormal, Uniform


@dataclass(frozen=True)
class Parameter:
    """A constant of the model, estimated or fixed.

    Parameters
    ----------
    value : float
        Nominal value in ``unit``; where an estimate starts.
    unit : str
        SI unit, as pint reads it; empty for a number.
    sd : float, optional
        Standard deviation of a normal prior about ``value``; with ``bounds``, a truncated normal.
    relative_sd : float, optional
        The same over ``value``: the thesis's "sigma = 0.1 theta" is ``relative_sd=0.1``.
    bounds : tuple of float, optional
        Lowest and highest admissible value; alone it means a uniform prior.
    prior : Prior, optional
        Any other prior, instead of ``sd``, ``relative_sd`` and ``bounds``.
    fixed : bool
        Not estimated: keeps ``value``. With a prior it is a constant known to that tolerance, and
        an unknown like a nuisance parameter: the prior is a measurement that every estimator and
        the posterior count.
    by_run : bool
        One independent value for every run.
    nuisance : bool
        Its prior is a measurement and counts in every estimator: a sensor's offset within its
        accuracy, the error of a condition.
    description : str
        What it is, for reports.
    latex : str, optional
        How it is typeset.

    Raises
    ------
    ModelError
        If the start lies outside the bounds or the prior is stated twice.
    """

    value: float
    unit: str = ""
    sd: float | None = None
    relative_sd: float | None = None
    bounds: tuple[float, float] | None = None
    prior: Prior | None = None
    fixed: bool = False
    by_run: bool = False
    description: str = ""
    latex: str | None = None
    nuisance: bool = False

    def __post_init__(self) -> None:
        self._check_numbers()
        if not np.isfinite(self.value):
            raise ModelError("a parameter needs a finite value", value=self.value)
        stated = [self.sd is not None, self.relative_sd is not None, self.prior is not None]
        if sum(stated) > 1:
            raise ModelError("prior stated twice", hint="give one of sd, relative_sd, prior")
        if self.prior is None:
            object.__setattr__(self, "prior", self._stated_prior())
        # The prior is what counts from here on; a copy with another value keeps it.
        for name in ("sd", "relative_sd", "bounds"):
            object.__setattr__(self, name, None)
        if self.prior is not None:
            low, high = self.prior.support
            if not low <= self.value <= high:
                raise ModelError(
                    "the bounds exclude the start",
                    value=self.value,
                    hint=f"choose a value between {low:g} and {high:g}, or wider bounds",
                )

    def _check_numbers(self) -> None:
        """Refuse what is no number or prior before it fails somewhere else."""
        hint = 'write numbers and the unit by itself: bo.Parameter(1200.0, "N/m", sd=100.0)'
        for name in ("value", "sd", "relative_sd"):
            value = getattr(self, name)
            if value is not None or name == "value":
                check_number(value, name, hint=hint, kind=ModelError)
        if not isinstance(self.unit, str):
            raise ModelError("is not the text of a unit", key="unit", value=self.unit, hint=hint)
        if self.prior is not None and not hasattr(self.prior, "log_density"):
            raise ModelError(
                "is not a prior", key="prior", value=self.prior,
                hint="write bo.model.Normal(mean, sd), Uniform(low, high) or sd=…",
            )  # fmt: skip
        if self.bounds is None:
            return
        pair = "write the lowest and the highest value: bounds=(0.0, 10.0)"
        if not isinstance(self.bounds, Sequence | np.ndarray) or len(self.bounds) != 2:
            raise ModelError("is not a pair", key="bounds", value=self.bounds, hint=pair)
        for bound in self.bounds:
            check_number(bound, "bounds", hint=pair, kind=ModelError)

    @property
    def toleranced(self) -> bool:
        """Whether it is a constant known to a tolerance."""
        return self.fixed and self.prior is not None

    @property
    def measured(self) -> bool:
        """Whether its prior is a measurement, which no estimator may forget."""
        return self.nuisance or self.toleranced

    def _stated_prior(self) -> Prior | None:
        spread = self.sd
        for key, example in (
            ("sd", f"sd={0.1 * abs(self.value) or 1:g}"),
            ("relative_sd", "relative_sd=0.1"),
        ):
            stated = getattr(self, key)
            if stated is not None and not (np.isfinite(stated) and stated > 0):
                raise ModelError(
                    "must be positive: it is the width of a prior",
                    key=key,
                    value=stated,
                    hint=f"write {example}, say, or fixed=True without it for a constant",
                )
        if self.relative_sd is not None:
            spread = self.relative_sd * abs(self.value)
            if spread == 0:
                raise ModelError(
                    "is relative to a value of zero, and so no prior",
                    key="relative_sd",
                    value=self.relative_sd,
                    hint="write sd=…, in the unit of the parameter, instead",
                )
        if spread is None:
            return None if self.bounds is None else Uniform(*self.bounds)
        return (
            Normal(self.value, spread)
            if self.bounds is None
            else TruncatedNormal(self.value, spread, *self.bounds)
        )


def check_start(name: str, parameter: Parameter) -> None:
    """Refuse a start on a limit at which the prior has no density.

    A log-normal parameter that starts at zero has no logarithm, and no estimate leaves there.

    Parameters
    ----------
    name : str
        Of the parameter, for the message.
    parameter : Parameter

    Raises
    ------
    ModelError
        If it starts there.
    """
    prior, value = parameter.prior, parameter.value
    if prior is None or value not in prior.support or np.isfinite(prior.log_density(value)):
        return
    low, high = prior.support
    where = " and ".join(
        [f"above {low:g}"] * bool(np.isfinite(low)) + [f"below {high:g}"] * bool(np.isfinite(high))
    )
    raise ModelError(
        f"parameter {name!r} starts where its prior has no density",
        value=value,
        hint=f"start {where}, say at the prior's mean: Parameter({prior.mean:.6g}, …)",
    )


@dataclass(frozen=True)
class Dof:
    """A degree of freedom.

    Parameters
    ----------
    unit : str
        SI unit.
    guess : str, float or sympy.Expr
        Static value from which a first solution starts; may use parameters and conditions.
    description : str
        What it is.
    initial : str, float or sympy.Expr, optional
        Value with which a transient run starts, over parameters, conditions, channels - as measured
        at the run's first sample, smoothed - and the word ``equilibrium``: the value at rest under
        the first sample's inputs. Periodic runs have no start. By default it is estimated for each
        transient run.
    initial_rate : str, float or sympy.Expr, optional
        The velocity at the start, of a dof of second order; zero where only ``initial`` is given.
    """

    unit: str = ""
    guess: str | float | sp.Expr = 0.0
    description: str = ""
    initial: str | float | sp.Expr | None = None
    initial_rate: str | float | sp.Expr | None = None


@dataclass(frozen=True)
class Condition:
    """A quantity that is known and constant in a run, e.g. the initial pressure.

    Parameters
    ----------
    unit : str
        SI unit.
    default : float, optional
        Used where a run does not state it; without a default a campaign must.
    description : str
        What it is.
    """

    unit: str = ""
    default: float | None = None
    description: str = ""


@dataclass(frozen=True)
class Output:
    """A measured quantity that the model predicts, as a sum of named terms.

    Parameters
    ----------
    terms : str, sympy.Expr or mapping of str to either
        One expression, or its named terms.
    unit : str
        SI unit.
    """

    terms: str | float | sp.Expr | Mapping[str, str | float | sp.Expr]
    unit: str = ""
    description: str = ""


@dataclass(frozen=True)
class Coordinate:
    """A place for a force: a position, its velocity, and the balance to which a term is added.

    Parameters
    ----------
    name : str
        The dof's or the input's name.
    position : sympy.Expr or None
        ``None`` for a velocity of which no dof is the position, as of a free shaft.
    velocity : sympy.Expr or None
        ``None`` for a dof of first order that is no velocity, such as the level of a tank.
    kind : str
        ``equation`` or ``output``: where the balance stands.
    target : str
        Name of that equation or output.
    sign : int
        A resisting force ``f`` enters as ``sign * f``.
    position_name : str
        Name of the position: its own, but that of another dof where the dof is a velocity.
    order : int
        Order of the derivative of ``name`` that is the velocity: 0 where the dof is a velocity.
    """

    name: str
    position: sp.Expr | None
    velocity: sp.Expr | None
    kind: str
    target: str
    sign: int
    position_name: str
    order: int = 1

    @property
    def acceleration(self) -> sp.Expr | None:
        """Rate of the velocity."""
        if self.velocity is None:
            return None
        rates = {}
        for item in self.velocity.free_symbols:
            name, order = split_derivative(item)
            rates[item] = derivative_symbol(name, order + 1)
        return self.velocity.xreplace(rates)
