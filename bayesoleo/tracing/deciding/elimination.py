"""Backward elimination: effects that are no longer worth their unknowns beside the others.

References
----------
Schwarz (1978), Annals of Statistics 6(2), 461-464; Burnham and Anderson (2002), Model Selection
and Multimodel Inference, section 2.5: dispersion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.tracing.deciding.fall import with_error
from bayesoleo.tracing.deciding.refit import compare, inflation_along, quick_fit, schwarz_price
from bayesoleo.tracing.deciding.state import State, fit_state
from bayesoleo.tracing.fitting.assembly import AddedEffect
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import Roles
from bayesoleo.tracing.scoring.base import Base
from bayesoleo.tracing.scoring.projection import squared_distance


@dataclass(frozen=True)
class Loss:
    """What is lost without one effect, everything else estimated anew.

    Parameters
    ----------
    step : AddedEffect
        The effect.
    rise : float
        Of the weighted sum of squares on the fitted runs.
    size : int
        Unknowns that leave with it.
    scale : float
        Variance of the samples' noise along what the effect changes, over that of white noise,
        times the dispersion of what the model leaves.
    price : float
        What one unknown must be worth, in units of the scale.
    """

    step: AddedEffect
    rise: float
    size: int
    scale: float
    price: float

    @property
    def worth(self) -> float:
        """Rise beyond the price of the unknowns, in units of the scale; NaN is never below."""
        return self.rise / self.scale - self.price * self.size

    def __str__(self) -> str:
        error = float(np.sqrt(self.scale * (4.0 * max(self.rise, 0.0) + 2.0 * self.size)))
        unknowns = "its unknown is" if self.size == 1 else f"its {self.size} unknowns are"
        return (
            f"without it the weighted squared error on fitted runs rises by"
            f" {with_error(self.rise, error)}, and {unknowns} worth"
            f" {self.price * self.size * self.scale:.3g} (Schwarz 1978)"
        )


def eliminated(
    state: State, roles: Roles, numerics: Numerics, notes: list[str], callback: ProgressCallback
) -> State:
    """The state without effects that the last one made superfluous.

    Each earlier effect is left out in turn and everything else estimated anew; the one that is
    missed least goes first, as long as one is not worth its unknowns.

    Parameters
    ----------
    state : State
        With an effect just added.
    roles : Roles
    numerics : Numerics
    notes : list of str
        Told what was taken out, and why.
    callback : callable
        Told what is being done.
    """
    while len(state.assembly.steps) > 1:
        base = state.base()
        earlier = state.assembly.steps[:-1]
        doubted = [step for step in earlier if not plainly_needed(state, base, step)]
        if not doubted:
            return state
        callback("look whether the earlier effects are still needed")
        losses = [loss_without(state, base, step, numerics) for step in doubted]
        least = min(losses, key=lambda loss: loss.worth if np.isfinite(loss.worth) else np.inf)
        if not least.worth < 0.0:
            return state
        effect = least.step.effect.id
        callback(f"remove {effect}: {least}")
        notes.append(f"{effect} was removed again, a later effect made it superfluous: {least}")
        state = fit_state(state.assembly.without(least.step), roles, numerics, progress=callback)
    return state


def plainly_needed(state: State, base: Base, step: AddedEffect) -> bool:
    """Whether an effect's amplitudes are so far from their null that no fit without it is asked
    for: by Wald's statistic, which is smaller than the fall of the sum of squares where they differ
    by much (Hauck and Donner 1977, JASA 72, 851-853)."""
    point, names = state.fit.point, state.fit.problem.names
    index = [k for k, name in enumerate(names) if name.split("[")[0] in step.amplitudes]
    covariance = point.covariance[np.ix_(index, index)]
    if not index or not point.status.ok or not np.isfinite(covariance).all():
        return False
    distance = squared_distance(point.theta[index], covariance)
    return bool(distance > base.policy.plainly_needed * schwarz_price(base) * len(index))


def loss_without(state: State, base: Base, step: AddedEffect, numerics: Numerics) -> Loss:
    """What is lost without one effect of a model, everything else estimated anew."""
    without = state.assembly.without(step).model()
    fit = quick_fit(base, without, base.fit.values, numerics)
    share, changes = compare(base, fit)
    names = [n for n in base.fit.problem.names if n not in fit.problem.names]
    measured = inflation_along(base, base.fit, names, changes)
    # The logarithm is of as many samples as would say the same independently.
    scale = (measured or (1.0, 0))[0] * dispersion(base)
    price = max(schwarz_price(base) - float(np.log(scale)), 1.0)
    return Loss(step, -share * base.fall_back, len(names), scale, price)


def dispersion(base: Base) -> float:
    """Mean square of what a model leaves of periodic runs over that of the noise, at least one; of
    transients the inflation is measured on all that is left."""
    if not all(record.periodic for record in base.fit.records) or not base.excess > base.feigned:
        return 1.0
    return 1.0 + base.excess / max(base.noise, 1e-300)
