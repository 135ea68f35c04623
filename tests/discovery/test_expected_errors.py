"""The error that a run should show if nothing is missing: by its noise and by the unknowns'."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from scipy import stats
from small_campaigns import damper, damper_campaign, oscillator_campaign, spring_damper_force

from bayesoleo import _schema as schema
from bayesoleo.data import periodic_average
from bayesoleo.data._noise import local_average
from bayesoleo.discovery._assembly import Assembly, RecordNoise, assign
from bayesoleo.discovery._expected_error import (
    LinearisedRun,
    _left,
    _own_response,
    expected_of_fitted,
)
from bayesoleo.discovery._fit_and_hold_out_error import (
    ErrorTable,
    RunError,
    least_noise,
    limit,
    lowest,
    too_quiet,
    with_same_noise,
)
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import _of_draws, borne_out
from bayesoleo.model import Model, Output, Parameter

FEW = (("a", 1.0, 0.003, "fit"), ("b", 1.5, 0.003, "fit"), ("c", 1.0, 0.012, "hold-out"))


def noise_entry(seed: int = 0, ratio: float = 1.0, **more: object) -> RunError:
    noise = np.random.default_rng(seed).standard_normal(400)
    average = periodic_average(noise, 0.01, 1.0)
    average = replace(average, repeating=ratio * average.noise)
    return RunError("a", "fit", "force", 1.0, average, 0.0, **more)


@pytest.mark.statistical
def test_the_squared_ratio_is_one_on_average(tmp_path):
    """A force law that is linear in its parameters, so that nothing is approximate: fitted runs of
    a few samples lend a good part of their noise, small ones leave the cubic part to its prior."""
    fit, hold, plain = [], [], []
    rng = np.random.default_rng(0)
    for seed in range(80):
        cubic = rng.normal(1.0e6, 1e6)

        def force(x, v, t, cubic=cubic):
            return 200.0 * v + 1000.0 * x + cubic * x**3

        model = damper().with_parameters(cubic=Parameter(1.0e6, "N/m**3", sd=1e6))
        state = fitted(
            damper_campaign(
                tmp_path, force, seed=seed, noise=0.05, runs=FEW, periods=3, per_period=20.37
            ),
            model,
        )
        fit += [entry.ratio_to_expected**2 for entry in state.fit_errors.entries]
        hold += [entry.ratio_to_expected**2 for entry in state.hold_errors.entries]
        plain += [entry.ratio**2 for entry in state.hold_errors.entries]
    assert np.mean(plain) > 5.0, "the parameters have to matter"
    for squares in (fit, hold):
        assert np.mean(squares) == pytest.approx(
            1.0, abs=3.5 * np.std(squares) / len(squares) ** 0.5
        )


def test_an_exact_model_lacks_nothing_where_its_parameters_are_poorly_known(tmp_path):
    """Fitted far below the resonance, held out near it: the error there is the parameters'."""
    runs = (("slow", 0.3, 2.0, "fit"), ("fast", 1.55, 2.0, "hold-out"))
    reduced = oscillator_campaign(
        tmp_path, restoring=lambda x, v: 100.0 * x + 0.8 * v, runs=runs, noise=1e-4, seed=1
    )
    model = Model(
        "linear oscillator",
        inputs={"force": "N"},
        dofs={"position": "m"},
        parameters={
            "mass": Parameter(1.0, "kg", fixed=True),
            "damping": Parameter(1.0, "N*s/m", relative_sd=0.5),
            "stiffness": Parameter(90.0, "N/m", relative_sd=0.5),
        },
        equations={
            "position": "mass*ddot(position) + damping*dot(position) + stiffness*position - force"
        },
        outputs={"displacement": Output("position", "m")},
    )
    loop = close_loop(Assembly(model), assign(reduced.records), NUMERICS, effects=())
    entry = loop.final.hold_errors.at("displacement", "fast")
    assert entry.ratio > 3.0
    assert entry.ratio_to_expected < 2.0  # of chance, once in twenty times more
    assert entry.expected == pytest.approx(entry.repeating / entry.ratio_to_expected)
    assert loop.verdict == schema.NOTHING_MISSING


