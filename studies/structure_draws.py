"""Campaigns that lack what the default prior of structures draws from the whole catalogue.

The declared system, its motion and its noise come from the benchmarks' own simulator. What an
effect changes is computed by the package, at the true parameters and with the true inputs, and
added to what is measured. So every effect can be drawn, near copies of each other too, as often as
the prior says. Its sizes, and how many campaigns lack nothing, one effect, two, or something
outside, are those of the study and not of the prior. Effects whose model takes a measured output
for an input are not drawn.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import truth_effects as truth
from numpy.typing import NDArray
from truth_systems import KINDS, Made, Noise, Plan, make

from bayesoleo.discovery._assembly import Added, Assembly
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score, score_all
from bayesoleo.discovery._structure_comparison import positive_part
from bayesoleo.discovery._structures import StructurePrior
from bayesoleo.errors import BayesoleoError
from bayesoleo.model import Model
from bayesoleo.prediction import Harmonics, RunPlan, motion, simulate_run

Array = NDArray[np.float64]
#: What effects change, by run and channel.
Changes = Mapping[str, Mapping[str, Array]]

#: Steps of a period in simulations of what an effect changes.
STEPS = 1024
#: Tries to come to a size, for effects are not quite linear in their amplitudes.
TRIES = 6
#: Difference of the logarithm of a size at which it is reached, and the largest step of a try.
NEAR, STEP = 0.15, 5.0
#: Harmonics of the inputs.
HARMONICS = 8


class NotShownError(RuntimeError):
    """An effect cannot have the size that was drawn."""


@dataclass(frozen=True)
class Lacking:
    """An effect of the catalogue that a campaign lacks.

    Parameters
    ----------
    score : Score
        At the shapes that were drawn.
    direction : ndarray, shape (k,)
        Of its unknowns, SI, at one detection limit.
    """

    score: Score
    direction: Array

    @property
    def name(self) -> str:
        """Effect and place."""
        return " @ ".join(self.score.option.key)

    def values(self, run: int, size: float) -> dict[str, float]:
        """Values of its parameters in a run, at so many detection limits."""
        names = self.score.option.candidate.parameters
        by_run = self.score.option.model.parameters[names[0]].by_run
        direction = self.direction[run : run + 1] if by_run else self.direction
        return {name: size * float(v) for name, v in zip(names, direction, strict=True)}


def keys_drawn(
    scores: Sequence[Score], inputs: Collection[str], count: int, rng: np.random.Generator
) -> list[Added]:
    """Draw different effects by the default prior, of those that need no input but these."""
    families = {score.option.key: score.option.candidate.family for score in scores}
    weights = StructurePrior().weights(families)
    keys = [score.option.key for score in scores if set(score.option.model.inputs) <= set(inputs)]
    chance = np.array([weights[key] for key in keys])
    chosen = rng.choice(len(keys), size=count, replace=False, p=chance / chance.sum())
    return [keys[k] for k in chosen]


def lacking(base: Base, assembly: Assembly, count: int, rng: np.random.Generator) -> list[Lacking]:
    """Draw effects by the default prior, with their shapes and directions."""
    scores, _ = score_candidates(base, assembly, None, 1)
    found = {score.option.key: score for score in scores}
    keys = keys_drawn(scores, assembly.model().inputs, count, rng)
    return [_shaped(base, found[key], rng) for key in keys]


def _shaped(base: Base, score: Score, rng: np.random.Generator) -> Lacking:
    """One effect: shapes of its scan, signs and directions as the comparison expects them."""
    option, positive = score.option, positive_part(score)
    shapes = {name: (float(rng.choice(grid)),) for name, grid in option.candidate.shapes.items()}
    fixed = replace(option, candidate=replace(option.candidate, shapes=shapes, sign={}, usual={}))
    found, _ = score_all(base, [fixed], 1)
    if not found:
        raise NotShownError(f"{' @ '.join(option.key)} does nothing in its shape")
    (score,) = found
    if len(score.names) == 1:
        direction = np.array([1.0 if rng.uniform() < positive else -1.0])
    else:
        own = np.maximum(np.diag(score.information), 1e-300)
        direction = rng.standard_normal(len(score.names)) / np.sqrt(own)
    length = float(np.sqrt(direction @ score.information @ direction))
    return Lacking(score, direction * truth.LIMIT / length)


@dataclass(frozen=True)
class Simulator:
    """Computes what effects change in the runs of a campaign.

    Parameters
    ----------
    plain : Made
        Without them; its runs are periodic.
    plans : mapping of str to RunPlan
        Its runs, with the true inputs.
    """

    plain: Made
    plans: Mapping[str, RunPlan]

    @classmethod
    def of(cls, plain: Made, plan: Plan) -> Simulator:
        """Of a campaign that was made by a plan."""
        driven = KINDS[plain.kind].system.driven
        plans = {}
        for run in plain.campaign.campaign.runs:
            signal = _harmonics(run.time * run.frequency, plain.clean[run.label][driven])
            plans[run.label] = RunPlan(
                run.label,
                run.frequency,
                {driven: signal},
                periods=plan.periods,
                samples_per_period=plan.per_period,
            )
        return cls(plain, plans)

    def changes(self, effect: Lacking, size: float) -> Changes:
        """What one effect changes at so many detection limits."""
        model, found = effect.score.option.model, {}
        for k, (label, plan) in enumerate(self.plans.items()):
            values = effect.values(k, size)
            nulls = {name: model.parameters[name].value for name in values}
            shown, without = (
                self._samples(model, plan, {**effect.score.shapes, **one})
                for one in (values, nulls)
            )
            found[label] = {name: shown[name] - without[name] for name in self.plain.noise}
        return found

    def _samples(
        self, model: Model, plan: RunPlan, values: Mapping[str, float]
    ) -> Mapping[str, Array]:
        known = {name: v for name, v in self.plain.truth.items() if name in model.parameters}
        found = simulate_run(model, plan, known | dict(values), steps=STEPS, backend="numba")
        return found.samples


def _harmonics(phase: Array, values: Array) -> Harmonics:
    """A signal of a few harmonics from its samples."""
    turn = 2 * np.pi * np.multiply.outer(phase, np.arange(1, HARMONICS + 1))
    columns = np.concatenate([np.ones((phase.size, 1)), np.cos(turn), np.sin(turn)], axis=1)
    mean, *rest = np.linalg.lstsq(columns, values, rcond=None)[0]
    cosines, sines = np.split(np.array(rest), 2)
    return motion(float(mean), list(np.hypot(cosines, sines)), list(np.arctan2(-sines, cosines)))


def drawn(
    kind: str, seed: int, wanted: Array, noise: Noise, rng: np.random.Generator
) -> tuple[Made, list[str], Array]:
    """A campaign that lacks as many effects as there are sizes, their names, and their sizes.

    Parameters
    ----------
    kind : str
        Of system.
    seed : int
    wanted : ndarray, shape (k,)
        Sizes in detection limits, each beside the model and the other effects.
    noise : Noise
    rng : numpy.random.Generator

    Raises
    ------
    NotShownError
        If an effect does not come to its size, or no motion repeats with it.
    """
    plan = truth.FEWER if kind == "two dofs" else truth.PLAN
    plain = make(kind, seed, plan=plan, noise=noise)
    state = truth.fitted(plain)
    base, simulator = state.base(), Simulator.of(plain, plan)
    effects = lacking(base, state.assembly, len(wanted), rng)
    try:
        changes, reached = _sized(base, simulator, effects, wanted)
    except BayesoleoError as error:
        names = " + ".join(effect.name for effect in effects)
        raise NotShownError(f"{names}: {str(error).splitlines()[0]}") from error

    def sensors(label: str, _: Array, values: Mapping[str, Array]) -> Mapping[str, Array]:
        return {
            name: row + sum(change[label].get(name, 0.0) for change in changes)
            for name, row in values.items()
        }

    made = make(kind, seed, plan=plan, noise=noise, sensors=sensors)
    return made, [effect.name for effect in effects], reached


def _sized(
    base: Base, simulator: Simulator, effects: Sequence[Lacking], wanted: Array
) -> tuple[list[Changes], Array]:
    """What effects change at the sizes that are wanted, and their sizes."""
    sizes = wanted
    for _ in range(TRIES):
        changes = [simulator.changes(e, s) for e, s in zip(effects, sizes, strict=True)]
        reached = truth._sizes_of(base, [_in_noise(base, change) for change in changes])
        if np.all(np.abs(np.log(reached / wanted)) < NEAR):
            return changes, reached
        sizes = sizes * np.clip(wanted / reached, 1 / STEP, STEP)
    raise NotShownError(f"{' + '.join(e.name for e in effects)} does not come to its size")


def _in_noise(base: Base, change: Changes) -> list[Array]:
    """Changes of the fitted samples, in units of the noise."""
    found = []
    for record, run in zip(base.fit.records, base.runs, strict=True):
        own = change[record.label]
        rows = [own[name][: record.time.size] for name in base.fit.predictor.outputs]
        found.append(np.concatenate(rows)[None] * run.scale)
    return found
