"""A small oleo campaign, simulated: what calibration repeats, and effects that nobody declares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bayesoleo import Model, system
from bayesoleo.effects import Scales, find_effect
from bayesoleo.estimation import CampaignProblem
from bayesoleo.model import LogNormal, Normal, driven_by, sample_of
from bayesoleo.prediction import Predictor, RunPlan, motion, record_of
from bayesoleo.systems import SHAKER_RUNS

Array = NDArray[np.float64]

#: Slow and fast runs of the middle and the low group: away from full compression, where a gas
#: volume drawn from its prior might not suffice.
RUNS = ("g", "h", "i", "l")
PERIODS, PER_PERIOD, STEPS = 2, 100, 96
#: Parameters that are estimated.
PARAMETERS = 7
#: Noise of a sample, SI.
NOISE = {"force": 20.0, "pressure": 4000.0}
#: Standard deviations of the priors over their values.
SPREAD = {"piston_area": 0.03, "initial_volume": 0.03}
OTHERS = 0.3
#: Undeclared effects: where each sits, and the parameters that mean something else beside it.
EFFECTS: Mapping[str, tuple[str, ...]] = {
    "direction_dependent_damping": (),
    "linear_stiffness": (),
    "stribeck_friction": ("friction_base", "friction_slope"),
    "wall_heat_capacity": ("heat_conduction",),
}
#: Size of an effect: rms of what it changes, over the noise, in the output that shows it most.
#: Drawn uniformly in its logarithm.
SIZES = (0.5, 4.0)
_SCALES = Scales(
    {"stroke": (0.0, 0.25), "displacement": (0.0, 0.25)},
    {"stroke": 0.15, "displacement": 0.15},
    {"force": 1e4, "pressure": 3e6},
    1.0,
    5.0,
)


def oleo() -> Model:
    """``f16n2d2`` with the priors from which truths are drawn."""
    model = system("f16n2d2")
    changed = {}
    for name in model.estimated():
        item = model.parameters[name]
        sd = abs(item.value) * SPREAD.get(name, OTHERS)
        prior = LogNormal(item.value, OTHERS) if name == "friction_slope" else None
        changed[name] = replace(item, prior=prior or Normal(item.value, sd))
    return model.with_parameters(**changed)


@dataclass(frozen=True)
class Simulator:
    """Predictions of a model on the campaign's runs, without noise.

    Parameters
    ----------
    problem : CampaignProblem
        Whose data are zero.
    """

    problem: CampaignProblem

    @classmethod
    def of(cls, model: Model) -> Simulator:
        """Of a model in its own drive."""
        driven = driven_by(model, "displacement")
        records = [record_of(driven, _plan(label)) for label in RUNS]
        return cls(CampaignProblem(Predictor(driven, records, steps=STEPS, jobs=1)))

    def outputs(self, theta: Array) -> tuple[Array, ...] | None:
        """Each output, runs one after the other; None where a run has no answer."""
        self.problem.freeze(self.problem.start)
        parts = []
        for run in range(len(RUNS)):
            residual, status = self.problem.residuals(theta[None], run)
            if status[0] != 0:
                return None
            parts.append(-residual[0])
        return tuple(np.concatenate(parts, axis=1))


def _plan(label: str) -> RunPlan:
    run = next(item for item in SHAKER_RUNS if item.label == label)
    return RunPlan(
        label,
        run.frequency,
        {"displacement": motion(run.position, [run.amplitude])},
        periods=PERIODS,
        samples_per_period=PER_PERIOD,
    )


@cache
def declared() -> Simulator:
    """The model that is fitted."""
    return Simulator.of(oleo())


@cache
def extended(effect: str) -> Simulator:
    """The model with an effect that is not declared."""
    model, found = oleo(), find_effect(effect)
    return Simulator.of(found.extend(model, found.places(model)[0], _SCALES).model)


def generator(seed: int, number: int) -> np.random.Generator:
    """All that is random in a replication."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))


def drawn(rng: np.random.Generator) -> tuple[Array, tuple[Array, ...]]:
    """Parameters from their prior that have an answer, and the outputs."""
    simulator = declared()
    while True:
        theta = sample_of(simulator.problem.priors, rng, 1)[0]
        outputs = simulator.outputs(theta)
        if outputs is not None:
            return theta, outputs


def noisy(outputs: tuple[Array, ...], sd: Mapping[str, float], rng: np.random.Generator):
    """With white noise."""
    names = declared().problem.outputs
    return tuple(
        y + sd[name] * rng.standard_normal(y.size) for name, y in zip(names, outputs, strict=True)
    )


def with_effect(
    effect: str, theta: Array, size: float, rng: np.random.Generator
) -> tuple[Array, ...] | None:
    """Outputs with an effect of a size; its shape, if it has one, is drawn from its scan's range.

    None where a run has no answer.
    """
    simulator = extended(effect)
    problem, base = simulator.problem, declared().problem
    full = problem.start.copy()
    for name, value in zip(base.names, theta, strict=True):
        full[problem.names.index(name)] = value
    new = [k for k, name in enumerate(problem.names) if name not in base.names]
    amplitude = next(k for k in new if full[k] == 0.0)
    for k in new:
        if k != amplitude:
            full[k] *= np.exp(rng.uniform(-0.5, 0.5))
    plain = simulator.outputs(full)
    if plain is None:
        return None
    # Secant steps: what changes is nearly proportional to the amplitude.
    full[amplitude] = 1e-3 * max(problem.priors[amplitude].sd, 1e-6)
    for _ in range(4):
        found = simulator.outputs(full)
        if found is None:
            return None
        full[amplitude] *= size / _rms(found, plain)
    return simulator.outputs(full)


def _rms(found: tuple[Array, ...], plain: tuple[Array, ...]) -> float:
    """Change over the noise, of the output that shows it most."""
    pairs = zip(found, plain, NOISE.values(), strict=True)
    return float(max(np.sqrt(np.mean((a - b) ** 2)) / sd for a, b, sd in pairs))
