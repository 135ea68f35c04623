"""What to measure next: on rivals that small motions cannot tell apart, and large ones can."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from small_campaigns import damper, damper_campaign, oscillator_campaign

import bayesoleo._kept_processes as kept_processes
import bayesoleo._process_messages as messages
import bayesoleo._worker_processes as processes
from bayesoleo.discovery import _next_experiment
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._next_experiment import expected_noise, propose_runs
from bayesoleo.discovery._open_questions import named, rivals_of, standing
from bayesoleo.discovery._predicted_experiment import POINTS, Limits, Motion, Rival, planned_runs
from bayesoleo.discovery._round import examine
from bayesoleo.discovery._state import fit_state
from bayesoleo.discovery._varied_runs import REACH, stretched, varied_runs
from bayesoleo.effects import find_effect
from bayesoleo.errors import InputError
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction import _transient_run
from bayesoleo.prediction._records import transient_record
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.systems import system

FREE = (-np.inf, np.inf)
STIFFNESS, NOISE = 1000.0, 40.0
#: One amplitude: a linear and a cubic spring differ by a third harmonic below the noise.
RUNS = (("a", 1.0, 0.010, "fit"), ("b", 2.0, 0.010, "fit"), ("c", 1.5, 0.010, "hold-out"))


def truth(x, v, t):
    return 200 * v + STIFFNESS * x


def examined(reduced, model, *effects):
    state = fitted(reduced, model)
    return examine(
        state,
        _roles(reduced),
        NUMERICS,
        effects=[find_effect(name) for name in effects],
        seed=0,
        limit="ranked only",
        callback=lambda _: None,
    )


def _roles(reduced):
    from bayesoleo.discovery._assembly import assign

    return assign(reduced.records)


@pytest.fixture(scope="module")
def springs(tmp_path_factory):
    """Linear or cubic stiffness, one of them missing in the model."""
    folder = tmp_path_factory.mktemp("springs")
    reduced = damper_campaign(folder, truth, runs=RUNS, noise=NOISE, periods=16)
    model = damper(cubic=False, linear=False)
    outcome = examined(reduced, model, "linear_stiffness", "cubic_stiffness")
    chosen = named(outcome, ["linear_stiffness", "cubic_stiffness"])
    rivals, failed = rivals_of(outcome, chosen, NUMERICS)
    assert not failed
    return reduced, outcome, rivals


@pytest.fixture(scope="module")
def proposals(springs):
    reduced, outcome, rivals = springs
    limits = Limits.of(reduced.records, "displacement", ("force",))
    limits = limits.given({"amplitude": (0.005, 0.05), "force": FREE})
    return propose_runs(rivals, reduced.records, outcome.before.fit_errors, limits, jobs=1)


def test_a_round_keeps_no_columns_that_have_served(springs):
    _, outcome, _ = springs
    assert len(outcome.ranking) == 2
    for item in outcome.ranking:
        assert item.score.columns.base is None
        assert item.score.columns.size == 0 < item.score.contribution.size


def test_springs_alike_in_small_motions_are_told_apart_by_a_large_one(proposals):
    best = proposals.trials[0]
    assert best.amplitude == pytest.approx(0.05)
    assert best.separation.weakest > 8
    assert all(trial.separation.weakest < 2.5 for trial in proposals.repeats)
    assert proposals.inseparable == ()


def test_without_larger_motions_the_best_run_is_hardly_better_than_those_made(springs):
    reduced, outcome, rivals = springs
    found = propose_runs(rivals, reduced.records, outcome.before.fit_errors, jobs=1)
    made = found.best_repeat.separation.weakest
    assert found.trials[0].separation.weakest < 1.5 * made


def test_the_shortlist_has_one_run_a_frequency_and_is_ordered(proposals):
    short = proposals.shortlist(4)
    assert len({trial.frequency for trial in short}) == len(short) == 4
    information = [trial.information for trial in proposals.trials]
    assert information == sorted(information, reverse=True)


def test_the_run_made_as_proposed_tells_as_much_as_was_foreseen(springs, tmp_path):
    """The rivals' log Bayes factor on data of the new run, simulated without the package.

    Each rival predicts the new run with what the campaign knows of it: its evidence there is a
    normal density over the raw samples.
    """
    reduced, outcome, rivals = springs
    limits = Limits.of(reduced.records, "displacement", ("force",))
    amplitude = 0.022
    limits = limits.given(
        {"amplitude": (amplitude, amplitude), "frequency": (1.0, 1.0), "force": FREE}
    )
    errors = outcome.before.fit_errors
    # The better rival leaves nothing but noise; the present model, without a spring, does.
    rested = replace(
        errors, entries=tuple(replace(e, average=replace(e.average, repeating=0.0))
                              for e in errors.entries)
    )  # fmt: skip
    found = propose_runs(rivals, reduced.records, rested, limits, jobs=1)
    (trial,) = found.trials
    expected = trial.separation.log_bayes_factor[0, 1]
    assert expected > 3
    factors = []
    for seed in range(6):
        new = damper_campaign(
            tmp_path / str(seed),
            truth,
            runs=(("next", 1.0, amplitude, "fit"),),
            noise=NOISE,
            periods=16,
            seed=100 + seed,
        ).records[0]
        factors.append(_log_evidence(rivals[0], new) - _log_evidence(rivals[1], new))
    # The mean of six, each of which scatters by about its root of twice the mean; what the campaign
    # happened to say of the true parameter moves them all alike, by about as much as one does.
    scatter = np.sqrt(2 * expected) * np.sqrt(1 + 1 / 6)
    assert abs(np.mean(factors) - expected) < 3 * scatter
    assert np.mean(factors) > 0.3 * expected


def _log_evidence(rival, record):
    """Log density of a run's samples, the parameters normal as estimated."""
    from bayesoleo.prediction._predictor import Predictor

    predictor = Predictor(rival.fit.model, [record], backend="numpy", jobs=1)
    theta = np.array([rival.fit.values[name] for name in predictor.layout.names])
    run = predictor.evaluate(theta)[0]
    e, J = (record.samples["force"] - run.y[0]) / NOISE, run.sensitivity[0] / NOISE
    order = [rival.fit.problem.names.index(name) for name in predictor.layout.names]
    C = rival.fit.point.covariance[np.ix_(order, order)]
    inner = np.linalg.inv(C) + J @ J.T
    moved = J @ e
    log_determinant = np.linalg.slogdet(inner)[1] + np.linalg.slogdet(C)[1]
    return -0.5 * (e @ e - moved @ np.linalg.solve(inner, moved) + log_determinant)


