"""``bayesoleo propose``."""

from __future__ import annotations

import json
import math

import pytest
from small_campaigns import damper_campaign

from bayesoleo._cli.closing import _limit

MODEL = """
from bayesoleo import Model, Output, Parameter

model = Model(
    "damper",
    inputs={"displacement": "m"},
    parameters={"damping": Parameter(150.0, "N*s/m", sd=500.0)},
    outputs={"force": Output({"damping": "damping*dot(displacement)"}, "N")},
)
"""
RUNS = (("a", 1.0, 0.010, "fit"), ("b", 2.0, 0.010, "fit"), ("c", 1.5, 0.010, "hold-out"))
SPRINGS = ("--rivals", "linear_stiffness,cubic_stiffness", "--jobs", 1, "--quiet")


@pytest.fixture
def springs(tmp_path):
    """A spring is missing; of which kind, motions of one amplitude do not say."""
    damper_campaign(
        tmp_path / "springs",
        lambda x, v, t: 200 * v + 1000 * x,
        runs=RUNS,
        noise=40.0,
        periods=16,
    )
    (tmp_path / "springs" / "model.py").write_text(MODEL)
    return tmp_path / "springs"


@pytest.mark.slow
def test_the_run_that_separates_is_printed_and_drawn(run, springs, tmp_path):
    toml = springs / "campaign.toml"
    toml.write_text(toml.read_text() + '\n[rig]\namplitude = { high = 50, unit = "mm" }\n')
    ask = ("propose", springs, "--model", springs / "model.py", "--limit", "force=:", *SPRINGS)
    result = run(*ask, "--figure", tmp_path / "map.png")
    assert result.exit_code == 0, result.output
    assert "mean 0 mm, amplitude 50.0 mm is expected to tell" in result.stdout
    assert (tmp_path / "map.png").stat().st_size > 10_000
    # The command line goes before the campaign.
    result = run(*ask, "--limit", "amplitude=5:20mm", "--json")
    (entry,) = json.loads(result.stdout)["proposals"]
    assert entry["runs"][0]["amplitude"] == pytest.approx(0.02)
    assert entry["question"] == "asked"
    assert entry["repeat"]["information"] < entry["runs"][0]["information"]


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("amplitude=5:50mm", ("amplitude", (0.005, 0.05))),
        ("amplitude=:0.05", ("amplitude", (-math.inf, 0.05))),
        ("frequency=1e-1:", ("frequency", (0.1, math.inf))),
        ("force = -1 : 40 kN", ("force", (-1000.0, 40000.0))),
        ("frequency=:2e3 Hz", ("frequency", (-math.inf, 2000.0))),
    ],
)
def test_limits_are_read_with_and_without_units(text, limit):
    name, found = _limit(text)
    assert name == limit[0]
    assert found == pytest.approx(limit[1])


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--limit", "amplitude=5"), "write name=low:high"),
        (("--limit", "amplitude=5:6furlong/s/s/x"), "unknown unit"),
        (("--limit", "amplitude=6:5mm"), "wrong way round"),
    ],
)
def test_what_is_no_limit_is_refused(refused, springs, option, message):
    line = refused("propose", springs, "--model", springs / "model.py", *SPRINGS, *option)
    assert message in line


@pytest.mark.slow
def test_an_unknown_rival_is_refused_with_those_there_are(run, springs):
    result = run(
        "propose", springs, "--model", springs / "model.py", "--rivals", "linear_stifness", "-q"
    )
    assert result.exit_code == 2
    assert "write one of: linear_stiffness" in result.stderr