def test_what_is_missing_shows_on_fitted_runs_however_vague_the_prediction_of_others(tmp_path):
    """The cubic part is nearly unknown, so that anything is expected of the large run; friction
    shows on the small ones."""

    def force(x, v, t):
        return spring_damper_force(x, v, t) + 0.3 * np.sign(v)

    state = fitted(damper_campaign(tmp_path, force, noise=0.05, runs=FEW), damper())
    assert state.fit_errors.worst_ratio(key="ratio_to_expected") > 3.0
    assert not state.at_floor


def test_where_one_direction_rules_the_limit_is_that_of_one_squared_normal_variate():
    ruled = noise_entry(parameters=np.array([[1.0]]), own_share=1e-6)
    assert limit([ruled]) ** 2 == pytest.approx(stats.chi2.isf(1e-3, 1), rel=0.01)
    # Two runs with the same unknown are no more certain than one.
    assert limit([ruled, ruled]) == pytest.approx(limit([ruled]), rel=0.01)


def test_of_noise_alone_the_limits_are_those_of_an_f_variate():
    entry = noise_entry()
    coefficients, free = entry.coefficients, entry.free
    assert limit([entry]) ** 2 == pytest.approx(stats.f.isf(1e-3, coefficients, free))
    assert lowest([entry]) ** 2 == pytest.approx(stats.f.ppf(1e-3, coefficients, free))


def test_half_noise_and_half_one_direction_have_the_quantile_of_their_mixture():
    """Against the mixture itself, drawn; the tail of so few draws is known to a tenth."""
    entry = noise_entry(parameters=np.array([[0.5]]), own_share=0.5)
    rng, count = np.random.default_rng(1), entry.coefficients
    size = 400_000
    own = rng.chisquare(count, size) / count / (rng.chisquare(entry.free, size) / entry.free)
    drawn = 0.5 * rng.chisquare(1, size) + 0.5 * own
    assert limit([entry]) ** 2 == pytest.approx(np.quantile(drawn, 0.999), rel=0.1)


def test_less_than_chance_allows_is_told_with_its_figures():
    table = ErrorTable((noise_entry(ratio=0.16),))
    (sentence,) = too_quiet(table)
    assert "0.16 times the expected" in sentence
    assert "measured too large" in sentence
    assert not too_quiet(ErrorTable((noise_entry(ratio=0.9),)))


def test_differences_know_the_noise_as_well_as_they_say():
    """Over white noise: the scatter of the estimated variance is that of so many independent
    samples or a little less, whichever order of differences was chosen."""
    rng = np.random.default_rng(4)
    found = [local_average(rng.standard_normal(500)) for _ in range(600)]
    variances = np.array([item.sigma**2 for item in found])
    shown = 2.0 * np.mean(variances) ** 2 / np.var(variances)
    assert found[0].free < 1.1 * shown
    assert shown < 500 / 1.7
    squares = np.array([item.ratio**2 for item in found])
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)


def test_a_poorly_known_run_may_be_predicted_well_by_chance():
    """Nine tenths of what is expected are one unknown's, which may happen to be right."""
    vague = noise_entry(parameters=np.array([[0.9]]), own_share=0.1)
    sharp = noise_entry()
    assert lowest([vague]) == pytest.approx(np.sqrt(0.1) * lowest([sharp]))
    assert lowest([vague, vague]) > lowest([vague])


def _input_columns(seed: int = 3) -> np.ndarray:
    """Forty harmonics with rising power, as a model that differentiates makes them."""
    phase = np.arange(400) / 100.0
    orders = np.arange(1, 41)
    turn = 2 * np.pi * np.outer(orders, phase)
    columns = np.concatenate([orders[:, None] * np.cos(turn), orders[:, None] * np.sin(turn)])
    return columns[None]


def test_input_noise_that_the_residual_bears_out_counts_in_full():
    """Real noise of the input in the residual: cut down at most by chance, once in a thousand."""
    columns, rng = _input_columns(), np.random.default_rng(0)
    scales = [
        borne_out(columns, [rng.standard_normal(80) @ columns[0] + rng.standard_normal(400)])
        for _ in range(200)
    ]
    assert np.sum(np.array(scales) < 1.0) <= 2