def test_a_motion_beyond_the_limits_is_not_proposed(springs):
    reduced, outcome, rivals = springs
    limits = Limits.of(reduced.records, "displacement", ("force",))
    wide = limits.given({"amplitude": (0.005, 0.05), "rate": (0.0, 0.2), "travel": (-0.03, 0.03)})
    for run in planned_runs(wide, reduced.records, "displacement"):
        move = Motion.of_signal(run.waveform, run.frequency)
        assert move.rate <= 0.2 * (1 + 1e-6)
        assert move.highest <= 0.03 * (1 + 1e-6)
        assert move.lowest >= -0.03 * (1 + 1e-6)
    narrow = wide.given({"force": (-20.0, 20.0)})
    found = propose_runs(rivals, reduced.records, outcome.before.fit_errors, narrow, jobs=1)
    assert sum(found.left_out.values()) > 0
    assert len(found.trials) < len(planned_runs(narrow, reduced.records, "displacement"))


@pytest.mark.slow
def test_a_force_driven_oscillator_is_served_too(tmp_path):
    """A spring that hardens, or two: what is softer or harder in small motions shows in large."""
    reduced = oscillator_campaign(
        tmp_path,
        restoring=lambda x, v: 0.8 * v + 100.0 * x + 3e4 * x**3,
        runs=(("a", 1.0, 2.0, "fit"), ("b", 2.1, 3.0, "fit"), ("c", 1.8, 2.0, "hold-out")),
    )
    model = system("linear_oscillator")
    outcome = examined(reduced, model, "cubic_stiffness", "quintic_stiffness")
    rivals, failed = rivals_of(outcome, outcome.ranking, NUMERICS)
    assert not failed
    limits = Limits.of(reduced.records, "force", ("displacement",)).given(
        {"amplitude": (0.5, 4.0), "displacement": FREE}
    )
    found = propose_runs(rivals, reduced.records, outcome.before.fit_errors, limits, jobs=1)
    assert found.drive == "force"
    assert found.trials[0].separation.weakest > found.trials[-1].separation.weakest
    # A large swing needs a large force, or one near the resonance at 1.6 Hz.
    swing = [trial.amplitude for trial in found.trials]
    assert swing[0] > np.median(swing)


def test_candidates_left_open_by_a_round_are_its_rivals(springs):
    _, outcome, _ = springs
    names = [item.effect for item in standing(outcome)]
    assert sorted(names) == ["cubic_stiffness", "linear_stiffness"]


