"""Variance of an estimate from one transient: noise of any colour, effects that act anywhere."""

import numpy as np
import pytest
from scipy import signal, stats

from bayesoleo.discovery._transient_variance import RunNoise, coloured_variance

SAMPLES, DRAWS = 400, 400
#: Rates at a nominal 5 %: 800 draws know them to 0.8 %. A test that never speaks is as wrong as one
#: that speaks too often. Where noise is larger in places it is not stationary, and a resonance
#: carries what acts in one place to others.
MOST, MOST_WHERE_LARGER, LEAST = 0.08, 0.1, 0.005


def wandering(rng, count=SAMPLES):
    """A smooth random motion: the state of a first-order system that is driven."""
    motion = signal.lfilter([1.0], [1.0, -0.95], np.repeat(rng.standard_normal(count // 20), 20))
    return motion / np.std(motion)


def first_order(motion, beyond):
    """Sensitivities of a first-order transient: start, gain, rate and an effect."""
    slow = signal.lfilter([0.05], [1.0, -0.95], np.stack([motion, np.gradient(motion), beyond]))
    return np.stack([0.95 ** np.arange(SAMPLES), *slow])[:, None]


def oscillator(motion, beyond):
    """Those of a damped oscillator that a measured force drives."""
    modes = [1.0, -2 * 0.97 * np.cos(0.4), 0.97**2]
    forces = np.stack([np.eye(1, SAMPLES)[0], motion, np.gradient(motion), beyond])
    return signal.lfilter([1.0], modes, forces)[:, None]


def force_law(motion, beyond):
    """Those of a force that is a sum of terms in a given motion."""
    return np.stack([np.ones(SAMPLES), motion, np.gradient(motion), beyond])[:, None]


def two_outputs(motion, beyond):
    """Those of two coordinates, each seen by its own sensor."""
    one, other = first_order(motion, beyond), oscillator(motion, beyond)
    return np.concatenate([one, other], axis=1)


def noise(rng, colour, outputs, where):
    """Draws of AR(1) noise, or of white noise three times as strong where the effect acts."""
    size = (DRAWS, outputs, SAMPLES + 300)
    made = signal.lfilter([1.0], [1.0, -(colour or 0.0)], rng.standard_normal(size))[..., 300:]
    return made if colour is not None else made * (1.0 + 2.0 * where)


def wrongly_significant(rng, columns, colour, where):
    """Part of the draws without the effect in which Student's t is beyond its 5 % point."""
    outputs = columns.shape[1]
    wide = columns.reshape(len(columns), -1)
    columns = columns / np.linalg.norm(wide, axis=1)[:, None, None]
    wide = columns.reshape(len(columns), -1)
    covariance = np.linalg.inv(wide @ wide.T)
    influence = (covariance @ wide)[-1]
    errors = noise(rng, colour, outputs, where).reshape(DRAWS, -1)
    moved = errors @ influence
    residual = errors - (errors @ wide.T) @ covariance @ wide
    shape = (outputs, SAMPLES)
    weights = influence.reshape(shape)
    runs = [RunNoise(r.reshape(shape), columns, covariance) for r in residual]
    found = [coloured_variance([weights], [run]) for run in runs]
    t = np.array([m / np.sqrt(v) for m, (v, _) in zip(moved, found, strict=True)])
    free = np.array([f for _, f in found])
    return np.mean(2 * stats.t.sf(np.abs(t), free) < 0.05), np.median(free)


@pytest.mark.parametrize("system", [first_order, oscillator, force_law, two_outputs])
@pytest.mark.parametrize("local", [False, True], ids=["everywhere", "one stretch"])
@pytest.mark.parametrize("colour", [0.0, 0.9, None], ids=["white", "slow", "larger there"])
def test_an_effect_that_is_not_there_is_as_rarely_significant_as_said(system, local, colour):
    rng = np.random.default_rng(7)
    rates = []
    for _ in range(2):
        motion = wandering(rng)
        top = np.quantile(motion, 0.95)
        where = np.asarray(motion > top, dtype=float)
        columns = system(motion, np.maximum(motion - top, 0.0) if local else motion**3)
        rates.append(wrongly_significant(rng, columns, colour, where)[0])
    assert LEAST < np.mean(rates) < (MOST_WHERE_LARGER if colour is None else MOST)


@pytest.mark.parametrize("system", [first_order, oscillator, force_law])
def test_what_acts_in_one_stretch_is_known_as_well(system):
    """The scatter between stretches would leave such an effect one degree of freedom."""
    rng = np.random.default_rng(3)
    motion = wandering(rng)
    beyond = np.maximum(motion - np.quantile(motion, 0.97), 0.0)
    _, freedom = wrongly_significant(rng, system(motion, beyond), 0.5, np.zeros(SAMPLES))
    assert freedom > 8


def test_runs_add_up_and_samples_without_weight_say_nothing():
    rng = np.random.default_rng(5)
    columns = force_law(wandering(rng), np.sin(np.arange(SAMPLES) / 3))
    columns /= np.linalg.norm(columns, axis=(1, 2))[:, None, None]
    covariance = np.linalg.inv(columns[:, 0] @ columns[:, 0].T)
    weights = np.einsum("l,lbn->bn", covariance[-1], columns)
    run = RunNoise(rng.standard_normal((1, SAMPLES)), columns, covariance)
    variance, freedom = coloured_variance([weights], [run])
    twice = coloured_variance([weights, weights], [run, run])
    assert twice == pytest.approx((2 * variance, 2 * freedom))
    nothing = RunNoise(0 * run.residual, 0 * columns, covariance)
    assert coloured_variance([weights, 0 * weights], [run, nothing]) == (variance, freedom)
    scaled = RunNoise(3 * run.residual, columns, covariance)
    assert coloured_variance([7 * weights], [scaled]) == pytest.approx((441 * variance, freedom))


def test_noise_that_outputs_share_counts_along_both():
    """Two outputs with the same error: along their sum the variance doubles, apart it vanishes."""
    rng = np.random.default_rng(11)
    wave = np.stack([np.sin(np.arange(SAMPLES) / 5.0)] * 2)
    found = {1: [], -1: []}
    for _ in range(50):
        residual = np.stack([rng.standard_normal(SAMPLES)] * 2)
        for sign in found:
            run = RunNoise(residual, np.zeros((0, 2, SAMPLES)), np.zeros((0, 0)))
            found[sign].append(coloured_variance([wave * [[1.0], [sign]]], [run])[0])
    assert np.mean(found[1]) == pytest.approx(2 * np.sum(wave**2), rel=0.15)
    assert np.max(found[-1]) < 1e-9


def test_an_output_that_nothing_moves_does_not_change_the_variance():
    """Constant and without noise, it has neither weight nor residual."""
    rng, size = np.random.default_rng(8), 600
    column = np.cos(np.arange(size) / 20.0)
    covariance = np.array([[1.0 / (column @ column)]])
    residual = rng.standard_normal(size)
    residual -= column * (column @ residual) * covariance[0, 0]
    weights = covariance[0, 0] * column
    dead = np.zeros(size)
    alone = RunNoise(residual[None], column[None, None], covariance)
    beside = RunNoise(np.stack([residual, dead]), np.stack([column, dead])[None], covariance)
    one, _ = coloured_variance([weights[None]], [alone])
    two, _ = coloured_variance([np.stack([weights, dead])], [beside])
    assert two == pytest.approx(one, rel=1e-6)
