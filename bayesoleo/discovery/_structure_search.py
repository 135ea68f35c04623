"""Which structures are worth an estimate, and their posterior probabilities.

Scores linearise the model at its estimate without the effects. That is exact enough for small
effects only, and shapes are scanned on a coarse grid. Structures that may be probable are therefore
estimated, and compared again about their estimates, until no other one may be.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesoleo._parallel import thread_map
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Added, Assembly
from bayesoleo.discovery._error_table import RunError
from bayesoleo.discovery._fit import ModelFit, Numerics
from bayesoleo.discovery._refit import new_parameters, quick_fit
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._structure_curves import curves_of
from bayesoleo.discovery._structures import (
    Comparison,
    EstimatedModel,
    Evidence,
    StructurePosterior,
    StructurePrior,
    scan_prior,
)
from bayesoleo.errors import ModelError
from bayesoleo.model._parameters import Parameter
from bayesoleo.model._priors import LogNormal

#: Structures are estimated this many at a time, so often, where their probability may be more than
#: this part of the most probable one's.
AT_A_TIME, TIMES, WORTH = 4, 5, 0.01
DEFAULT_PRIOR = StructurePrior()


def structure_posterior(
    base: Base,
    assembly: Assembly,
    scores: Sequence[Score],
    errors: Mapping[tuple[str, str], RunError],
    numerics: Numerics,
    *,
    prior: StructurePrior = DEFAULT_PRIOR,
    known: Sequence[tuple[Assembly, ModelFit]] = (),
    callback: ProgressCallback = lambda _: None,
) -> StructurePosterior:
    """Probabilities of what a model lacks.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the declared model at its estimate.
    assembly : Assembly
        The declared model.
    scores : sequence of Score
        Of all candidates about that estimate.
    errors : mapping of (run, output) to RunError
        For the noise.
    numerics : Numerics
    prior : StructurePrior, optional
    known : sequence of (Assembly, ModelFit), optional
        Models with effects that were estimated already.
    callback : callable, optional
        Receives a message at each step.
    """
    assert base.data is not None
    by_key = {score.option.key: score for score in scores}
    evidence = Evidence(
        Comparison.of(base.data, errors, scores, prior, curves_of(base, assembly, numerics.jobs))
    )
    evidence.add(EstimatedModel(base.fit, {}))
    for grown, fit in known:
        evidence.add(_anchor(grown, fit, by_key))
    tried: set[tuple[Added, ...]] = set()
    for _ in range(TIMES):
        doubtful = [e for e in evidence.doubtful(float(np.log(WORTH))) if e and e not in tried]
        if not doubtful:
            break
        callback(f"estimate {len(doubtful[:AT_A_TIME])} structures")
        tried |= set(doubtful[:AT_A_TIME])
        extended = _extended(base, assembly, by_key, numerics)
        for found in thread_map(extended, doubtful[:AT_A_TIME], numerics.jobs):
            if found is not None:
                evidence.add(found)
    return evidence.posterior()


def _anchor(assembly: Assembly, fit: ModelFit, scores: Mapping[Added, Score]) -> EstimatedModel:
    """An estimated model with the effects that it has."""
    effects = {(step.effect.id, step.target): step.amplitudes for step in assembly.steps}
    shapes = {
        name: tuple(values)
        for key in effects
        if key in scores
        for name, values in scores[key].option.candidate.shapes.items()
    }
    return EstimatedModel(fit, effects, shapes)


def _parameters(grown: Assembly, score: Score, base: Base) -> dict[str, Parameter]:
    """New parameters of an effect, its shapes with the prior by which they are compared."""
    found = new_parameters(grown, score, base.policy)
    for name, values in score.option.candidate.shapes.items():
        centre, spread = scan_prior(values)
        found[name] = replace(found[name], prior=LogNormal(float(np.exp(centre)), spread))
    return found


def _extended(
    base: Base, assembly: Assembly, scores: Mapping[Added, Score], numerics: Numerics
) -> Callable[[tuple[Added, ...]], EstimatedModel | None]:
    """Estimates a set of effects together; None where that failed."""

    def estimated(effects: tuple[Added, ...]) -> EstimatedModel | None:
        grown, known = assembly.with_values(base.fit.shared), dict(base.fit.values)
        try:
            for key in effects:
                score = scores[key]
                step = score.option.assembly.steps[-1]
                grown = grown.option(step.effect, step.target, step.scales).assembly
                grown = grown.with_parameters(_parameters(grown, score, base))
                known |= dict(zip(score.names, map(float, score.expected), strict=True))
        except ModelError:
            return None
        fit = quick_fit(base, grown.model(), known, numerics)
        # A fit that stopped early is linearised where it is, which does nearly as well.
        solved = all(np.isfinite(p.sensitivity).all() for p in fit.predictions)
        return _anchor(grown, fit, scores) if solved else None

    return estimated