def test_one_rival_is_no_question(springs):
    reduced, outcome, rivals = springs
    with pytest.raises(InputError, match="fewer than two rivals"):
        propose_runs(rivals[:1], reduced.records, outcome.before.fit_errors)


@pytest.mark.parametrize(
    ("means", "planned"), [((-1e-2, 3e-2), 0.0), ((1e-4, 3e-4), 0.0), ((0.01, 0.012), 0.011)]
)
def test_the_noise_of_a_mean_is_not_asked_of_a_rig(means, planned):
    record = record_of(system("duffing"), RunPlan("a", 1.0, {"force": motion(0.0, [1.0])}))
    limits = Limits((1.0, 1.0), (1.0, 1.0), means, (-2.0, 2.0), (0.0, 100.0))
    (run,) = planned_runs(limits, [record], "force")
    assert run.mean == pytest.approx(planned)


def test_probabilities_weigh_the_rivals(springs):
    """What is nearly decided leaves little to be told."""
    reduced, outcome, rivals = springs
    errors = outcome.before.fit_errors
    sure = [replace(rivals[0], weight=0.98), replace(rivals[1], weight=0.02)]
    equal, weighted = (propose_runs(r, reduced.records, errors, jobs=1) for r in (rivals, sure))
    assert weighted.weights == pytest.approx((0.98, 0.02))
    assert weighted.entropy < 0.15 < equal.entropy == pytest.approx(1.0)
    assert all(trial.information <= weighted.entropy for trial in weighted.trials)
    assert weighted.trials[0].information < equal.trials[0].information


def test_the_noise_of_a_new_run_has_the_colour_of_the_measured_one(tmp_path):
    """Against the spectrum of an AR(1) process, by frequency."""
    coefficient, size, periods, per_period = 0.9, 5.0, 40, 100.37
    reduced = damper_campaign(
        tmp_path, truth, runs=RUNS[:2], noise=size, periods=periods, coloured=coefficient
    )
    state = fit_state(Assembly(damper(cubic=False)), _roles_of(reduced.records), NUMERICS)
    noise = expected_noise(state.fit_errors, reduced.records[:1])["force"]
    hertz = np.array([2.0, 5.0, 10.0, 20.0])  # of a run at 1 Hz
    turn = np.exp(-2j * np.pi * hertz / per_period)
    density = size**2 * (1 - coefficient**2) / np.abs(1 - coefficient * turn) ** 2
    expected = POINTS * density / (periods * per_period)
    found = np.interp(hertz, noise.frequency, noise.variance)
    # A level is a mean over some forty lines, known to a fifth, and is drawn towards white noise.
    np.testing.assert_allclose(found, expected, rtol=0.6)
    assert found[0] > 10 * found[-1]


def two_inputs(reduced):
    """The damper with a second measured input, and records with it."""
    one = damper(cubic=False)
    terms = {**one.outputs["force"].terms, "warm": "warm*temperature"}
    two = replace(
        one,
        inputs={"displacement": "m", "temperature": "K"},
        outputs={"force": Output(terms, "N")},
        parameters={**one.parameters, "warm": Parameter(1.0, "N/K", sd=100.0)},
    )
    records = [
        replace(
            record,
            samples={**record.samples, "temperature": 100 * record.samples["displacement"]},
            harmonics={
                **record.harmonics,
                "temperature": replace(
                    record.harmonics["displacement"],
                    coefficients=100 * record.harmonics["displacement"].coefficients,
                ),
            },
            signal_noise={**record.signal_noise, "temperature": 0.0},
        )
        for record in reduced.records
    ]
    return two, records


def test_of_two_inputs_the_phase_is_varied(springs):
    """Inputs in phase cannot tell their parameters apart; another phase does."""
    reduced, outcome, _ = springs
    model, records = two_inputs(reduced)
    fit = fit_model(model, records, NUMERICS)
    rival, errors = Rival("two inputs", fit), outcome.before.fit_errors
    found = propose_runs([rival], records, errors, aim="warm", jobs=1)
    best = found.trials[0]
    assert found.drive == ""
    assert "cycles ahead" in best.change
    assert best.information > found.best_repeat.information + 1
    swings = {name: max(np.ptp(r.samples[name]) for r in records) for name in model.inputs}
    for item in varied_runs(records, model, ("force",)):
        for name, swing in swings.items():
            # A finite grid of a period finds the extremes to a few parts in a thousand.
            assert np.ptp(item.record.samples[name]) <= REACH * swing * 1.01


