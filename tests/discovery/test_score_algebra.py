"""The score of a candidate is the refit of a linear model, in one step and without the refit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted, motion, options, scored
from scipy.linalg import toeplitz
from small_campaigns import (
    CUBIC,
    DAMPER_RUNS,
    FRICTION,
    damper,
    damper_campaign,
    oscillator_campaign,
    spring_damper_force,
)

from bayesoleo.discovery._assembly import Assembly, Roles
from bayesoleo.discovery._score_basis import Base, Block, RunBase, _prior_terms, base_of
from bayesoleo.discovery._score_tests import _directions, _directions_of, _evaluate, score_all
from bayesoleo.discovery._state import fit_state
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.model._priors import Normal
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics
from bayesoleo.prediction._run_errors import input_columns
from bayesoleo.systems import system


@pytest.fixture(scope="module")
def lacking_cubic(tmp_path_factory):
    """Spring and damper, fitted to data with a cubic spring."""
    reduced = damper_campaign(tmp_path_factory.mktemp("cubic"), spring_damper_force)
    return fitted(reduced, damper(cubic=False))


def weighted(state, columns):
    """Design matrix, observations and the fit's unknowns, each row over its run's noise."""
    rows, values = [], []
    for record in state.fit.records:
        sigma = state.fit_errors.at("force", record.label).average.sigma
        x, v = motion(record)
        rows.append(np.stack(columns(x, v), axis=1) / sigma)
        values.append(record.samples["force"] / sigma)
    return np.concatenate(rows), np.concatenate(values)


def least_squares(A, y):
    """Solution, sum of squares and covariance, columns scaled for the sake of digits."""
    scale = np.linalg.norm(A, axis=0)
    q, r = np.linalg.qr(A / scale)
    solution = np.linalg.solve(r, q.T @ y) / scale
    inverse = np.linalg.inv(r) / scale[:, None]
    return solution, float(np.sum((y - A @ solution) ** 2)), inverse @ inverse.T


def test_one_amplitude_equals_the_least_squares_refit(lacking_cubic):
    score = scored(lacking_cubic, "cubic_stiffness")["cubic_stiffness"]
    A, y = weighted(lacking_cubic, lambda x, v: (v, x, x**3))
    full, least, covariance = least_squares(A, y)
    reduced = least_squares(A[:, :2], y)[1]
    assert score.expected == pytest.approx(full[2:], rel=1e-6)
    assert score.fall == pytest.approx(reduced - least, rel=1e-6)
    assert score.z == pytest.approx(full[2] / np.sqrt(covariance[2, 2]), rel=1e-6)
    # And the truth lies where the refit's covariance says.
    assert abs(full[2] - CUBIC) < 4 * np.sqrt(covariance[2, 2])


def test_amplitudes_by_run_equal_the_least_squares_refit(tmp_path):
    offsets = {"a": 4.0, "b": -2.0, "c": 1.0}
    reduced = damper_campaign(tmp_path, spring_damper_force, offsets=offsets)
    state = fitted(reduced, damper())
    score = scored(state, "force_offset_by_run")["force_offset_by_run"]
    A, y = weighted(state, lambda x, v: (v, x, x**3))
    own = np.zeros((y.size, 3))
    first = 0
    for k, record in enumerate(state.fit.records):
        sigma = state.fit_errors.at("force", record.label).average.sigma
        own[first : first + record.time.size, k] = 1 / sigma
        first += record.time.size
    full, least, _ = least_squares(np.concatenate([A, own], axis=1), y)
    assert score.names == tuple(f"force_offset_by_run[{label}]" for label in "abc")
    assert score.expected == pytest.approx(full[3:], rel=1e-5)
    assert score.fall == pytest.approx(least_squares(A, y)[1] - least, rel=1e-5)


def test_the_share_is_the_fall_over_the_excess(lacking_cubic):
    base = lacking_cubic.base()
    score = scored(lacking_cubic, "cubic_stiffness")["cubic_stiffness"]
    excess = variance = 0.0
    for entry in lacking_cubic.fit_errors.entries:
        samples = entry.average.samples / entry.average.sigma**2
        excess += samples * (entry.repeating**2 - entry.noise**2)
        # Of chi-square variates: the residual's squares and, beside it, the noise's.
        own = samples * entry.noise**2
        variance += 2 * own**2 * (1 / entry.coefficients + 1 / entry.free)
    assert base.excess == pytest.approx(excess)
    assert score.share == pytest.approx(score.fall / (excess + 2 * np.sqrt(variance)))
    # The cubic is all that is missing; what noise could feign beside it is small here.
    assert 0.8 < score.share < 1.0


def test_what_the_model_has_already_scores_nothing(tmp_path):
    state = fitted(damper_campaign(tmp_path), damper())
    spanned = ("viscous_damping", "linear_stiffness", "cubic_stiffness")
    scores, failed = score_all(state.base(), options(state, spanned), jobs=1)
    assert scores == []
    assert set(failed) == {f"{name} at force" for name in spanned}


def test_a_constant_known_to_a_tolerance_acts_as_its_prior_says(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force)
    tolerance, nominal = 60.0, 950.0
    model = damper(cubic=False)
    spring = Parameter(nominal, "N/m", sd=tolerance, fixed=True)
    state = fitted(reduced, model.with_parameters(stiffness=spring))
    assert state.fit.model.uncertain() == ("stiffness",)
    score = scored(state, "cubic_stiffness")["cubic_stiffness"]
    A, y = weighted(state, lambda x, v: (v, x, x**3))
    prior = np.array([[0.0, 1 / tolerance, 0.0]])
    full, least, _ = least_squares(np.concatenate([A, prior]), np.append(y, nominal / tolerance))
    reduced_ = least_squares(np.concatenate([A, prior])[:, :2], np.append(y, nominal / tolerance))[
        1
    ]
    assert score.expected == pytest.approx(full[2:], rel=1e-6)
    assert score.fall == pytest.approx(reduced_ - least, rel=1e-6)


def test_the_wrong_side_of_a_one_sided_null_scores_nothing(tmp_path):
    signs = set()
    for size in (3.0, -3.0):

        def force(x, v, t, size=size):
            return spring_damper_force(x, v, t) + size * np.exp(-((v / 0.02) ** 2)) * np.sign(v)

        state = fitted(damper_campaign(tmp_path / str(size), force), damper())
        (option,) = options(state, ["stribeck_friction"])
        free = replace(option, candidate=replace(option.candidate, sign={}))
        (either,), _ = score_all(state.base(), [free], 1)
        (signed,), _ = score_all(state.base(), [option], 1)
        signs.add(float(np.sign(either.expected[0])))
        if either.expected[0] > 0:
            assert signed.expected == pytest.approx(either.expected)
            assert signed.fall == pytest.approx(either.fall)
        else:
            assert either.share > 0.5
            assert signed.fall == 0 or signed.expected[0] > 0
            assert signed.share < 0.2
    assert signs == {-1.0, 1.0}


def test_the_scan_finds_the_shape_that_the_data_were_made_with(tmp_path):
    state = fitted(damper_campaign(tmp_path / "plain", spring_damper_force), damper())
    (option,) = options(state, ["coulomb_friction"])
    ((name, grid),) = option.candidate.shapes.items()
    assert len(grid) > 3
    for transition in grid[1:-1:2]:

        def force(x, v, t, transition=transition):
            return spring_damper_force(x, v, t) + FRICTION * 2 / np.pi * np.arctan(v / transition)

        made = damper_campaign(tmp_path / f"{transition}", force, noise=0.05)
        score = scored(fitted(made, damper()), "coulomb_friction")["coulomb_friction"]
        assert score.shapes[name] == pytest.approx(transition, rel=1e-3)
        assert score.expected == pytest.approx([FRICTION], rel=0.02)


def test_woodbury_equals_the_dense_covariance():
    rng = np.random.default_rng(0)
    samples = 80
    columns, sensitivity = rng.standard_normal((5, samples)), rng.standard_normal((3, samples))
    residual, scale = rng.standard_normal(samples), np.repeat([0.7, 3.0], samples // 2)
    period = np.zeros(samples, dtype=np.int64)
    run = RunBase.of(scale, residual, sensitivity, columns, period)
    new = rng.standard_normal((2, samples))
    # In SI the covariance is diag(1/scale^2) + B' B.
    precision = np.linalg.inv(np.diag(scale**-2.0) + columns.T @ columns)
    cross, own, score = run.products(new * scale)
    assert cross == pytest.approx(sensitivity @ precision @ new.T, rel=1e-9, abs=1e-9)
    assert own == pytest.approx(new @ precision @ new.T, rel=1e-9, abs=1e-9)
    assert score == pytest.approx(new @ precision @ residual, rel=1e-9, abs=1e-9)


def test_without_input_noise_the_weights_are_plain():
    rng = np.random.default_rng(1)
    sensitivity, residual = rng.standard_normal((2, 30)), rng.standard_normal(30)
    period = np.zeros(30, dtype=np.int64)
    for columns in (np.zeros((0, 30)), 1e-6 * rng.standard_normal((4, 30))):
        run = RunBase.of(np.full(30, 2.0), residual, sensitivity, columns, period)
        assert run.input_noise.shape[0] == 0
        cross, _, score = run.products(2.0 * sensitivity)
        assert cross == pytest.approx(4.0 * sensitivity @ sensitivity.T)
        assert score == pytest.approx(4.0 * sensitivity @ residual)


def test_input_noise_enters_the_score_as_generalised_least_squares(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force, input_noise=2e-4, noise=0.2)
    state = fitted(reduced, damper(cubic=False))
    score = scored(state, "cubic_stiffness")["cubic_stiffness"]
    base, rows, values = state.base(), [], []
    assert all(run.input_noise.shape[0] > 0 for run in base.runs)
    for r, record in enumerate(state.fit.records):
        run = state.fit.predictor.runs[r]
        B = input_columns(run, state.fit.predictor.constants(state.fit.point.theta[None], r)[0])[0]
        sigma = state.fit_errors.at("force", record.label).average.sigma
        kept = B[np.sum(B**2, axis=1) / sigma**2 > 1e-2]
        covariance = sigma**2 * np.eye(record.time.size) + kept.T @ kept
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        x, v = motion(record)
        rows.append(whiten @ np.stack([v, x, x**3], axis=1))
        values.append(whiten @ record.samples["force"])
    A, y = np.concatenate(rows), np.concatenate(values)
    full, least, _ = least_squares(A, y)
    assert score.expected == pytest.approx(full[2:], rel=1e-5)
    assert score.fall == pytest.approx(least_squares(A[:, :2], y)[1] - least, rel=1e-5)


def perturbed(record, channel, order, change):
    """The record with one harmonic of a channel changed."""
    item = record.harmonics[channel]
    coefficients = item.coefficients + np.where(item.orders == order, change, 0.0)
    changed = Harmonics(item.orders, coefficients, item.variances)
    return replace(record, harmonics={**record.harmonics, channel: changed})


@pytest.mark.parametrize("kind", ["force law", "oscillator"])
def test_input_columns_equal_finite_differences(kind, tmp_path):
    if kind == "force law":
        record = damper_campaign(tmp_path, input_noise=1e-4).record("a")
        model, channel = damper(), "displacement"
    else:

        def restoring(x, v):
            return 100 * x + 0.8 * v + 3e4 * x**3

        runs = [("a", 1.3, 2.0, "fit")]
        record = oscillator_campaign(tmp_path, restoring=restoring, runs=runs).record("a")
        model, channel = system("duffing"), "force"
        item = record.harmonics[channel]
        some = np.full(item.orders.size, 1e-4)
        record = replace(
            record,
            harmonics={
                **record.harmonics,
                channel: Harmonics(item.orders, item.coefficients, some),
            },
        )

    def outputs(changed):
        predictor = Predictor(model, [changed], steps=256, backend="numpy", jobs=1)
        theta = predictor.layout.start(model)
        predictor.set_anchor(theta)
        return predictor, theta, predictor.predict(theta)[0].y

    predictor, theta, _ = outputs(record)
    columns = input_columns(predictor.runs[0], predictor.constants(theta[None], 0)[0])
    item = record.harmonics[channel]
    expected = []
    # Real parts of every harmonic, then imaginary ones; the mean has none.
    for unit in (1.0, 1j):
        for order, variance in zip(item.orders, item.variances, strict=True):
            if order == 0 and unit == 1j:
                continue
            step = 1e-4 * max(abs(item.coefficients)) * unit
            up, down = (
                outputs(perturbed(record, channel, order, sign * step))[2] for sign in (1, -1)
            )
            expected.append((up - down) / (2 * abs(step)) * np.sqrt(variance))
    expected = np.stack(expected, axis=1)
    assert columns.shape == expected.shape
    assert columns == pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(expected).max())


def test_white_noise_is_hardly_inflated_and_never_deflated(lacking_cubic):
    scores = scored(lacking_cubic, "cubic_stiffness", "mass_error", "quadratic_damping")
    assert all(score.inflation >= 1.0 for score in scores.values())
    # 21 degrees of freedom between periods: a chi-square over its mean, four sigma.
    assert all(score.inflation < 1 + 4 * np.sqrt(2 / 21) for score in scores.values())


def test_coloured_noise_is_counted_for_what_it_is(tmp_path):
    periods, coefficient = 60, 0.8
    runs = tuple(run for run in DAMPER_RUNS if run[3] == "fit")
    reduced = damper_campaign(
        tmp_path,
        spring_damper_force,
        coloured=coefficient,
        periods=periods,
        per_period=40,
        runs=runs,
    )
    state = fit_one_role(reduced)
    score = scored(state, "cubic_stiffness")["cubic_stiffness"]
    A, _ = weighted(state, lambda x, v: (v, x, x**3))
    # The direction in which the score looks, and the variance of the true noise along it.
    rest = A[:, 2] - A[:, :2] @ least_squares(A[:, :2], A[:, 2])[0]
    white = coloured = 0.0
    first = 0
    for record in state.fit.records:
        d = rest[first : first + record.time.size]
        first += record.time.size
        covariance = toeplitz(coefficient ** np.arange(d.size))
        white += d @ d
        coloured += d @ covariance @ d
    scatter = np.sqrt(2 / (3 * (periods - 1)))
    assert score.inflation == pytest.approx(coloured / white, rel=4 * scatter)
    assert score.inflation > 3
    assert score.statistic == pytest.approx(score.fall / score.inflation)


def fit_one_role(reduced):
    """Fit all runs; nothing held out, which would only cost time here."""
    roles = Roles(tuple(reduced.records), (), "none", "")
    return fit_state(Assembly(damper(cubic=False)), roles, NUMERICS)


def test_a_model_without_unknowns_can_be_scored(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force)
    model = Model(
        "known",
        inputs={"displacement": "m"},
        parameters={"damping": Parameter(200.0, "N*s/m", fixed=True)},
        outputs={"force": Output({"damping": "damping*dot(displacement)"}, "N")},
    )
    state = fitted(reduced, model)
    score = scored(state, "linear_stiffness")["linear_stiffness"]
    A, y = weighted(state, lambda x, v: (x, v))
    alone = float(A[:, 0] @ (y - 200.0 * A[:, 1]) / (A[:, 0] @ A[:, 0]))
    assert score.expected == pytest.approx([alone], rel=1e-6)


def synthetic(present, gradient_at=0.0):
    """One run of white noise with sensitivities ``present (l, n)``; its residual and basis."""
    rng = np.random.default_rng(6)
    n = present.shape[1]
    residual = rng.standard_normal(n) + gradient_at * present.sum(axis=0)
    run = RunBase.of(np.ones(n), residual, present, np.zeros((0, n)), np.zeros(n, dtype=np.int64))
    gram, gradient = present @ present.T, present @ residual
    return residual, Base(None, [run], gram, gradient, 1.0, 1.0, 1.0)


def free_option():
    return SimpleNamespace(candidate=SimpleNamespace(sign={}))


def test_amplitudes_that_do_the_same_are_one_direction():
    rng = np.random.default_rng(1)
    columns, present = rng.standard_normal((2, 50)), rng.standard_normal((1, 50))
    _, base = synthetic(present)
    alone = _evaluate(base, free_option(), {}, Block(("a",), [columns[None, :1]]))
    same = np.stack([columns[0], 2 * columns[0]])
    twice = _evaluate(base, free_option(), {}, Block(("a", "b"), [same[None]]))
    both = _evaluate(base, free_option(), {}, Block(("a", "b"), [columns[None]]))
    assert (alone.rank, twice.rank, both.rank) == (1, 1, 2)
    assert twice.fall == pytest.approx(alone.fall, rel=1e-9)


def test_an_unknown_of_one_run_needs_no_zeros_in_another():
    """Columns of those that act in a run do for the score, and for what it says of each run."""
    rng = np.random.default_rng(3)
    runs = []
    for _ in range(2):
        present = rng.standard_normal((1, 40))
        _, one = synthetic(present)
        runs.append(one.runs[0])
    gram = sum(run.sensitivity @ run.sensitivity.T for run in runs)
    gradient = sum(run.sensitivity @ run.residual for run in runs)
    base = Base(None, runs, gram, gradient, 1.0, 1.0, 1.0)
    shared, own = rng.standard_normal((2, 40)), rng.standard_normal((2, 40))
    names = ("a", "b[first]", "b[second]")
    few = [np.stack([shared[r], own[r]])[None] for r in range(2)]
    acting = [np.array([0, 1]), np.array([0, 2])]
    every = [np.zeros((1, 3, 40)) for _ in range(2)]
    for whole, part, places in zip(every, few, acting, strict=True):
        whole[:, places] = part
    sparse, dense = Block(names, few, acting), Block(names, every)
    one, other = (_evaluate(base, free_option(), {}, block) for block in (sparse, dense))
    for name in ("fall", "expected", "columns", "contribution", "information", "beside"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-12)
    pairs = zip(*(_directions(base, block, one.expected) for block in (sparse, dense)), strict=True)
    for found, expected in pairs:
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert sparse.column(0, "b[second]") is None
    assert sparse.column(0, "c") is None
    np.testing.assert_array_equal(sparse.column(1, "b[second]")[0], own[1])
    np.testing.assert_array_equal(dense.column(1, "b[first]")[0], 0.0)


def test_a_score_away_from_the_estimate_is_what_the_effect_adds_to_a_refit():
    """Present parameters first take their own part (Frisch, Waugh and Lovell)."""
    rng = np.random.default_rng(2)
    present, column = rng.standard_normal((2, 60)), rng.standard_normal(60)
    residual, base = synthetic(present, gradient_at=0.5)
    score = _evaluate(base, free_option(), {}, Block(("a",), [column[None, None]]))
    without = least_squares(present.T, residual)[1]
    solution, whole, _ = least_squares(np.vstack([present, column]).T, residual)
    assert score.fall == pytest.approx(without - whole, rel=1e-9)
    assert score.expected[0] == pytest.approx(solution[-1], rel=1e-9)


def test_a_known_constant_pulls_back_to_its_prior_beside_a_candidate():
    """Away from its centre the prior's slope is part of the score, as of one more sample."""
    priors = (Normal(1.0, 0.5), Normal(0.0, 2.0))
    problem = SimpleNamespace(priors=priors, names=("known", "free"), nuisances={"known"})
    point = SimpleNamespace(theta=np.array([1.2, 3.0]))
    gram, gradient = _prior_terms(SimpleNamespace(problem=problem, point=point))
    np.testing.assert_allclose(gram, np.diag([1.0, 0.0]))
    # In units of the prior's sd the log density falls by the distance, 0.4 of them.
    np.testing.assert_allclose(gradient, [-0.4, 0.0])


