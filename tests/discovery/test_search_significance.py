"""How sure the best of many is, and which effects the data cannot tell apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted, options
from scipy import stats
from small_campaigns import damper, damper_campaign, spring_damper_force

from bayesoleo.discovery._assembly import Assembly, Roles
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._score_tests import (
    SAMPLES_AT_A_TIME,
    Score,
    _products,
    classes,
    corrected_p,
    effective_tests,
    score_all,
)
from bayesoleo.discovery._state import fit_state


class Place:
    """Stands for a candidate: all that significance asks of one is which signs are allowed."""

    def __init__(self, **sign: int):
        self.sign, self.effect = sign, "any"


class Case:
    """Stands for an option."""

    def __init__(self, **sign: int):
        self.candidate = Place(**sign)


def score(columns, contribution=None, fall=1.0, names=("a",), inflation=1.0, **sign: int) -> Score:
    rows = np.atleast_2d(np.asarray(columns, dtype=float))
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return Score(
        option=Case(**sign),  # type: ignore[arg-type]
        names=names,
        expected=np.ones(len(names)),
        shapes={},
        fall=fall,
        share=0.5,
        inflation=inflation,
        columns=rows,
        contribution=rows[0] if contribution is None else np.asarray(contribution, dtype=float),
        z=np.sqrt(fall),
        rank=len(names),
    )


@pytest.mark.parametrize("count", [2, 5, 20, 60])
def test_orthogonal_columns_are_that_many_tests(count):
    found = effective_tests([score(row) for row in np.eye(count)], seed=1)
    # Read off the median of 4000 draws: its own error is 1/(2 f sqrt(4000)) in u = F^m, 1.6 %.
    assert found == pytest.approx(count, rel=0.12)


def test_equal_columns_are_one_test():
    rows = [score([1.0, 2.0, 3.0]) for _ in range(30)]
    assert effective_tests(rows, seed=1) == pytest.approx(1.0, abs=0.06)
    opposite = [score([1.0, 2.0, 3.0]), score([-1.0, -2.0, -3.0])]
    assert effective_tests(opposite, seed=1) == pytest.approx(1.0, abs=0.06)


def test_correlated_columns_lie_between_and_shapes_count():
    rng = np.random.default_rng(0)
    shared = rng.standard_normal(500)
    rows = [score(shared + 0.5 * rng.standard_normal(500)) for _ in range(20)]
    found = effective_tests(rows, seed=1)
    assert 1.5 < found < 15
    scan = score(np.eye(10))
    assert effective_tests([scan, score(np.eye(10)[0])], seed=1) == pytest.approx(10, rel=0.12)


@pytest.mark.parametrize("samples", [1, SAMPLES_AT_A_TIME, 2 * SAMPLES_AT_A_TIME + 7])
def test_products_of_columns_are_those_of_all_samples(samples):
    rng = np.random.default_rng(3)
    columns = [rng.normal(size=(k, samples)) for k in (2, 1, 0, 3)]
    whole = np.concatenate(columns)
    # Sums of so many products of numbers about one, in another order.
    np.testing.assert_allclose(_products(columns), whole @ whole.T, atol=1e-12 * samples)


def test_no_search_is_one_test():
    assert effective_tests([], seed=1) == 1.0
    assert effective_tests([score([1.0, 0.0])], seed=1) == 1.0


def test_effective_tests_repeat_and_hardly_depend_on_the_seed():
    rows = [score(row) for row in np.random.default_rng(0).standard_normal((12, 40))]
    first = effective_tests(rows, seed=3)
    assert effective_tests(rows, seed=3) == first
    assert effective_tests(rows, seed=4) == pytest.approx(first, rel=0.15)


def test_one_uncorrected_test_is_the_chi_square():
    one = score([1.0, 0.0], fall=6.0, inflation=1.5)
    assert corrected_p(one, 1.0) == pytest.approx(stats.chi2.sf(4.0, 1))
    three = score([1.0, 0.0], fall=6.0, names=("a[1]", "a[2]", "a[3]"))
    assert corrected_p(three, 1.0) == pytest.approx(stats.chi2.sf(6.0, 3))


def test_a_one_sided_test_has_half_the_chance():
    one = score([1.0, 0.0], fall=6.0, a=1)
    assert corrected_p(one, 1.0) == pytest.approx(stats.chi2.sf(6.0, 1) / 2)
    assert corrected_p(score([1.0, 0.0], fall=0.0, a=1), 1.0) == pytest.approx(1.0)


def test_the_correction_is_sidaks_and_keeps_its_digits():
    one = score([1.0, 0.0], fall=9.0)
    local = stats.chi2.sf(9.0, 1)
    assert corrected_p(one, 20.0) == pytest.approx(1 - (1 - local) ** 20)
    tiny = score([1.0, 0.0], fall=200.0)
    assert corrected_p(tiny, 20.0) == pytest.approx(20 * stats.chi2.sf(200.0, 1), rel=1e-6)
    p = [corrected_p(score([1.0, 0.0], fall=f), 20.0) for f in (0.0, 1.0, 4.0, 9.0, 1e4)]
    assert p == sorted(p, reverse=True)
    assert p[0] == 1.0


def test_classes_are_symmetric_and_no_effect_is_in_its_own():
    rng = np.random.default_rng(2)
    shared = rng.standard_normal(60)
    rows = [score(shared + s * rng.standard_normal(60)) for s in (0.0, 0.1, 0.1, 0.5, 2.0)]
    found = classes(rows)
    for i, mates in enumerate(found):
        assert i not in mates
        for j in mates:
            assert i in found[j]
            a, b = rows[i].contribution, rows[j].contribution
            assert (a @ b) ** 2 > SearchPolicy().same_cosine * (a @ a) * (b @ b)
    assert found[0]


def test_size_does_not_matter_for_a_class_but_direction_does():
    a = np.array([1.0, 2.0, -1.0])
    rows = [score(a, a), score(a, 1e6 * a), score(a, -a), score(a, 0 * a)]
    assert classes(rows) == [[1], [0], [], []]


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """A model that lacks nothing, and candidates for what it might."""
    reduced = damper_campaign(tmp_path_factory.mktemp("complete"), spring_damper_force)
    return fitted(reduced, damper())


def test_the_same_effect_under_two_names_is_one_class_and_one_test(complete):
    (option,) = options(complete, ["quintic_stiffness"])
    scores, _ = score_all(complete.base(), [option, option], jobs=1)
    assert classes(scores) == [[1], [0]]
    assert effective_tests(scores, seed=0) == pytest.approx(1.0, abs=0.06)


def test_scores_do_not_depend_on_threads_or_order(complete):
    chosen = options(complete, ["quintic_stiffness", "mass_error", "coulomb_friction"])
    one, _ = score_all(complete.base(), chosen, jobs=1)
    other, _ = score_all(complete.base(), chosen[::-1], jobs=2)
    assert [s.option.key for s in one] == [s.option.key for s in other]
    assert [s.fall for s in one] == [s.fall for s in other]


NAMES = (
    "quintic_stiffness", "quadratic_stiffness", "mass_error", "quadratic_damping", "constant_force",
    "coulomb_friction", "direction_dependent_damping", "sensor_lag",
)  # fmt: skip


@pytest.mark.statistical
def test_corrected_p_of_the_best_is_hardly_ever_too_small(tmp_path):
    """Under the null the smallest corrected p-value falls below a level no more often than that."""
    reduced = damper_campaign(tmp_path, spring_damper_force)
    roles = Roles(tuple(reduced.records), (), "none", "")
    state = fit_state(Assembly(damper()), roles, NUMERICS)
    chosen = options(state, NAMES)
    base, rng, smallest = state.base(), np.random.default_rng(5), []
    replicates = 200
    for _ in range(replicates):
        runs = [replace(run, residual=rng.standard_normal(run.residual.size)) for run in base.runs]
        gradient = sum(run.products(run.sensitivity)[2] for run in runs)
        scores, _ = score_all(replace(base, runs=runs, gradient=gradient), chosen, jobs=2)
        tests = effective_tests(scores, seed=0)
        smallest.append(min(corrected_p(item, tests) for item in scores))
    found = np.array(smallest)
    for level in (0.01, 0.05, 0.2, 0.5):
        scatter = np.sqrt(level * (1 - level) / replicates)
        assert np.mean(found <= level) < level + 3 * scatter, level
    # Nor is it so careful that nothing would ever be found.
    assert np.mean(found <= 0.5) > 0.15


def test_a_drift_far_above_the_noise_is_significant(tmp_path):
    """A direction that is not periodic meets the variance between periods."""

    def drifting(x, v, t):
        return spring_damper_force(x, v, t) + 0.3 * (t - t[-1] / 2)

    state = fitted(damper_campaign(tmp_path, drifting), damper())
    (score,), _ = score_all(state.base(), options(state, ["sensor_drift"]), jobs=1)
    assert abs(score.z) > 10
    assert corrected_p(score, 1.0) < 0.01


def test_classes_do_not_depend_on_the_samples_per_period(tmp_path):
    found = []
    for per_period in (14, 14.37):
        reduced = damper_campaign(tmp_path, per_period=per_period, periods=20)
        state = fitted(reduced, damper())
        pair = options(state, ["coulomb_friction", "quadratic_damping"])
        scores, _ = score_all(state.base(), pair, jobs=1)
        found.append(classes(scores))
    assert found[0] == found[1]


@pytest.mark.parametrize("rank", [1, 3])
def test_p_values_under_coloured_noise_are_uniform(rank):
    """A score over its measured inflation is an F variate with the freedom of that measurement."""
    rng, freedom = np.random.default_rng(2), 7
    names = tuple("abc"[:rank])
    found = []
    for _ in range(800):
        inflation = 5.0 * rng.chisquare(freedom) / freedom
        fall = 5.0 * rng.chisquare(rank)
        one = replace(score([1.0, 0.0], fall=fall, names=names), freedom=freedom)
        found.append(corrected_p(replace(one, inflation=max(inflation, 1.0 + 1e-9)), 1.0))
    # Kolmogorov's statistic of 800 uniform numbers exceeds 0.069 once in a thousand times.
    assert stats.kstest(found, "uniform").statistic < 0.069
