"""The demonstration is what it says: the truth leaves noise, the model without the effect more."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo._workflow.simulating import (
    DEMO_EFFECT,
    DEMO_SYSTEM,
    DEMO_TRUTH,
    FREQUENCY_SCATTER,
    NOISE,
    demo_campaign,
    true_model,
)
from bayesoleo.data import load_campaign, periodic_average, reduce_campaign
from bayesoleo.errors import CampaignError
from bayesoleo.model import driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.systems import system


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return demo_campaign(tmp_path_factory.mktemp("demo") / "campaign", 0)


@pytest.fixture(scope="module")
def records(folder):
    return reduce_campaign(load_campaign(folder)).records


def ratios(model, records):
    """Repeating residual over its noise by output, pooled over runs, with nothing estimated."""
    predictor = Predictor(model, records, steps=512, backend="numpy")
    theta = predictor.layout.start(model)
    assert all(status.ok for status in predictor.set_anchor(theta))
    sums = np.zeros((len(predictor.outputs), 2))
    for record, run in zip(records, predictor.predict(theta), strict=True):
        step = record.time[1] - record.time[0]
        for k, (name, y) in enumerate(zip(predictor.outputs, run.y, strict=True)):
            average = periodic_average(record.samples[name] - y, step, record.frequency)
            sums[k] += average.repeating**2, average.noise**2
    return dict(zip(predictor.outputs, np.sqrt(sums[:, 0] / sums[:, 1]), strict=True))


def test_the_campaign_reads_back(folder, records):
    campaign = load_campaign(folder)
    assert (campaign.name, campaign.controlled) == ("demo", "displacement")
    assert [record.role for record in records] == ["fit"] * 4 + ["hold-out"] * 2
    assert len({run.conditions["initial_pressure"] for run in campaign.runs}) == 6
    for run, record in zip(campaign.runs, records, strict=True):
        assert set(run.samples) == set(NOISE)
        assert record.periods == 4
        # four standard deviations of the scatter
        assert record.frequency == pytest.approx(run.frequency, rel=4 * FREQUENCY_SCATTER)
        assert (run.samples["displacement"] > 0).all()
        for name, sd in NOISE.items():
            # a sd from 1200 degrees of freedom is within 4/sqrt(2*1200) of its expectation
            assert record.signal_noise[name] == pytest.approx(sd, rel=0.09)


def test_the_truth_leaves_noise_only(records):
    for ratio in ratios(true_model(), records).values():
        # The displacement's own noise, which the standard error does not count, adds little; the
        # noise part has some 1800 degrees of freedom, and only four periods to tell it by.
        assert ratio == pytest.approx(1.0, abs=0.1)


def test_without_the_effect_the_force_is_missed(records):
    model = true_model()
    without = ratios(model.with_values({DEMO_EFFECT: 0.0}), records)
    assert without["force"] > 1.5
    assert without["pressure"] == pytest.approx(1.0, abs=0.1)


def test_the_truth_is_the_model_and_one_effect():
    fitted, model = driven_by(system(DEMO_SYSTEM), "displacement"), true_model()
    new = set(model.parameters) - set(fitted.parameters)
    assert new == {DEMO_EFFECT, f"{DEMO_EFFECT}_decay"}
    assert {name: model.parameters[name].value for name in DEMO_TRUTH} == dict(DEMO_TRUTH)
    # every one of them has to be estimated
    for name in set(DEMO_TRUTH) - new:
        assert fitted.parameters[name].value != pytest.approx(DEMO_TRUTH[name], rel=1e-3)


def test_a_seed_decides_everything(folder, tmp_path):
    again = demo_campaign(tmp_path / "again", 0)
    other = demo_campaign(tmp_path / "other", 1)
    for file in sorted(path.name for path in folder.iterdir()):
        assert (again / file).read_bytes() == (folder / file).read_bytes()
        assert (other / file).read_bytes() != (folder / file).read_bytes()
    with pytest.raises(CampaignError, match="folder is not empty"):
        demo_campaign(again, 0)
