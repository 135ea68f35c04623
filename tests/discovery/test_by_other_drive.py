"""Where the prediction is far off, the force along the measured motion says what is missing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from scipy.integrate import solve_ivp

from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._by_other_drive import misleads, refit_from, suggested
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.effects import find_effect
from bayesoleo.model import Model, Output, Parameter

MASS, STIFFNESS, CUBIC, STEP = 0.8, 3000.0, 4e7, 1e-3
#: Amplitudes at which the cubic spring is as stiff as the linear one.
DRIVES = {"p4": (4.0, 6.0), "p7": (7.0, 5.0), "p9": (9.5, 3.0), "p13": (13.0, 8.0)}
MODEL = Model(
    "linear",
    inputs={"force": "N"},
    dofs={"place": "m"},
    parameters={
        "damping": Parameter(3.0, "N*s/m", relative_sd=1.0),
        "stiffness": Parameter(2500.0, "N/m", relative_sd=0.5),
    },
    equations={"place": f"{MASS}*ddot(place) + damping*dot(place) + stiffness*place - force"},
    outputs={"displacement": Output("place", "m")},
)


#: Mass, damping, stiffness and cubic stiffness.
HARDENING = (MASS, 8.0, STIFFNESS, CUBIC)
LIGHTLY_DAMPED = (MASS, 2.0, STIFFNESS, CUBIC)
#: Heavier than the model, which has a fixed mass, and softening.
HEAVY = (1.5 * MASS, 3.0, 5000.0, -1.2e7)


def moved(force, time, start, system):
    """By a library's integrator."""
    mass, damping, stiffness, cubic = system

    def rate(t, y):
        x, v = y
        return v, (force(t) - damping * v - stiffness * x - cubic * x**3) / mass

    span = time[0], time[-1]
    return solve_ivp(rate, span, start, t_eval=time, rtol=1e-8, atol=1e-11, max_step=4e-3).y[0]


def duffing(folder, system, *, decays):
    """Settled runs at four frequencies and, if wanted, two free decays with an idle force cell."""
    rng, runs = np.random.default_rng(4), []

    def add(label, time, force, place, frequency, role):
        samples = {
            "force": force + 0.02 * rng.standard_normal(time.size),
            "displacement": place + 5e-6 * rng.standard_normal(time.size),
        }
        kind = "periodic" if frequency else "transient"
        runs.append(SimulatedRun(label, time, samples, frequency, role=role, kind=kind))

    for label, (frequency, size) in DRIVES.items():
        time = STEP * np.arange(round(12 / frequency / STEP))
        # Free motion has fallen to 1e-7 of itself.
        waited = np.ceil(32 * system[0] / system[1] * frequency) / frequency

        def force(t, size=size, frequency=frequency):
            return size * np.sin(2 * np.pi * frequency * t)

        place = moved(force, np.concatenate([[0.0], waited + time]), (0.0, 0.0), system)[1:]
        role = "hold-out" if label == "p9" else "fit"
        add(label, time, force(time), place, frequency, role)
    for label, start, role in (("ring1", 4e-3, "fit"), ("ring2", 2e-3, "hold-out"))[: 2 * decays]:
        time = STEP * np.arange(1500)
        place = moved(lambda _: 0.0, time, (start, 0.0), system)
        add(label, time, np.zeros(time.size), place, None, role)
    channels = {"force": ("F", "N"), "displacement": ("x", "m")}
    write_campaign(folder, name="duffing", controlled="force", channels=channels, runs=runs)
    return folder


@pytest.fixture(scope="module")
def state(tmp_path_factory):
    folder = duffing(tmp_path_factory.mktemp("duffing"), HARDENING, decays=False)
    return fitted(reduce_campaign(load_campaign(folder), jobs=1), MODEL)


EFFECTS = [find_effect(n) for n in ("cubic_stiffness", "quadratic_damping", "coulomb_friction")]


