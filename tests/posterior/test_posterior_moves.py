"""Every move leaves a Gaussian as it is; emcee's snooker does not."""

import emcee
import numpy as np
import pytest
from posterior_targets import Gaussian
from scipy import stats

from bayesoleo.posterior import Mixture
from bayesoleo.posterior._ensemble_moves import (
    Counted,
    Grouped,
    IndependenceMove,
    SnookerMove,
    differential_evolution,
)


def second_moment(move, dimension: int, scale: float, *, groups: int, steps: int) -> float:
    """Mean of (x / scale)^2 over all walkers after some steps from exact draws."""
    each = 4 * (dimension + 1)
    random = np.random.RandomState(7)
    start = scale * random.standard_normal((groups * each, dimension))
    target = Gaussian(np.full(dimension, scale))
    sampler = emcee.EnsembleSampler(
        len(start), dimension, lambda x: target(x)[0], moves=move, vectorize=True
    )
    state = emcee.State(start, random_state=random.get_state())
    final = sampler.run_mcmc(state, steps, skip_initial_state_check=True, store=False)
    return float(np.mean((final.coords / scale) ** 2))


def make(kind: str, dimension: int, scale: float, groups: int):
    if kind == "independence":
        # off in place and size, as a mixture is that was fitted to few draws
        centre = np.full((1, dimension), 0.2 * scale)
        covariance = (1.2 * scale) ** 2 * np.eye(dimension)[None]
        return IndependenceMove(Mixture(centre, covariance, np.zeros(1)))
    within = {
        "differential": differential_evolution,
        "snooker": SnookerMove,
        "emcee's snooker": emcee.moves.DESnookerMove,
    }[kind]()
    return Grouped(within, groups)


def tolerance(dimension: int, groups: int) -> float:
    """Four standard errors of a mean of chi-squares: stationary walkers are independent."""
    return 4 * np.sqrt(2 / (groups * 4 * (dimension + 1) * dimension))


KINDS = ["differential", "snooker", "independence"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("dimension", "scale"), [(2, 0.1), (4, 10.0), (9, 1.0)])
def test_moves_are_stationary(kind, dimension, scale):
    groups = 60
    move = make(kind, dimension, scale, groups)
    moment = second_moment(move, dimension, scale, groups=groups, steps=60)
    assert moment == pytest.approx(1.0, abs=tolerance(dimension, groups))


@pytest.mark.statistical
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dimension", [2, 4, 9])
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_moves_are_stationary_to_a_few_percent(kind, dimension, scale):
    groups = 1500 // dimension
    move = make(kind, dimension, scale, groups)
    moment = second_moment(move, dimension, scale, groups=groups, steps=60)
    assert moment == pytest.approx(1.0, abs=tolerance(dimension, groups))


def skewed(x: np.ndarray, scale: float) -> np.ndarray:
    """Independent Gumbel variables: one tail falls like an exponential, the other much faster."""
    z = x / scale
    return -np.sum(z + np.exp(-z), axis=1)


@pytest.mark.statistical
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_moves_leave_a_skewed_density_as_it_is(kind, scale):
    """Whole distributions, by Kolmogorov and Smirnov; walkers that start exact stay independent of
    each other but for what they were proposed from each other, which costs nothing here."""
    dimension, groups = 3, 500
    each = 4 * (dimension + 1)
    random = np.random.RandomState(11)
    start = scale * random.gumbel(size=(groups * each, dimension))
    with np.errstate(over="ignore"):
        sampler = emcee.EnsembleSampler(
            len(start),
            dimension,
            lambda x: skewed(x, scale),
            moves=make(kind, dimension, scale, groups),
            vectorize=True,
        )
        state = emcee.State(start, random_state=random.get_state())
        final = sampler.run_mcmc(state, 60, skip_initial_state_check=True, store=False)
    assert np.mean(np.any(final.coords != start, axis=1)) > 0.9
    for column in final.coords.T:
        # Nine tests of three columns: one in a thousand at this level.
        assert stats.kstest(column / scale, "gumbel_r").pvalue > 1e-3 / 27


@pytest.mark.parametrize(
    "dimension",
    [2, pytest.param(4, marks=pytest.mark.slow), pytest.param(9, marks=pytest.mark.slow)],
)
def test_the_snooker_of_emcee_has_another_target(dimension):
    groups = 360 // dimension  # the bias is smallest in two dimensions, 0.11
    move = make("emcee's snooker", dimension, 1.0, groups)
    moment = second_moment(move, dimension, 1.0, groups=groups, steps=60)
    assert moment < 1.0 - tolerance(dimension, groups)


def test_ensembles_in_one_call_do_not_mix():
    # Two ensembles far apart, each flat along the first coordinate: differences stay within one.
    random = np.random.RandomState(3)
    start = random.standard_normal((24, 2))
    start[12:, 0] += 1e6
    sampler = emcee.EnsembleSampler(
        24, 2, lambda x: np.zeros(len(x)), moves=Grouped(SnookerMove(), 2), vectorize=True
    )
    state = emcee.State(start, random_state=random.get_state())
    final = sampler.run_mcmc(state, 3, skip_initial_state_check=True)
    assert np.all(np.abs(final.coords[:12, 0]) < 1e5)
    assert np.all(np.abs(final.coords[12:, 0] - 1e6) < 1e5)


def test_acceptance_is_counted():
    move = Counted("differential", Grouped(differential_evolution(), 2))
    second_moment(move, 2, 1.0, groups=2, steps=5)
    assert move.proposed == 5 * 24
    assert 0 < move.accepted < move.proposed


class Remembered:
    """A move that keeps what it was given, and stays where it is with a log ratio of ours."""

    nsplits = 2

    def __init__(self, ratio=0.0):
        self.ratio, self.seen = ratio, []

    def setup(self, coords):
        pass

    def get_proposal(self, sample, complement, random):
        self.seen.append((sample, np.concatenate(complement)))
        return sample + 0.0, np.full(len(sample), self.ratio)


def test_a_walker_moves_by_the_others_of_its_ensemble_alone():
    """Its half and the other one are the ensemble, and share no walker."""
    move = Remembered()
    coords = np.arange(32.0)[:, None]
    halves = np.tile([0, 1], 16)
    Grouped(move, 2)._proposals(coords, halves, 0, np.random.RandomState(0))
    for first, (sample, others) in zip((0, 16), move.seen, strict=True):
        mine = np.arange(first, first + 16)
        assert sorted(np.concatenate([sample, others])[:, 0]) == list(mine)
        assert not set(sample[:, 0]) & set(others[:, 0])


def test_a_proposal_is_accepted_with_its_ratio():
    """One that changes no density and has a log ratio of -1: accepted in 1/e of all cases."""
    each = 2000
    move = Grouped(Remembered(-1.0), 2)
    sampler = emcee.EnsembleSampler(
        2 * each, 1, lambda x: np.zeros(len(x)), moves=move, vectorize=True
    )
    start = np.random.RandomState(1).standard_normal((2 * each, 1))
    sampler.run_mcmc(start, 1, skip_initial_state_check=True)
    # Of 4000 a share scatters by 0.8 %.
    assert sampler.acceptance_fraction.mean() == pytest.approx(np.exp(-1), abs=0.03)
