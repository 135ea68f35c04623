"""To what the estimates of a search are known: by the noise of outputs and of measured inputs."""

from __future__ import annotations

import numpy as np
import pytest
from multisines import multisine_campaign, resonance

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import estimated, score_candidates
from bayesoleo.discovery._refit import refit
from bayesoleo.discovery._score_tests import corrected_p
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect
from bayesoleo.model import Dof, Model, Output, Parameter

#: Of the resonator that makes the data: its frequency is the fortieth line of 0.5 Hz.
TRUE = {"damping": 0.1, "stiffness": 1.0}
OMEGA = 2 * np.pi * 20.0


def resonator() -> Model:
    return Model(
        "resonator",
        dofs={"x": Dof("m")},
        inputs={"force": "N"},
        parameters={
            "damping": Parameter(0.12, "1", relative_sd=0.5),
            "stiffness": Parameter(1.05, "1", relative_sd=0.5),
        },
        equations={"x": f"ddot(x)/{OMEGA}**2 + damping*dot(x)/{OMEGA} + stiffness*x - force"},
        outputs={"displacement": Output("x", "m")},
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("input_noise", "noise"), [(0.1, 1e-3), (1e-4, 0.1)], ids=["of the force", "of the output"]
)
def test_the_deviation_of_an_estimate_counts_the_noise_of_a_measured_input(input_noise, noise):
    """An error of a force's harmonic repeats in every period; white noise would average out."""
    distances, white = [], []
    for seed in range(10):
        records = multisine_campaign(
            resonance, seed, realisations=1, input_noise=input_noise, noise=noise
        ).records
        state = fit_state(
            Assembly(resonator(), "force"), assign(records), Numerics(jobs=1, backend="numpy")
        )
        point = state.fit.point
        for k, name in enumerate(state.fit.problem.names):
            error = point.theta[k] - TRUE[name]
            distances.append(error / state.sd_of(name))
            white.append(error / point.sd[k])
    # The root mean square of twenty distances lies within 0.6 and 1.5 (chance 0.1 %).
    size = np.sqrt(np.mean(np.square(distances)))
    assert 0.6 < size < 1.5
    if input_noise > noise:
        assert np.sqrt(np.mean(np.square(white))) > 2.0 * size
    assert state.sd_of("mass") is None


@pytest.mark.slow
def test_absent_effects_are_seldom_significant_beside_the_noise_of_a_measured_input():
    """Where it did not count, all these p-values were below a twentieth, and most were zero."""
    effects = [
        find_effect(name) for name in ("coulomb_friction", "cubic_stiffness", "quadratic_damping")
    ]
    found = []
    for seed in range(12):
        records = multisine_campaign(
            resonance, seed, realisations=2, input_noise=0.1, noise=1e-3
        ).records
        numerics = Numerics(jobs=1, backend="numpy")
        state = fit_state(Assembly(resonator(), "force"), assign(records), numerics)
        base = state.base()
        for score in score_candidates(base, state.assembly, effects, 1)[0]:
            result = refit(base, score, numerics)
            if np.isfinite(result.share):
                found.append(corrected_p(estimated(score, result), 1.0))
    small = np.array(found)
    assert small.size > 30
    # Of 36 at 5 % each at most six (chance 0.7 %), and none below a thousandth (chance 4 %).
    assert np.sum(small < 0.05) <= 6
    assert not (small < 1e-3).any()


@pytest.mark.slow
@pytest.mark.parametrize("lines", [60, 200], ids=["a coefficient each", "sums of coefficients"])
def test_scores_of_absent_effects_count_the_noise_of_every_input_coefficient(lines):
    """Where the largest 256 coefficients alone counted, scores were significant."""
    effects = [
        find_effect(name) for name in ("coulomb_friction", "cubic_stiffness", "quadratic_damping")
    ]
    found = []
    for seed in range(8):
        records = multisine_campaign(
            resonance, seed, realisations=1, orders=range(1, lines + 1), input_noise=0.1,
            noise=1e-3,
        ).records  # fmt: skip
        numerics = Numerics(jobs=1, backend="numpy")
        state = fit_state(Assembly(resonator(), "force"), assign(records), numerics)
        scores, _ = score_candidates(state.base(), state.assembly, effects, 1)
        found += [corrected_p(score, 1.0) for score in scores]
    small = np.array(found)
    assert small.size == 24
    # Of 24 at 5 % each at most five (chance 0.7 %), and none below a thousandth (chance 2 %).
    assert np.sum(small < 0.05) <= 5
    assert not (small < 1e-3).any()
