"""Forces that follow the clock and not the motion: periodic with the drive, and drifting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from scipy.integrate import solve_ivp
from small_campaigns import (
    DAMPER_RUNS,
    DRAG,
    HARDENING,
    OSCILLATOR_RUNS,
    SPRING,
    damper,
    damper_campaign,
    oscillator_campaign,
    spring_damper_force,
)

from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._ranking import line_of, scales_of, score_candidates
from bayesoleo.discovery._score_tests import score_all
from bayesoleo.discovery._signatures import noise_of, signatures_of
from bayesoleo.discovery._state import fit_state
from bayesoleo.discovery._summary import summarise
from bayesoleo.effects import catalogue, find_effect
from bayesoleo.errors import ModelError
from bayesoleo.systems import system

ABOUT = {"campaign": "small", "model": "small", "drive": "displacement", "seed": 0}
FEW = tuple(map(find_effect, ("periodic_force", "coulomb_friction", "quintic_stiffness")))
THIRD, AHEAD = 3.0, 1.0


def scored(state):
    scales = scales_of(state.fit, state.assembly.drive, state.assembly.native)
    found, failed = score_all(state.base(), state.assembly.options(scales, catalogue()), jobs=1)
    return found, failed


def humming():
    """The third harmonic of the drive hums along, in every run as loud."""
    frequencies = iter([run[1] for run in DAMPER_RUNS])

    def force(x, v, t):
        turn = 2 * np.pi * next(frequencies) * t
        return spring_damper_force(x, v, t) + THIRD * np.cos(3 * turn + AHEAD)

    return force


@pytest.fixture(scope="module")
def hum(tmp_path_factory):
    """The drive is a sine: its phase, that of a cosine, is a quarter of a turn behind the clock."""
    return damper_campaign(tmp_path_factory.mktemp("hum"), humming())


def test_a_force_at_a_harmonic_of_the_drive_is_named_with_size_and_phase(hum):
    loop = close_loop(Assembly(damper()), assign(hum.records), NUMERICS, effects=FEW)
    assert loop.effects == ("periodic_force",)
    values = loop.final.fit.values
    # cos(3 (phi + pi/2) + 1) with the drive's phase phi.
    found = values["periodic_force_cosine_3"] - 1j * values["periodic_force_sine_3"]
    expected = THIRD * np.exp(1j * (AHEAD + 1.5 * np.pi))
    assert abs(found - expected) < 0.05 * THIRD
    for k in (1, 2):
        for part in ("cosine", "sine"):
            name = f"periodic_force_{part}_{k}"
            sd = loop.final.fit.point.sd[loop.final.fit.problem.names.index(name)]
            assert abs(values[name]) < 4.5 * sd
    assert loop.final.hold_errors.worst_ratio() < 1.2
    summary = summarise(loop, None, ABOUT)
    assert summary["rounds"][0]["accepted"] == "periodic_force"


@pytest.mark.slow
def test_its_phase_is_that_of_the_drive_and_not_of_the_clock(hum):
    """The same records cut a third of a period later tell the same force."""
    later = [
        replace(
            record,
            time=record.time[33:],
            samples={n: v[33:] for n, v in record.samples.items()},
            harmonics={
                name: replace(
                    item,
                    coefficients=item.coefficients
                    * np.exp(2j * np.pi * item.orders * record.phase[33]),
                )
                for name, item in record.harmonics.items()
            },
        )
        for record in hum.records
    ]
    expected = []
    for records in (hum.records, later):
        state = fitted(replace(hum, records=tuple(records)), damper())
        best = scored(state)[0][0]
        assert best.option.candidate.effect == "periodic_force"
        expected.append(best.expected)
    np.testing.assert_allclose(*expected, atol=0.05 * THIRD)


def swinging(frequency, amplitude, rng, extra=0.3):
    """A hardening spring under a sine and, unmeasured, a force at twice its frequency."""
    omega = 2 * np.pi * frequency
    time = np.arange(600) / (100 * frequency)

    def rates(t, s):
        force = amplitude * np.sin(omega * t) + extra * np.sin(2 * omega * t)
        return [s[1], force - SPRING * s[0] - DRAG * s[1] - HARDENING * s[0] ** 3]

    settle = 60 / frequency
    found = solve_ivp(
        rates, (0, settle + time[-1]), [0.0, 0.0], "DOP853", settle + time, rtol=1e-9, atol=1e-12
    )
    x = found.y[0] + 2e-5 * rng.standard_normal(time.size)
    return time, {"force": amplitude * np.sin(omega * time), "displacement": x}


@pytest.mark.slow
def test_a_force_on_an_oscillator_at_twice_the_drive(tmp_path):
    """Driven by force: the answer of the motion is what shows it."""
    rng, runs = np.random.default_rng(0), []
    for label, frequency, amplitude, role in OSCILLATOR_RUNS:
        time, samples = swinging(frequency, amplitude, rng)
        runs.append(SimulatedRun(label, time, samples, frequency, role=role))
    state = fitted(written(tmp_path, runs), system("duffing"))
    found, _ = scored(state)
    best = found[0]
    assert best.option.candidate.effect == "periodic_force"
    size = np.abs(best.expected[0::2] + 1j * best.expected[1::2])
    # That at the drive's own frequency is for the better part what stiffness and damping miss.
    assert np.argmax(size[1:]) == 0
    assert size[1] == pytest.approx(0.3, rel=0.2)


def test_transients_have_no_phase_of_a_drive(hum):
    state = fitted(hum, damper())
    scales = scales_of(state.fit, None, state.assembly.native)
    for kinds in ({"transient"}, {"periodic", "transient"}):
        offered = state.assembly.options(replace(scales, kinds=frozenset(kinds)))
        assert "periodic_force" not in {o.candidate.effect for o in offered}
    assert "drifting_force" not in {o.candidate.effect for o in state.assembly.options(scales)}


RATE, HUM, OWN = 0.05, 0.3, 4.37


def pushed(rng, unmeasured, span=12.0, step=0.01):
    """A hardening spring under a sum of sines that nothing repeats, and a force nobody measured."""
    time = np.arange(0.0, span, step)
    frequencies, phases = rng.uniform(0.3, 2.5, 12), rng.uniform(0, 2 * np.pi, 12)

    def push(t):
        return 0.15 * np.sin(2 * np.pi * np.outer(t, frequencies) + phases).sum(axis=1)

    def rates(t, s):
        force = push(np.atleast_1d(t))[0] + unmeasured(t)
        return [s[1], force - SPRING * s[0] - DRAG * s[1] - HARDENING * s[0] ** 3]

    found = solve_ivp(rates, (0, time[-1]), [0.0, 0.0], "DOP853", time, rtol=1e-8, atol=1e-11)
    return time, push(time), found.y[0] + 2e-5 * rng.standard_normal(time.size)


def written(folder, runs):
    channels = {"force": ("f_N", "N"), "displacement": ("x_mm", "mm")}
    write_campaign(folder, name="pushed", channels=channels, runs=runs, overwrite=True)
    return reduce_campaign(load_campaign(folder), jobs=1)


def shaken(folder, unmeasured, shown=lambda t, k: 0.0 * t):
    """Three transients, from rest; the model's start is estimated. The sensor shows something more
    than the motion."""
    runs = []
    for k, (label, role) in enumerate((("a", "fit"), ("b", "fit"), ("c", "hold-out"))):
        time, force, x = pushed(np.random.default_rng(k), lambda t, k=k: unmeasured(t, k))
        samples = {"force": force, "displacement": x + shown(time, k)}
        runs.append(SimulatedRun(label, time, samples, role=role, kind="transient"))
    roles = assign(written(folder, runs).records)
    return fit_state(Assembly(system("duffing"), starts=True), roles, NUMERICS), roles


@pytest.mark.slow
def test_a_force_that_drifts_in_a_transient_is_first_with_its_rate(tmp_path):
    state, _ = shaken(tmp_path, lambda t, _: RATE * t)
    found, failed = scored(state)
    assert found[0].option.key == ("drifting_force", "position")
    # It pushes, and a resisting force is positive.
    assert found[0].expected[0] == pytest.approx(-RATE, rel=0.05)
    assert not [k for k in failed if k.startswith("drifting_force")]


@pytest.mark.slow
def test_a_hum_in_transients_is_named_with_frequency_and_size(tmp_path):
    """Its phase differs from run to run."""
    _, roles = shaken(tmp_path, lambda t, k: HUM * np.cos(2 * np.pi * OWN * t + 2.0 * k))
    assembly = Assembly(system("duffing"), starts=True)
    few = tuple(map(find_effect, ("humming_force", "coulomb_friction", "quintic_stiffness")))
    loop = close_loop(assembly, roles, NUMERICS, effects=few, max_effects=1, nonparametric=False)
    assert loop.effects == ("humming_force",)
    point = loop.final.fit.point
    where = loop.final.fit.problem.names.index("humming_force_frequency")
    assert abs(point.theta[where] - OWN) < 4 * point.sd[where] < 2e-3
    for run in "ab":
        size = np.hypot(*(point[f"humming_force_{part}[{run}]"] for part in ("cosine", "sine")))
        assert size == pytest.approx(HUM, rel=0.02)


@pytest.mark.slow
def test_a_hum_of_the_sensor_is_no_force(tmp_path):
    """Mains in a channel, below the resonance where both could be meant, and above it."""
    size = 2e-4
    for where, own in enumerate((1.1, 7.3)):
        _, roles = shaken(
            tmp_path / str(where),
            lambda t, k: 0.0,
            lambda t, k, own=own: size * np.cos(2 * np.pi * own * t + 2.0 * k),
        )
        assembly = Assembly(system("duffing"), starts=True)
        few = tuple(map(find_effect, ("humming_force", "sensor_hum", "coulomb_friction")))
        loop = close_loop(
            assembly, roles, NUMERICS, effects=few, max_effects=1, nonparametric=False
        )
        assert loop.effects == ("sensor_hum",)
        point = loop.final.fit.point
        for run in "ab":
            parts = (f"sensor_hum_{part}_displacement[{run}]" for part in ("cosine", "sine"))
            found = np.hypot(*(point[name] for name in parts))
            assert found == pytest.approx(size, rel=0.02)


@pytest.mark.slow
def test_what_does_not_hum_is_not_offered_a_frequency(tmp_path):
    state, _ = shaken(tmp_path, lambda t, _: 0.0)
    scales = scales_of(state.fit, None, state.assembly.native)
    assert scales.dominant_frequency is None
    offered = {option.candidate.effect for option in state.assembly.options(scales)}
    assert not {"humming_force", "sensor_hum"} & offered


def test_a_line_is_found_at_its_frequency_and_noise_has_none():
    rng, step, size = np.random.default_rng(1), 0.01, 2000
    time = step * np.arange(size)
    alarms = 0
    for _ in range(200):
        found = line_of(rng.standard_normal(size), [], step)
        alarms += found[0] < 0.01
    # Of two hundred with the probability 0.01, more than eight come once in a thousand times.
    assert alarms <= 8
    loud = np.cos(2 * np.pi * 17.123 * time) + rng.standard_normal(size)
    p, frequency = line_of(loud, [], step)
    assert p < 1e-6
    assert frequency == pytest.approx(17.123, abs=0.01)
    p, _ = line_of(
        loud, [np.cos(2 * np.pi * 17.123 * time) + 0.1 * rng.standard_normal(size)], step
    )
    assert p > 1e-3, "what the drive has is no hum"


def test_an_equation_in_time_is_refused_of_a_periodic_run_by_name(tmp_path):
    model = system("duffing").with_term("equation", "position", "drift", "0.1*time")
    reduced = oscillator_campaign(tmp_path, restoring=lambda x, v: 100 * x + v)
    with pytest.raises(ModelError, match=r"depends on time.*run a is periodic"):
        fitted(reduced, model)


@pytest.mark.parametrize("bare", ["fitted", "held out"])
def test_a_drive_without_its_first_harmonic_gives_no_phase(hum, bare):
    """A multisine seldom has one. The others of the catalogue are looked at all the same."""

    def without_first(record):
        item = record.harmonics["displacement"]
        kept = item.orders != 1
        names = ("orders", "coefficients", "variances")
        parts = {name: getattr(item, name)[kept] for name in names}
        return replace(
            record, harmonics={**record.harmonics, "displacement": replace(item, **parts)}
        )

    chosen = "fit" if bare == "fitted" else "hold-out"
    records = tuple(without_first(r) if r.role == chosen else r for r in hum.records)
    roles = assign(records)
    base = fit_state(Assembly(damper()), roles, NUMERICS)
    scores, failed = score_candidates(base.base(), base.assembly, FEW, 1)
    named = {score.option.candidate.effect for score in scores}
    assert "coulomb_friction" in named
    assert ("periodic_force" in named) is (bare == "held out")
    # The errors of a catalogue are those of the others, in the runs where they can be.
    found = signatures_of(
        base.fit, base.assembly, noise_of(base.fit), effects=FEW, held_out=base.held_out, jobs=1
    )
    assert any("coulomb_friction" in name for name in found.names)
    assert any("periodic_force" in name for name in found.names) is (bare == "held out")
    if bare == "fitted":
        (reason,) = [text for name, text in failed.items() if name.startswith("periodic_force")]
        assert reason == "run a: displacement has no first harmonic, whose phase it needs"
        return
    loop = close_loop(Assembly(damper()), roles, NUMERICS, effects=FEW[:1], nonparametric=False)
    assert "periodic_force" not in loop.effects
    assert "displacement has no first harmonic" in loop.rounds[0].reason
