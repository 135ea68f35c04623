"""What transients leave is called slow noise only where it has the spectrum of such noise."""

from __future__ import annotations

from types import SimpleNamespace as Stub

import numpy as np
import pytest
from scipy.signal import lfilter

from bayesoleo._report.structures import lead_of_unexplained
from bayesoleo.discovery._slow_noise import _lines, _time_of, slow_noise_text

STEP, COUNT = 0.1, 1200
TIME = STEP * np.arange(COUNT)


def time_of(*residuals: np.ndarray) -> float | None:
    runs = [
        Stub(
            record=Stub(samples={"y": left}, time=STEP * np.arange(left.size), kept=None),
            y=np.zeros((1, left.size)),
        )
        for left in residuals
    ]
    return _time_of([_lines(run, 0, "y") for run in runs])


def process(memory: float, seed: int, count: int = COUNT) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return lfilter([1.0], [1.0, -memory], rng.standard_normal(count + 500))[500:]


@pytest.mark.parametrize("memory", [0.6, 0.9, 0.97])
def test_a_process_has_its_correlation_time(memory):
    found = [time_of(process(memory, k), process(memory, k + 100)) for k in range(20)]
    known = [time for time in found if time is not None]
    assert len(known) >= 18  # the bands' tests leave one in a hundred out
    assert np.median(known) == pytest.approx(-STEP / np.log(memory), rel=0.25)


def test_white_noise_is_not_slow():
    assert sum(time_of(process(0.0, k)) is not None for k in range(40)) <= 2


@pytest.mark.parametrize(
    "left",
    [
        np.exp(-TIME / 20.0) * np.sin(3.0 * TIME),  # a swing whose frequency is wrong
        np.sin(0.02 * TIME**2),  # a sweep through what is missing
        np.sin(1.3 * TIME) * np.abs(np.sin(1.3 * TIME)),  # a force of the speed's square
    ],
)
def test_what_an_effect_leaves_is_no_noise(left):
    assert time_of(left + 0.05 * process(0.0, 1)) is None


def test_masked_and_short_records_are_not_judged():
    assert time_of(process(0.9, 0, 60)) is None


def test_the_headline_leaves_both_open():
    summary = {"slow_noise": {"T": 20.0}, "structures": None}
    assert lead_of_unexplained(summary) == "Slow noise is left, or something is missing"
    assert lead_of_unexplained({"structures": None}) == "Something is missing"
    assert "correlation time 20 s" in slow_noise_text(summary["slow_noise"])
    assert slow_noise_text({}) == ""