def test_an_excess_is_doubted_as_the_noise_is_that_it_exceeds(lacking_cubic):
    """An F variate: the averaged residual scatters, and so does the noise that is subtracted."""
    fit, rng, draws = lacking_cubic.fit, np.random.default_rng(0), 4000
    table, total = {}, np.zeros(draws)
    for record in fit.records:
        entry = lacking_cubic.fit_errors.at("force", record.label)
        # Known from hardly more numbers than are averaged.
        average = replace(entry.average, samples=2 * entry.average.number)
        entry = replace(entry, spectrum=None, average=average)
        table[record.label, "force"] = entry
        size = record.time.size * (entry.noise / entry.sigma) ** 2
        left = rng.chisquare(entry.coefficients, draws) / entry.coefficients
        total += size * (left - rng.chisquare(entry.free, draws) / entry.free)
    # A deviation from 4000 draws scatters by 1.1 %.
    assert base_of(fit, table).doubt == pytest.approx(np.std(total), rel=0.05)


def test_columns_beyond_single_precision_keep_their_direction():
    """A power of a pressure in pascals; a column that is nothing stays nothing."""
    rng = np.random.default_rng(3)
    rows = np.stack([1e60 * rng.standard_normal(50), -1e-50 * rng.random(50), np.zeros(50)])
    found = _directions_of(rows)
    assert found.dtype == np.float32
    assert np.isfinite(found).all()
    for row, direction in zip(rows[:2], found[:2].astype(float), strict=True):
        cosine = row @ direction / np.linalg.norm(row) / np.linalg.norm(direction)
        assert cosine == pytest.approx(1.0, abs=1e-6)
    assert not found[2].any()
