"""Backward elimination: effects that are no longer worth their unknowns beside the others.

References
----------
Schwarz (1978), Annals of Statistics 6(2), 461-464; Burnham and Anderson (2002), Model Selection
and Multimodel Inference, section 2.5: dispersion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesoleo.tracing.deciding.fall import with_error
from bayesoleo.tracing.deciding.refit import compare, inflation_along, quick_fit, schwarz_price
from bayesoleo.tracing.deciding.state import State, fit_state
from bayesoleo.tracing.fitting.assembly import Step
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import Roles
from bayesoleo.tracing.scoring.base import Base

Say = Callable[[str], None]


@dataclass(frozen=True)
class Loss:
    """What is lost without one effect, everything else estimated anew.

    Parameters
    ----------
    step : Step
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

    step: Step
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


def eliminated(state: State, roles: Roles, numerics: Numerics, notes: list[str], say: Say) -> State:
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
    say : callable
        Told what is being done.
    """
    while len(state.assembly.steps) > 1:
        say("look whether the earlier effects are still needed")
        base = state.base()
        losses = [loss_without(state, base, step, numerics) for step in state.assembly.steps[:-1]]
        least = min(losses, key=lambda loss: loss.worth if np.isfinite(loss.worth) else np.inf)
        if not least.worth < 0.0:
            return state
        effect = least.step.effect.id
        say(f"remove {effect}: {least}")
        notes.append(f"{effect} was removed again, a later effect made it superfluous: {least}")
        state = fit_state(state.assembly.without(least.step), roles, numerics, progress=say)
    return state


def loss_without(state: State, base: Base, step: Step, numerics: Numerics) -> Loss:
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
