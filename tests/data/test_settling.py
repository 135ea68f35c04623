"""Whole periods, and leading ones that have not settled."""

import numpy as np
import pytest

from bayesoleo.data._sample_quality import sample_count, settled_start, whole_periods


def stationary(rng, samples, step, noise=0.1):
    phase = 2 * np.pi * step * np.arange(samples)
    clean = np.array([np.sin(phase), np.sign(np.cos(phase)) * 0.5])
    return clean + noise * rng.normal(size=clean.shape)


@pytest.mark.parametrize("length", [3.1, 4.1, 10.99])
def test_stationary_record_keeps_its_periods(length):
    rng = np.random.default_rng(1)
    step = 1 / 100.2
    samples = int(length * 100.2)
    dropped = [settled_start(stationary(rng, samples, step), step)[1] for _ in range(200)]
    assert sum(dropped) == 0


def test_red_noise_raises_no_alarm():
    rng = np.random.default_rng(2)
    step, alarms = 1 / 100.2, 0
    for _ in range(100):
        noise = rng.normal(size=520)
        for index in range(1, 520):
            noise[index] += 0.8 * noise[index - 1]
        alarms += settled_start(stationary(rng, 420, step) + noise[100:], step)[1] > 0
    assert alarms <= 2


def test_transient_is_left_out_and_three_periods_stay():
    rng = np.random.default_rng(3)
    step = 1 / 100.2
    values = stationary(rng, 610, step)
    values[0] += 3 * np.exp(-np.arange(610) / 40)
    first, dropped = settled_start(values, step)
    assert dropped == 2
    assert first == 610 - sample_count(4, step)
    assert settled_start(values[:, :405], step)[1] == 1


def test_counts_at_the_rounding():
    assert whole_periods(4096, 1 / 1024.0000001) == 4
    assert sample_count(10, 1 / 1023.998) == 10239
    assert sample_count(10, 1 / 1023.99999) == 10240
