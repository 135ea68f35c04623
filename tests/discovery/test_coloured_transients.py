"""Transients whose sensors have slow or ringing noise: intervals, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from test_noise_of_inputs import COUNT, TIME, TRUTHS, drive, true_output

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._effects_beside_colour import gain_beside_colour
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._inference import MORE_THAN_NOISE, Inference, chosen_for
from bayesoleo.discovery._noise_of_estimates import NoiseOfEstimates, colours_of, flatness_p
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._signatures import noise_of, signatures_of
from bayesoleo.discovery._state import state_of
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction._records import transient_record

#: Coefficients of autoregressive noise: white, slow, and ringing slowly and fast.
COLOURS = {
    "white": (),
    "slow": (-0.9,),
    "rings slowly": (-2 * 0.98 * np.cos(2 * np.pi * 0.02), 0.98**2),
    "rings fast": (-2 * 0.95 * np.cos(2 * np.pi * 0.12), 0.95**2),
}
COLOURED = tuple(COLOURS)[1:]


def coloured(colour: str, rng: np.random.Generator, count: int = COUNT) -> np.ndarray:
    """Noise of unit variance."""
    white, more = rng.standard_normal(count + 2000), [1.0, *COLOURS[colour]]
    scale = np.sqrt(np.sum(lfilter([1.0], more, np.eye(1, 5000)[0]) ** 2))
    return lfilter([1.0 / scale], more, white)[2000:]


def law() -> Model:
    return Model(
        "law",
        inputs={"u": ""},
        parameters={
            "a": Parameter(2.0, "", relative_sd=0.5),
            "b": Parameter(0.3, "", relative_sd=0.5),
        },
        outputs={"y": Output("a*u + b*dot(u)", "")},
    )


def fitted(kind: str, colour: str, seed: int, *, cubic: float = 0.0):
    rng = np.random.default_rng(seed)
    if kind == "law":
        u = drive(TIME)
        rate = (2.0 + 1.2 * TIME) * np.cos(2.0 * TIME + 0.6 * TIME**2)
        rate += 0.55 * np.cos(1.1 * TIME)
        model, y = law(), 2.2 * u + 0.25 * rate + cubic * u**3
    else:
        model, y = TRUTHS[kind][0](), true_output(kind, cubic)
    y = y + 0.02 * np.std(y) * coloured(colour, rng)
    record = transient_record("r", TIME, {"u": drive(TIME), "y": y})
    return fit_model(model, [record], Numerics(jobs=1))


def chosen(fit) -> Inference:
    return chosen_for(Inference("auto"), fit, Assembly(fit.model), jobs=1)


@pytest.mark.parametrize("colour", COLOURED)
def test_a_colour_is_seen(colour):
    for seed in range(10):
        lines = np.abs(np.fft.rfft(coloured(colour, np.random.default_rng(seed)))) ** 2
        assert flatness_p([lines[1:-1]]) < 1e-6


def test_white_noise_is_seldom_taken_for_coloured():
    rng = np.random.default_rng(0)
    lines = [np.abs(np.fft.rfft(rng.standard_normal((2, 600)))) ** 2 for _ in range(400)]
    chances = np.array([flatness_p(list(one[:, 1:-1])) for one in lines])
    assert np.mean(chances < 0.05) < 0.08
    assert np.mean(chances < 1e-3) < 0.006  # more than two of 400 are once in a hundred
    assert flatness_p([]) == flatness_p([np.zeros(5)]) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("colour", COLOURED)
@pytest.mark.parametrize("kind", ["oscillator", "lag"])
def test_coloured_noise_is_neither_white_nor_an_effect(kind, colour):
    found = chosen(fitted(kind, colour, 0))
    assert found.error_model == "spectral"
    assert "the spectrum of what is left of y in transients is not flat" in found.reason
    assert "no more than noise" not in found.reason


def test_white_noise_is_said_to_be_white():
    found = chosen(fitted("lag", "white", 0))
    assert found.plain
    assert "the noise is white, and no more than noise is left" in found.reason


@pytest.mark.slow
@pytest.mark.parametrize("colour", ["white", "slow"])
@pytest.mark.parametrize(("kind", "cubic"), [("oscillator", 2e5), ("lag", 0.3)])
def test_a_missing_effect_is_not_excused_as_coloured_noise(kind, cubic, colour):
    """Its residual is coloured too, but has the waveform that the effect has."""
    fit = fitted(kind, colour, 0, cubic=cubic)
    assert colours_of(fit)
    signatures = signatures_of(fit, Assembly(fit.model), noise_of(fit), jobs=1)
    assert gain_beside_colour(fit, signatures) > 10 * MORE_THAN_NOISE
    assert chosen(fit).error_model in ("catalogue", "power")


@pytest.mark.parametrize("colour", COLOURED)
def test_no_effect_gains_beside_noise_of_its_own_spectrum(colour):
    fit = fitted("lag", colour, 3)
    signatures = signatures_of(fit, Assembly(fit.model), noise_of(fit), jobs=1)
    assert gain_beside_colour(fit, signatures) < MORE_THAN_NOISE


@pytest.mark.parametrize("colour", ["white", "slow"])
def test_an_estimate_has_the_deviation_that_the_spectrum_gives_it(colour):
    """Differences of neighbours, by which noise is measured, miss slow noise."""
    fit = fitted("lag", colour, 0)
    state = state_of(Assembly(fit.model), fit, assign(fit.records))
    names = fit.problem.names
    sd = np.array([state.sd_of(name) for name in names])
    wanted = np.sqrt(np.diag(NoiseOfEstimates.of(fit).covariance))
    if colour == "white":
        np.testing.assert_allclose(sd / fit.point.sd, 1.0, atol=0.1)
        return
    np.testing.assert_allclose(sd, wanted, rtol=1e-6)
    assert (sd > 2.0 * fit.point.sd).all()
    assert state.sd_of("nothing") is None


@pytest.mark.statistical
@pytest.mark.parametrize("colour", list(COLOURS))
@pytest.mark.parametrize("kind", ["oscillator", "lag", "law"])
def test_intervals_hold_the_truth(kind, colour):
    truth = {"a": 2.2, "b": 0.25} if kind == "law" else TRUTHS[kind][3]
    scores = []
    for seed in range(100):
        fit = fitted(kind, colour, seed)
        away = np.array([fit.values[n] - truth[n] for n in fit.problem.names])
        known = colours_of(fit)
        sd = np.sqrt(np.diag(NoiseOfEstimates.of(fit).covariance)) if known else fit.point.sd
        scores.append(np.abs(away / sd))
    inside = np.mean(np.array(scores) < 1.645, axis=0)
    # Nine tenths of a hundred have a deviation of 3 %.
    np.testing.assert_allclose(inside, 0.9, atol=0.09)