@pytest.mark.parametrize("rank", [1, 3, 8])
def test_draws_that_resemble_each_other_scatter_as_few_coefficients(rank):
    """A contact amplifies what came before it: all noise then moves the output along few curves."""
    rng = np.random.default_rng(rank)
    shapes = rng.standard_normal((rank, 400))
    lines = np.fft.rfft(rng.standard_normal((16, rank)) @ shapes)
    # Sixteen draws tell a covariance's square to about 15 %; shapes have about the same length.
    assert _of_draws(lines) == pytest.approx(rank, rel=0.35)
    white = np.fft.rfft(rng.standard_normal((16, 400)))
    assert _of_draws(white) > 300.0


def test_noise_along_few_curves_is_seldom_cut_down_by_chance():
    """A residual may happen to have nothing along the one curve that carries the power."""
    rng, cut = np.random.default_rng(0), 0
    for _ in range(300):
        shape = np.cumsum(rng.standard_normal((2, 400)), axis=1)
        columns = (rng.standard_normal((16, 2)) @ shape)[None] / 4.0
        residual = rng.standard_normal(2) @ shape + 0.1 * rng.standard_normal(400)
        cut += borne_out(columns, [residual], drawn=True) < 0.5
    assert cut <= 3


def test_input_noise_that_the_residual_does_not_show_is_bounded_by_it():
    """Slow model error of any size says nothing of what would stand at high harmonics."""
    columns, rng = _input_columns(), np.random.default_rng(0)
    slow = 1e3 * np.sin(2 * np.pi * np.arange(400) / 100.0)
    left = slow + rng.standard_normal(400)
    scale = borne_out(columns, [left])
    claimed = scale * np.sqrt(np.mean(np.sum(columns[0] ** 2, axis=0)))
    # The noise is 1; a band of a few coefficients leaves a factor to chance.
    assert claimed < 3.0
    assert borne_out(columns, [np.full(400, np.nan)]) == 1.0
    assert borne_out(np.zeros((1, 0, 400)), [left]) == 1.0


def test_no_round_has_another_noise():
    """What a later model shows less of, which leaves no more, was never there."""
    loud = replace(noise_entry(ratio=4.0), input_noise=3.0, expected_error=4.0, run="a", rms=9.0)
    noise = least_noise(
        {("a", "force"): RecordNoise(1.0, 3.0, 9.0)}, {("a", "force"): RecordNoise(1, 1.0, 8.0)}
    )
    (quiet,) = with_same_noise(ErrorTable((loud,)), noise).entries
    own = loud.noise**2 - 9.0
    assert quiet.noise == pytest.approx(np.sqrt(own + 1.0))
    assert quiet.expected**2 - quiet.noise**2 == pytest.approx(16.0 - loud.noise**2)
    assert quiet.ratio_to_expected > loud.ratio_to_expected


def test_what_a_worse_model_lets_through_of_its_inputs_limits_no_better_one():
    """A declared spring that is too stiff hardly moves by the noise of the force; the true one
    does."""
    key, stiff, true = ("a", "force"), RecordNoise(1.2, 0.5, 90.0), RecordNoise(1.0, 3.0, 4.0)
    for one, other in ((stiff, true), (true, stiff)):
        assert least_noise({key: one}, {key: other}) == {key: RecordNoise(1.0, 3.0, 4.0)}
    right = replace(noise_entry(), input_noise=3.0, expected_error=4.0, run="a", rms=4.0)
    assert with_same_noise(ErrorTable((right,)), {key: stiff}).entries == (right,)
    # A model that explains as much with less has less.
    other = RecordNoise(1.0, 2.0, 4.0)
    assert least_noise({key: true}, {key: other}) == {key: other}
    (limited,) = with_same_noise(ErrorTable((right,)), {key: other}).entries
    assert limited.input_noise == 2.0


def test_the_noise_of_a_run_that_could_not_be_solved_is_not_known():
    """A later model that solves the run measures it."""
    unsolved = {("a", "force"): RecordNoise(np.nan, np.nan, np.nan)}
    later = {("a", "force"): RecordNoise(1.0, 0.5, 2.0)}
    assert least_noise({}, unsolved) == {}
    assert least_noise(unsolved, later) == later
    assert least_noise(later, unsolved) == later


