"""The campaigns with known truth: at the truth, nothing but the noise that was added is left."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import truth_systems
from truth_systems import KINDS, Extra, Made, Noise, Plan, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.prediction._predictor import Predictor

SMALL = Plan(fitted=1, held_out=1, periods=4, per_period=60.3)
QUIET = Noise(relative=0.002)


def ratios(made: Made) -> list[float]:
    """Residual at the truth over the noise, by run and output; predicted by the package itself."""
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    model = task.assembly.model()
    predictor = Predictor(model, made.campaign.records, steps=512, backend="numpy", jobs=1)
    theta = np.array([made.truth[name] for name in predictor.layout.names])
    assert all(status.ok for status in predictor.set_anchor(theta))
    found = []
    for r, record in enumerate(made.campaign.records):
        y = predictor.simulate(theta[None], r).y[0]
        for b, output in enumerate(predictor.outputs):
            rest = record.samples[output] - y[b]
            found.append(float(np.sqrt(np.mean(rest**2))) / made.noise[output])
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_at_the_truth_the_noise_is_left(kind):
    """SciPy's or a closed form's motion against the package's; 240 samples know a root mean square
    to 5 %, so that 1 +- 0.2 is four standard deviations."""
    np.testing.assert_allclose(ratios(make(kind, 3, plan=SMALL, noise=QUIET)), 1.0, atol=0.2)


def test_a_campaign_follows_from_its_seed():
    first, again, other = (make("oleo", seed, plan=SMALL) for seed in (1, 1, 2))
    assert first.truth == again.truth
    assert first.truth != other.truth
    for one, two in zip(first.campaign.records, again.campaign.records, strict=True):
        np.testing.assert_array_equal(one.samples["force"], two.samples["force"])


def test_noise_changes_neither_truth_nor_runs():
    quiet, coloured = make("duffing", 4, noise=QUIET), make("duffing", 4, noise=Noise(0.02, 0.9))
    assert quiet.truth == coloured.truth
    for label, channels in quiet.clean.items():
        np.testing.assert_array_equal(
            channels["displacement"], coloured.clean[label]["displacement"]
        )


def test_colour_step_and_input_noise_are_as_asked_for():
    made = make("force law", 5, noise=Noise(0.02, colour=0.8, relative_input=0.01, step=2.0))
    record = made.campaign.records[0]
    step = 2.0 * made.noise["force"]
    np.testing.assert_allclose(
        record.samples["force"] / step, np.round(record.samples["force"] / step), atol=1e-6
    )
    clean = made.clean[record.label]
    shift = record.samples["displacement"].size - clean["displacement"].size
    error = record.samples["displacement"] - clean["displacement"][-shift if shift else 0 :]
    size = 0.01 * np.mean([np.std(c["displacement"]) for c in made.clean.values()])
    assert error.std() == pytest.approx(size, rel=0.25)  # some 400 samples


def test_an_effect_acts_and_may_have_a_state_of_its_own():
    """A Maxwell element, a spring behind a damper, whose lag is a state."""

    def maxwell(sizes):
        stiffness = 0.2 * sizes.force / sizes.position
        rate = 2 * np.pi * sizes.frequency
        return Extra(
            lambda x, v, t, z: stiffness * (x - z[0]), lambda x, v, t, z: [rate * (x - z[0])], 1
        )

    for kind in ("linear", "force law"):
        plain = make(kind, 3, plan=SMALL, noise=QUIET)
        made = make(kind, 3, plan=SMALL, noise=QUIET, effect=maxwell)
        assert made.truth == plain.truth
        assert min(ratios(made)) > 5.0


@pytest.mark.slow
def test_a_toleranced_constant_differs_from_its_nominal_value():
    for kind in KINDS:
        exact, loose = truth_systems.model_of(kind), truth_systems.model_of(kind, True)
        made, drawn = make(kind, 6, plan=SMALL), make(kind, 6, plan=SMALL, toleranced=True)
        (name,) = [n for n in loose.uncertain() if n not in exact.uncertain()]
        assert made.truth[name] == exact.parameters[name].value
        assert drawn.truth[name] != made.truth[name]


def test_transients_start_from_rest():
    made = make("linear", 1, plan=dataclasses.replace(SMALL, transient=True))
    for record in made.campaign.records:
        assert not record.periodic
        assert made.clean[record.label]["displacement"][0] == 0.0