def free_decay(label, start, stiffness=100.0):
    """A mass on a spring with a damper, let go at a distance from its rest."""
    time = np.arange(400) * 0.01
    rate, omega = 0.4, np.sqrt(stiffness - 0.16)
    x = start * np.exp(-rate * time) * (np.cos(omega * time) + rate / omega * np.sin(omega * time))
    noise = 1e-3 * np.random.default_rng(len(label)).standard_normal(time.size)
    return transient_record(label, time, {"displacement": x + noise})


def decay_model():
    return Model(
        "decay",
        dofs={"x": Dof("m")},
        equations={
            "x": {"inertia": "mass*ddot(x)", "damper": "damping*dot(x)", "spring": "stiffness*x"}
        },
        outputs={"displacement": Output({"x": "x"}, "m")},
        parameters={
            "mass": Parameter(1.0, "kg", fixed=True),
            "damping": Parameter(1.0, "N*s/m", sd=1.0),
            "stiffness": Parameter(90.0, "N/m", sd=50.0),
        },
    )


def test_a_transient_is_varied_by_its_start():
    records = [free_decay("a", 0.1), free_decay("bb", 0.2)]
    state = fit_state(Assembly(decay_model()), _roles_of(records), NUMERICS)
    rival = Rival("decay", state.fit)
    found = propose_runs([rival], records, state.fit_errors, aim="stiffness", jobs=1)
    best = found.trials[0]
    assert best.like
    factor, _, what = best.change.partition(" times its ")
    assert what == "distance from rest at the start"
    assert float(factor) > 0
    # The information on the stiffness rises with the square of the start: the largest is best.
    largest = max(found.trials, key=lambda t: _start_of(t, {"a": 0.1, "bb": 0.2}))
    assert _start_of(best, {"a": 0.1, "bb": 0.2}) == pytest.approx(
        _start_of(largest, {"a": 0.1, "bb": 0.2}), rel=0.05
    )
    assert _start_of(best, {"a": 0.1, "bb": 0.2}) <= REACH * 0.2 * 1.05
    assert best.information > found.best_repeat.information


def test_words_say_of_what_a_variation_is_a_multiple():
    """Against the records that are made: of where the run began that one is like, and how long."""
    records = {label: free_decay(label, begun) for label, begun in (("a", 0.1), ("bb", 0.002))}
    pushed = {
        label: replace(
            record,
            samples=record.samples | {"push": (1.0 + k) * (record.time - record.time[0])},
            smoothed=record.smoothed | {"push": _ramp(record, 1.0 + k)},
            signal_noise={**record.signal_noise, "push": 0.0},
        )
        for k, (label, record) in enumerate(records.items())
    }
    model = replace(decay_model(), inputs={"push": "N"})
    found, seen = varied_runs(list(pushed.values()), model, ("place",)), set()
    for item in found:
        like, made = pushed[item.like], item.record
        sizes = {
            "distance from rest at the start": item.start,
            "duration": made.span / like.span,
            "change of push since the first sample": np.ptp(made.samples["push"])
            / np.ptp(like.samples["push"]),
        }
        told = dict(part.split(" times its ")[::-1] for part in item.change.split(", "))
        seen |= set(told)
        for what, size in sizes.items():
            # Three digits are told; what differs from one by less than a fiftieth is not.
            assert float(told.get(what, 1.0)) == pytest.approx(size, rel=0.021)
    assert seen == set(sizes)


def _ramp(record, slope):
    from bayesoleo.prediction._band_limited import band_limited

    step = float(record.time[1] - record.time[0])
    return band_limited(slope * (record.time - record.time[0]), step)


@pytest.mark.parametrize("labels", [("a",), ("a", "bb")])
def test_no_variation_of_a_transient_is_judged_twice(labels):
    """A single run's range is its own, and without a start there is none to vary."""
    time = np.arange(400) * 0.01
    driven = replace(
        decay_model(),
        inputs={"push": "N"},
        equations={
            "x": {**decay_model().equations["x"], "push": "-push"},
        },
    )
    records = [
        transient_record(
            label, time, {"displacement": np.zeros(400), "push": np.sin((3 + len(label)) * time)}
        )
        for label in labels
    ]
    for model in (driven, replace(driven, dofs={"x": Dof("m", initial="displacement")})):
        found = varied_runs(records, model, ("displacement",))
        told = [(item.like, item.change) for item in found]
        assert len(set(told)) == len(told)
        # Three amplitudes and durations of each, without the run as it was measured; where the
        # range is that of one run, its own values are the middle ones.
        assert len(told) == len(labels) * (3 * 3 - 1)


