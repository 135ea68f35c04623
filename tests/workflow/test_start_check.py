"""Turned signs and wrong units show at the nominal values; poor starts give no alarm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign

from bayesoleo import Campaign, _workflow as workflow
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import StartCheck, about_start, drive_not_followed
from bayesoleo.data import CampaignData, SimulatedRun, load_campaign, write_campaign
from bayesoleo.errors import CampaignError, DataWarning, ModelError
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction import RunPlan, motion
from bayesoleo.systems import system


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> CampaignData:
    return damper_campaign(tmp_path_factory.mktemp("damper")).campaign


def told(campaign: CampaignData, model: Model, **factors: float) -> list[str]:
    """What is found of the start where channels are multiplied."""
    runs = tuple(
        replace(run, samples={k: factors.get(k, 1.0) * values for k, values in run.samples.items()})
        for run in campaign.runs
    )
    plan = workflow.check(replace(campaign, runs=runs), model, Settings(jobs=1))
    return [text for text in plan["data_warnings"] if "nominal" in text]


def test_an_honest_start_gives_no_alarm(campaign):
    plan = workflow.check(campaign, damper(), Settings(jobs=1))
    assert {item["output"] for item in plan["start"]} == {"force"}
    assert all(item["status"] == "converged" for item in plan["start"])
    assert all(item["correlation"] > 0.5 for item in plan["start"])
    assert told(campaign, damper()) == []
    assert told(campaign, damper(), force=4.0) == []


def test_a_turned_sign_is_told_with_figures(campaign):
    (text,) = told(campaign, damper(), force=-1.0)
    assert text.startswith("at the nominal values force answers with the opposite sign (corr")
    assert "-0." in text
    assert "sign is turned looks so" in text


@pytest.mark.parametrize(("factor", "size"), [(1e-3, "times as much"), (2e3, "times as much")])
def test_a_unit_off_by_a_thousand_is_told(campaign, factor, size):
    (text,) = told(campaign, damper(), force=factor)
    assert size in text
    assert "units of channels" in text


def start(correlation: float, ratio: float, run: str = "a") -> StartCheck:
    return StartCheck(run, "displacement", "converged", correlation, ratio)


@pytest.mark.parametrize(
    ("starts", "words"),
    [
        ([start(0.99, 10.1), start(0.98, 9.9, "b")], ["a power of ten"]),
        ([start(0.99, 10.1), start(0.90, 9.9, "b")], []),
        ([start(0.99, 1.01), start(0.99, 0.98, "b")], []),
        ([start(0.3, 150.0), start(-0.2, 90.0, "b")], []),
        ([start(0.3, 150.0), start(-0.2, 900.0, "b")], ["150 to 900 times as much"]),
        # A resonance between the nominal and the true one of some runs.
        ([start(-0.98, 2.0), start(0.9, 1.1, "b")], []),
        ([start(-0.98, 2.0), start(-0.6, 1.1, "b")], ["or a resonance on the wrong side"]),
        ([StartCheck("a", "displacement", "converged")], []),
        (
            [StartCheck("a", "displacement", "outside")],
            ["no solution at its nominal values in run a"],
        ),
    ],
)
def test_what_all_runs_show_alike_is_told(starts, words):
    found = about_start(starts, system("duffing"))
    assert len(found) == len(words)
    for text, word in zip(found, words, strict=True):
        assert word in text


def test_noise_alone_has_no_size(campaign):
    rng = np.random.default_rng(0)
    runs = tuple(
        replace(run, samples={**run.samples, "force": rng.standard_normal(run.time.size)})
        for run in campaign.runs
    )
    with pytest.warns(DataWarning, match="nothing in force repeats"):
        plan = workflow.check(replace(campaign, runs=runs), damper(), Settings(jobs=1))
    assert not [text for text in plan["data_warnings"] if "nominal" in text]


@pytest.mark.parametrize(("rest", "told_"), [(20.0, True), (290.0, False), (150.0, False)])
def test_degrees_celsius_in_a_model_are_told(tmp_path, rest, told_):
    """Data in degC become K; a model with its rest at 20 lies 273 K below them."""

    def box(rest: float) -> Model:
        return Model(
            "box",
            inputs={"power": "W"},
            dofs={"box": "K"},
            parameters={
                "capacity": Parameter(500.0, "J/K", sd=200.0),
                "loss": Parameter(2.0, "W/K", sd=1.0),
            },
            equations={"box": f"capacity*dot(box) + loss*(box - {rest}) - power"},
            outputs={"temperature": Output("box", "K")},
        )

    plans = [RunPlan(name, 1e-3, {"power": motion(20.0, [p])}) for name, p in (("a", 10), ("b", 5))]
    made = Campaign.simulate(tmp_path / "c", box(293.15), plans, noise={"temperature": 0.01})
    warned = workflow.check(made, box(rest), Settings(jobs=1))["data_warnings"]
    found = [text for text in warned if "degC" in text]
    assert len(found) == told_
    assert all("temperature lies 27" in text and "in K" in text for text in found)


def rotor(held: str = "") -> Model:
    """A body that turns, held by nothing but what is given."""
    return Model(
        "rotor",
        inputs={"displacement": "m"},
        dofs={"place": "m"},
        parameters={
            "drag": Parameter(1.0, "1/s", relative_sd=0.5),
            "pull": Parameter(4.0, "1/s**2", relative_sd=0.5),
        },
        equations={"place": f"ddot(place) + drag*dot(place) {held} - pull*displacement"},
        outputs={"force": Output("1000*dot(place)", "N")},
    )


def test_a_dof_that_nothing_holds_is_refused_in_periodic_runs(campaign, tmp_path):
    """Only its rate is determined: the linearised equations of any motion would be singular."""
    with pytest.raises(ModelError, match=r"nothing holds 'place'.*periodic run such as a.*initial"):
        workflow.check(campaign, rotor(), Settings(jobs=1))
    with pytest.raises(ModelError, match="or declare its rate, in m/s, as the dof, of first order"):
        workflow.check(campaign, rotor(), Settings(jobs=1))
    workflow.check(campaign, rotor("+ pull*place"), Settings(jobs=1))
    transient = damper_campaign(tmp_path, transient=True).campaign
    workflow.check(transient, rotor(), Settings(jobs=1))


def test_a_dof_of_first_order_that_nothing_holds_is_left_out_instead(campaign):
    """Its rate cannot be made a dof of first order: the dof is of first order already."""
    model = rotor()
    equations = {"place": {"drag": "drag*dot(place)", "drive": "-pull*displacement"}}
    first = replace(model, equations=equations)
    with pytest.raises(ModelError, match=r"or leave 'place' out and solve its equation") as caught:
        workflow.check(campaign, first, Settings(jobs=1))
    assert "first order" not in str(caught.value)


@pytest.mark.parametrize(
    ("controlled", "told"),
    [
        ("displacement", ""),  # its own input
        (None, ""),
        ("force", "an output of model 'rotor' that no input can be exchanged for"),
        ("torque", "neither an input nor an output of model 'rotor'"),
    ],
)
def test_a_controlled_channel_that_cannot_drive_is_told(campaign, controlled, told):
    # Its only output does not depend on the motion: no displacement belongs to it.
    model = replace(rotor("+ pull*place"), outputs={"force": Output("pull", "N")})
    found = drive_not_followed(model, replace(campaign, controlled=controlled), None)
    assert len(found) == bool(told)
    for text in found:
        assert f"controlled = '{controlled}', which is {told}" in text
        assert "driven by displacement. It can be driven by one of: displacement." in text
    assert drive_not_followed(model, replace(campaign, controlled=controlled), "model") == []


def test_an_output_that_can_be_exchanged_drives_without_a_word(campaign):
    spring = Model(
        "spring",
        inputs={"force": "N"},
        dofs={"x": "m"},
        parameters={"stiffness": Parameter(1e4, "N/m", relative_sd=0.5)},
        equations={"x": "ddot(x) + stiffness*x - force"},
        outputs={"displacement": Output("x", "m")},
    )
    assert drive_not_followed(spring, replace(campaign, controlled="displacement"), None) == []


def test_a_campaign_warns_of_a_controlled_channel_that_cannot_drive(campaign):
    wrong = replace(campaign, controlled="force")
    model = rotor("+ pull*place")  # of which the force follows the velocity
    with pytest.warns(DataWarning, match=r"controlled = 'force'.*driven by displacement"):
        workflow.check(wrong, model, Settings(jobs=1))


def test_turns_in_a_channel_of_radians_are_told(tmp_path):
    motor = Model(
        "motor",
        inputs={"torque": "N*m"},
        dofs={"speed": "rad/s"},
        parameters={
            "inertia": Parameter(1.0, "kg*m**2", fixed=True),
            "drag": Parameter(0.5, "N*m*s", relative_sd=0.5),
        },
        equations={"speed": "inertia*dot(speed) + drag*speed - torque"},
        outputs={"shown": Output("speed", "rad/s")},
    )
    time = 0.01 * np.arange(200)
    samples = {"torque": np.sin(time), "shown": 0.3 * np.sin(time - 1.0)}
    run = SimulatedRun("a", time, samples, None, kind="transient")
    channels = {"torque": ("t", "N*m"), "shown": ("n", "1/min")}
    write_campaign(tmp_path, name="n", channels=channels, runs=[run])
    message = r"channels\.shown\.unit.*expects rad/s \(got '?1/min'?\); .*unit = 'rpm'"
    with pytest.raises(CampaignError, match=message):
        workflow.prepare(load_campaign(tmp_path), motor, Settings(jobs=1))
