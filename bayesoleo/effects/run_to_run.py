"""What changes from run to run though the model takes it as constant."""

from __future__ import annotations

from collections.abc import Sequence

from bayesoleo.effects.effect import BY_RUN, Effect, Names
from bayesoleo.effects.parts import Amplitude
from bayesoleo.effects.places import substitute
from bayesoleo.effects.unnamed import COEFFICIENT
from bayesoleo.model import Model
from bayesoleo.model.expressions import symbol


def _shared(model: Model) -> Sequence[str]:
    """Estimated parameters that all runs share, but for constants known to a tolerance: these are
    the same in all runs. A curve's coefficients mean nothing alone."""
    free = {n: item for n, item in model.parameters.items() if not item.fixed}
    shared = {n: item for n, item in free.items() if not item.by_run}
    return tuple(n for n, item in shared.items() if not item.description.startswith(COEFFICIENT))


def _vary(model: Model, target: str, names: Names) -> Model:
    shared = symbol(target)
    return substitute(model, {shared: shared + names["varies_by_run"]})


# The deviations and the shared value are determined up to a constant only; the priors of the
# deviations, centred on zero, decide it.
VARIES = Effect(
    id="varies_by_run",
    family="run-to-run",
    title="A parameter that differs from run to run",
    formula=r"\theta + \delta_r",
    amplitudes=(
        Amplitude(
            "varies_by_run",
            "parameter",
            r"\delta_r",
            "deviation from the shared value",
            by_run=True,
        ),
    ),
    places=_shared,
    change=_vary,
    source=BY_RUN,
    applies_to="estimated parameters",
    own_name_per_target=True,
)

EFFECTS = (VARIES,)