def linear_run(rng, samples=60, unknowns=3):
    """Sensitivities of one run of a linear model, of unequal size."""
    return rng.standard_normal((unknowns, samples)) * np.array([1.0, 5.0, 0.2])[:, None]


def reduced_run(sensitivity, noise, weight):
    """The same as expected errors see it, with white noise of this standard deviation."""
    record = SimpleNamespace(kept=None, time=np.arange(sensitivity.shape[1]), periodic=True)
    entry = noise_entry()
    size = sensitivity.shape[1]
    entry = replace(entry, average=replace(entry.average, sigma=noise, noise=noise, number=size))
    nothing = np.zeros((1, 0, size))
    weights = np.array([weight])
    return entry, LinearisedRun.of(record, ([entry], nothing), sensitivity[None], weights)


def test_a_fitted_run_leaves_what_its_degrees_of_freedom_say():
    """White noise, weighted as it is: the residual's square is ``1 - l/n`` of the noise's."""
    sensitivity, noise = linear_run(np.random.default_rng(0)), 0.7
    entry, run = reduced_run(sensitivity, noise, noise**-2)
    response = noise**2 * np.linalg.inv(sensitivity @ sensitivity.T)
    left = _left(entry, run, 0, response, response, SearchPolicy())
    assert left.expected_error**2 == pytest.approx(noise**2 * (1 - 3 / 60))


def test_no_unknown_absorbs_more_than_one_coefficient():
    """Beside a matrix that is nearly singular, round-off had three absorb 99 % of sixty."""
    sensitivity, noise = linear_run(np.random.default_rng(0)), 0.7
    entry, run = reduced_run(sensitivity, noise, noise**-2)
    response = 30.0 * noise**2 * np.linalg.inv(sensitivity @ sensitivity.T)
    left = _left(entry, run, 0, response, 0.0 * response, SearchPolicy())
    assert left.expected_error**2 == pytest.approx(noise**2 * (1 - 3 / 60))


def test_estimates_scatter_by_the_noise_that_there_is(monkeypatch):
    """The estimator took half its standard deviation for it: ``White``'s covariance is right."""
    sensitivity, noise = linear_run(np.random.default_rng(1)), 0.7
    entry, _ = reduced_run(sensitivity, noise, 1.0)
    names = ("a", "b", "c")
    stated = (noise / 2) ** 2 * np.linalg.inv(sensitivity @ sensitivity.T)
    fit = SimpleNamespace(
        problem=SimpleNamespace(names=names),
        point=SimpleNamespace(covariance=stated, variance=np.array([(noise / 2) ** 2])),
        predictor=SimpleNamespace(layout=SimpleNamespace(names=names)),
        predictions=[SimpleNamespace(sensitivity=sensitivity[None])],
        policy=SearchPolicy(),
    )
    record = SimpleNamespace(kept=None, time=np.arange(60), periodic=True, label="a")
    fitted_run = SimpleNamespace(record=record, status=SimpleNamespace(ok=True))
    compared = ([entry], np.zeros((1, 0, 60)))
    _, known = expected_of_fitted(fit, [fitted_run], [compared])
    np.testing.assert_allclose(known[""].of(names), 4 * stated, rtol=1e-9)


def test_a_parameter_of_a_run_makes_up_for_errors_of_shared_ones():
    """Estimated again on the run, it moves as least squares of the shared ones' change says."""
    sensitivity = linear_run(np.random.default_rng(2))
    _, run = reduced_run(sensitivity, 0.7, 0.7**-2)
    own = np.array([False, True, False])
    layout = SimpleNamespace(parameters=("a", "b", "c"))
    parameter = SimpleNamespace(measured=False)
    model = SimpleNamespace(parameters=dict.fromkeys("abc", parameter))
    response, moved = _own_response(SimpleNamespace(layout=layout, model=model), run, own)
    wrong = np.array([0.3, 0.0, -2.0])
    shift = np.linalg.lstsq(sensitivity[own].T, -wrong @ sensitivity)[0][0]
    np.testing.assert_allclose(moved @ wrong, [0.3, shift, -2.0], rtol=1e-9)
    assert response[1, 1] == pytest.approx(0.49 / (sensitivity[1] @ sensitivity[1]))
