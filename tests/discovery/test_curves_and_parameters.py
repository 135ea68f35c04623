"""What a curve can do as well as a parameter is not known, nor what a run beyond it does."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import NUMERICS
from scipy.integrate import solve_ivp
from small_campaigns import damper, damper_campaign, spring_damper_force
from test_nonparametric_effects import ABOUT, EFFECTS, inner_wall

from bayesoleo import _schema as schema
from bayesoleo._report import tables
from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._curves import CurveFacts, own_part
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._summary import summarise
from bayesoleo.model import Model, Output, Parameter


def products(columns, curve):
    return columns @ columns.T, columns @ curve.T, curve @ curve.T


def test_own_part_in_closed_form():
    """One beside what is orthogonal, sin² of the angle to a single direction, none within it."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((50, 6)))[0].T
    first, second, third, *rest = basis
    curve = np.array([first, second])
    angle = 0.7
    tilted = np.cos(angle) * first + np.sin(angle) * third
    columns = np.array([first, 3.0 * tilted, rest[0], 1e4 * (rest[1] + second)])
    alone = [own_part(*products(one[None], curve))[0] for one in columns]
    # Eigenvalues are cut at 1e-10 of the diagonal.
    np.testing.assert_allclose(alone, [0.0, np.sin(angle) ** 2, 1.0, 0.5], atol=1e-9)


def test_parameters_that_only_together_do_what_a_curve_does_are_shared_both():
    first, second, third, fourth = np.eye(4)
    columns = np.array([first + 5 * second, first - 5 * second, third])
    part = own_part(*products(columns, np.array([first, fourth])))
    # Their sum is the curve's, their difference their own: each is known through the other only.
    np.testing.assert_allclose(part[:2], part[0], rtol=1e-6)
    assert part[0] < 1e-6
    assert part[2] == pytest.approx(1.0)


RUNS = (("a", 1.0, 0.010, "fit"), ("b", 2.0, 0.006, "fit"), ("c", 0.5, 0.012, "fit"),
        ("d", 1.5, 0.008, "hold-out"), ("e", 1.0, 0.016, "hold-out"))  # fmt: skip


@pytest.fixture(scope="module")
def ripples(tmp_path_factory):
    reduced = damper_campaign(tmp_path_factory.mktemp("ripples"), inner_wall, runs=RUNS)
    return close_loop(Assembly(damper()), assign(reduced.records), NUMERICS, effects=EFFECTS)


def test_a_force_law_shares_its_springs_with_a_curve_of_the_stroke(ripples):
    assert ripples.effects == ("nonparametric_displacement",)
    names, point = ripples.final.fit.problem.names, ripples.final.fit.point
    facts = CurveFacts.of(ripples.final)
    assert set(facts.shared) == {"stiffness", "cubic"}
    # The convention's interval would be false by far, and that of what is not shared is right.
    stiffness, damping = names.index("stiffness"), names.index("damping")
    assert abs(point.theta[stiffness] - 1000.0) > 20 * point.sd[stiffness]
    assert abs(point.theta[damping] - 200.0) < 4 * point.sd[damping]


def test_neither_summary_nor_table_gives_a_shared_parameter_an_interval(ripples):
    summary = summarise(ripples, None, ABOUT)
    entry = summary["parameters"]["stiffness"]
    assert (entry["sd"], entry["interval"]) == (None, None)
    assert entry["shared_with"] == "a smooth function of displacement (force)"
    rows = {row[0]: row[1:] for row in tables.parameters(summary).rows}
    assert rows["stiffness"][2:4] == ["–", f"shared with {entry['shared_with']}"]
    assert summary["parameters"]["damping"]["sd"] > 0
    assert any(note.startswith("stiffness, cubic: shared with") for note in summary["notes"])


def test_a_held_out_run_beyond_the_curve_is_named(ripples):
    (text,) = CurveFacts.of(ripples.final).beyond
    assert text.startswith("run e goes beyond the range in which a smooth function of displacement")
    assert "m, fitted -0.01" in text


def test_without_a_curve_nothing_is_shared(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force)
    loop = close_loop(Assembly(damper()), assign(reduced.records), NUMERICS, effects=())
    assert CurveFacts.of(loop.final) == CurveFacts()


CONDUCTANCE, CAPACITY = 0.4545, 2.0


def thermal_campaign(folder):
    """A body that is heated and loses heat by a law that nobody named, of first order."""
    rng, made = np.random.default_rng(0), []
    for label, frequency, amplitude, role in (
        ("a", 0.05, 6.0, "fit"), ("b", 0.10, 9.0, "fit"), ("c", 0.02, 5.0, "fit"),
        ("d", 0.04, 5.0, "hold-out"),
    ):  # fmt: skip
        omega, period = 2 * np.pi * frequency, 1 / frequency

        def rate(t, s, amplitude=amplitude, omega=omega):
            lost = CONDUCTANCE * s[0] + 1.5 * np.tanh(s[0] / 2.0)
            return [(amplitude * np.sin(omega * t) - lost) / CAPACITY]

        time = np.arange(600) * period / 100
        found = solve_ivp(
            rate, (0, 30 * period), [0.0], "DOP853", 20 * period + time, rtol=1e-9, atol=1e-11
        )
        heat = amplitude * np.sin(omega * time)
        samples = {"power": heat, "temperature": found.y[0] + 0.05 * rng.standard_normal(600)}
        made.append(SimulatedRun(label, time, samples, frequency, role=role))
    channels = {"power": ("p", "W"), "temperature": ("T", "K")}
    write_campaign(folder, name="thermal", channels=channels, runs=made, controlled="power")
    return reduce_campaign(load_campaign(folder), jobs=1)


def test_a_first_order_system_shares_its_conductance_and_keeps_its_capacity(tmp_path):
    model = Model(
        "body",
        inputs={"power": "W"},
        dofs={"temperature": "K"},
        parameters={
            "capacity": Parameter(3.0, "J/K", sd=3.0),
            "conductance": Parameter(0.8, "W/K", sd=1.0),
        },
        equations={"temperature": {"storage": "capacity*dot(temperature)",
                                   "loss": "conductance*temperature", "power": "-power"}},
        outputs={"temperature": Output({"itself": "temperature"}, "K")},
    )  # fmt: skip
    roles = assign(thermal_campaign(tmp_path).records)
    loop = close_loop(Assembly(model), roles, NUMERICS, effects=())
    assert loop.certainty == schema.NO_CAUSE
    names, point = loop.final.fit.problem.names, loop.final.fit.point
    assert set(CurveFacts.of(loop.final).shared) == {"conductance"}
    conductance, capacity = names.index("conductance"), names.index("capacity")
    assert abs(point.theta[conductance] - CONDUCTANCE) > 20 * point.sd[conductance]
    assert abs(point.theta[capacity] - CAPACITY) < 4 * point.sd[capacity]