def test_the_force_along_the_motion_names_the_effect_and_its_size(state):
    assert state.worst_ratio > 30
    (found,) = suggested(state, EFFECTS, NUMERICS)
    assert (found.effect, found.target) == ("cubic_stiffness", "place")
    # Derivatives carry noise into the equation: sizes are good to some per cent, as starts.
    exact = {"cubic_stiffness": CUBIC, "stiffness": STIFFNESS, "damping": 8.0}
    for name, value in exact.items():
        assert found.values[name] == pytest.approx(value, rel=0.05)


def test_the_estimate_from_there_leaves_noise_alone(state):
    base = state.base()
    (found,) = suggested(state, EFFECTS, NUMERICS)
    scores, _ = score_candidates(base, state.assembly, EFFECTS[:1], 1)
    result = refit_from(base, scores[0], found.values, NUMERICS)
    assert result.score is scores[0]
    assert result.reached
    # Five standard deviations, as the fit states them.
    names = result.fit.problem.names
    k = names.index("cubic_stiffness")
    assert result.fit.point.theta[k] == pytest.approx(CUBIC, abs=5 * result.fit.point.sd[k])


def test_no_other_drive_has_fewer_motions_for_a_force_law(state):
    """The motion is given already: nothing else could be predicted less."""
    assembly = replace(state.assembly, drive="displacement")
    other = replace(state, assembly=assembly, fit=replace(state.fit, model=assembly.model()))
    assert suggested(other, EFFECTS, NUMERICS) == []


@pytest.mark.parametrize(
    ("ratio", "shares", "told"),
    [(500.0, (0.6, 0.2), True), (500.0, (), True), (500.0, (0.95,), False),
     (5.0, (0.6,), False), (np.nan, (0.6,), False), (500.0, (-np.inf, np.nan), True)],
)  # fmt: skip
def test_it_is_asked_where_nothing_comes_near(ratio, shares, told):
    refits = {k: SimpleNamespace(share=share) for k, share in enumerate(shares)}
    assert misleads(SimpleNamespace(worst_ratio=ratio), refits) is told


@pytest.mark.slow
def test_a_resonance_that_bends_over_and_free_decays_show_the_cubic_spring_alone(tmp_path):
    """The score of a linear model's motion names a sensor's gain; an idle force is no force."""
    reduced = reduce_campaign(load_campaign(duffing(tmp_path, LIGHTLY_DAMPED, decays=True)), jobs=1)
    loop = close_loop(Assembly(MODEL, None, starts=True), assign(reduced.records), Numerics(jobs=1))
    assert loop.effects == ("cubic_stiffness",)
    assert loop.final.at_floor
    k = loop.final.fit.problem.names.index("cubic_stiffness")
    point = loop.final.fit.point
    assert point.theta[k] == pytest.approx(CUBIC, abs=5 * point.sd[k])


@pytest.mark.slow
def test_what_says_the_same_in_other_words_is_as_probable_beside_another_effect(tmp_path):
    """With a fixed mass that is wrong, all forces are wrong by one factor, as by a gain."""
    reduced = reduce_campaign(load_campaign(duffing(tmp_path, HEAVY, decays=False)), jobs=1)
    loop = close_loop(Assembly(MODEL, None), assign(reduced.records), Numerics(jobs=1))
    assert loop.final.at_floor
    same = {
        ("mass_error", "place"), ("sensor_gain", "force"), ("sensor_gain", "displacement")
    }  # fmt: skip
    assert ("cubic_stiffness", "place") in loop.added
    (own,) = same & set(loop.added)
    accepted = next(
        one.accepted for one in loop.rounds
        if one.accepted and (one.accepted.effect, one.accepted.target) == own
    )  # fmt: skip
    told = {name.split(" @ ")[0] for name in accepted.same}
    assert {effect for effect, _ in same - {own}} <= told
    probable = loop.structures.effects
    assert sum(probable[key] for key in same) > 0.9
    # Priors of their sizes differ, their likelihoods do not.
    assert max(probable[key] for key in same) < 0.8