def test_variations_of_a_held_out_transient_begin_with_its_motion(monkeypatch):
    """One integration for the run itself; the same figures as with one for each variation."""
    records = [free_decay("a", 0.1), free_decay("bb", 0.2)]
    state = fit_state(Assembly(decay_model()), _roles_of(records[:1]), NUMERICS)
    integrate, counts, told = _transient_run.integrate, [], []

    def counted(*given):
        counts[-1] += 1
        return integrate(*given)

    monkeypatch.setattr(_transient_run, "integrate", counted)
    for begins in (True, False):
        if not begins:
            monkeypatch.setattr(_next_experiment, "solved_like", lambda *_: None)
        counts.append(0)
        rivals = [Rival("decay", state.fit)]
        found = propose_runs(rivals, records, state.fit_errors, aim="stiffness", jobs=1)
        told.append({(t.like, t.change): t.information for t in found.trials})
    assert any(like == "bb" for like, _ in told[0])
    assert counts[0] == 1 < counts[1]
    assert told[0].keys() == told[1].keys()
    for key, value in told[0].items():
        # Two meshes: what either leaves of the solution.
        assert value == pytest.approx(told[1][key], rel=1e-3, abs=1e-6)


@pytest.mark.slow
def test_another_process_judges_runs_alike(monkeypatch):
    """Each finds where variations begin by itself."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(processes, "WORTH_ASKING", 0.0)
    records = [free_decay("a", 0.1), free_decay("bb", 0.2)]
    state = fit_state(Assembly(decay_model()), _roles_of(records[:1]), NUMERICS)
    read, asked, told = processes.content_of, [], []

    def counted(answer, known=()):
        found = read(answer, known)
        asked.append(found[0])
        return found

    def slowly(*given):
        time.sleep(0.2)  # so that the other process gets a share
        return predictive_distribution(*given)

    predictive_distribution = _next_experiment.predictive_distribution
    monkeypatch.setattr(_next_experiment, "predictive_distribution", slowly)
    monkeypatch.setattr(processes, "content_of", counted)
    try:
        worker = kept_processes.process_of(0, processes.OF_A_SEARCH)
        worker.ask(messages.dumps((None, None, None)))  # it answers once it has begun
        for jobs in (2, 1):
            asked.clear()
            rivals = [Rival("decay", state.fit)]
            found = propose_runs(rivals, 2 * records, state.fit_errors, aim="stiffness", jobs=jobs)
            told.append([(t.like, t.change, t.label, t.information) for t in found.trials])
            assert ("value" in asked) is (jobs == 2)
    finally:
        kept_processes.end_processes()
    assert told[0] == told[1]


def _start_of(trial, starts):
    factor = float(trial.change.partition(" ")[0]) if "start" in trial.change else 1.0
    return factor * starts[trial.like]


def _roles_of(records):
    from bayesoleo.discovery._assembly import Roles

    return Roles(tuple(records), (), "all", ())


def test_where_nothing_moves_it_is_said(springs):
    reduced, _, _ = springs
    model, records = two_inputs(reduced)
    still = [
        replace(r, samples={name: np.zeros_like(v) for name, v in r.samples.items()})
        for r in records
    ]
    with pytest.raises(InputError, match="no input moves"):
        varied_runs(still, model, ("force",))


def test_a_curve_is_scaled_about_a_value_and_stretched_in_time():
    time = np.arange(200) * 0.01
    record = transient_record("a", time, {"x": np.sin(8 * time)})
    curve = record.smoothed["x"]
    found = stretched(curve, 1.5, 0.2, 2.0)
    inside = np.linspace(0.3, 1.6, 50)
    for derivative in (0, 1, 2):
        expected = 1.5 * curve.at(inside, derivative) / 2.0**derivative
        if derivative == 0:
            expected = expected - 0.1
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found.at(2.0 * inside, derivative), expected, atol=1e-9 * scale)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"stroke": (0, 1)}, "no such limit.*amplitude, frequency, mean"),
        ({"amplitude": (2.0, 1.0)}, "wrong way round"),
    ],
)
def test_limits_that_make_no_sense_are_refused(springs, given, message):
    limits = Limits.of(springs[0].records, "displacement", ("force",))
    with pytest.raises(InputError, match=message):
        limits.given(given)
