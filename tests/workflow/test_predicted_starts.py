"""A transient is predicted from where its record says that it starts, and not from its prior."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import bayesoleo._workflow as workflow
from bayesoleo._workflow.predicted_starts import drawn_starts, estimated_starts, unknown_starts
from bayesoleo._workflow.predicting import predict
from bayesoleo._workflow.settings import Settings
from bayesoleo.data import load_campaign, reduce_campaign
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record

NOISE, STEP, COUNT = 2e-3, 0.01, 3000
SETTINGS = Settings(jobs=1, steps=128)


def oscillator() -> Model:
    return Model(
        "oscillator",
        inputs={"u": ""},
        dofs={"x": Dof("")},
        parameters={
            "c": Parameter(0.25, "", relative_sd=0.3),
            "k": Parameter(30.0, "", relative_sd=0.1),
        },
        equations={"x": "ddot(x) + c*dot(x) + k*x - 1*u"},
        outputs={"y": Output("x", "")},
    )


def lag() -> Model:
    return Model(
        "lag",
        inputs={"u": ""},
        dofs={"x": Dof("")},
        parameters={"t": Parameter(0.8, "", relative_sd=0.3)},
        equations={"x": "t*dot(x) + x - u"},
        outputs={"y": Output("x", "")},
    )


def two() -> Model:
    """Two masses, of which one is seen."""
    return Model(
        "two",
        inputs={"u": ""},
        dofs={"x": Dof(""), "z": Dof("")},
        parameters={
            "c": Parameter(0.25, "", relative_sd=0.3),
            "k": Parameter(30.0, "", relative_sd=0.1),
        },
        equations={
            "x": "ddot(x) + c*dot(x) + k*x + 12*(x - z) - 1*u",
            "z": "ddot(z) + c*dot(z) + k*z + 12*(z - x)",
        },
        outputs={"y": Output("x", "")},
    )


def pendulum() -> Model:
    """Large swings: the frequency depends on the start."""
    return Model(
        "pendulum",
        inputs={"u": ""},
        dofs={"x": Dof("")},
        parameters={
            "c": Parameter(0.25, "", relative_sd=0.3),
            "k": Parameter(30.0, "", relative_sd=0.1),
        },
        equations={"x": "ddot(x) + c*dot(x) + k*sin(x) - 1*u"},
        outputs={"y": Output("x", "")},
    )


def drive(time: np.ndarray, phase: float) -> np.ndarray:
    return 0.5 * np.sin(2.1 * time + phase) + 0.3 * np.sin(0.7 * time)


#: Rates of the states, and how large they start.
TRUTHS = {
    "oscillator": (oscillator, lambda s, u: [s[1], u - 0.3 * s[1] - 32.0 * s[0]], (0.2, 1.0)),
    "lag": (lag, lambda s, u: [(u - s[0]) / 0.9], (0.5,)),
    "two": (
        two,
        lambda s, u: [
            s[1], u - 0.3 * s[1] - 32.0 * s[0] - 12.0 * (s[0] - s[2]),
            s[3], -0.3 * s[3] - 32.0 * s[2] - 12.0 * (s[2] - s[0]),
        ],
        (0.2, 1.0, 0.2, 1.0),
    ),
    "pendulum": (pendulum, lambda s, u: [s[1], u - 0.3 * s[1] - 32.0 * np.sin(s[0])], (1.0, 2.0)),
}  # fmt: skip


def reduced(folder, kind: str):
    _, rate, size = TRUTHS[kind]
    rng, time = np.random.default_rng(7), STEP * np.arange(COUNT)
    text = 'format = 1\nname = "t"\n'
    for name in ("u", "y"):
        text += f'[channels.{name}]\ncolumn = "{name}"\nunit = ""\n'
    for label, role in zip("abcdef", ["fit", "fit", *["hold-out"] * 4], strict=True):
        phase, start = rng.uniform(0.0, 6.0), np.array(size) * rng.standard_normal(len(size))
        found = solve_ivp(
            lambda t, s, phase=phase: rate(s, drive(t, phase)), (0.0, time[-1]), start,
            t_eval=time, rtol=1e-9, atol=1e-10,
        )  # fmt: skip
        y = found.y[0] + NOISE * rng.standard_normal(COUNT)
        table = np.column_stack([time, drive(time, phase), y])
        np.savetxt(folder / f"{label}.csv", table, delimiter=",", header="time,u,y", comments="")
        text += f'[[runs]]\nlabel = "{label}"\nfile = "{label}.csv"\n'
        text += f'kind = "transient"\nrole = "{role}"\n'
    (folder / "campaign.toml").write_text(text)
    return reduce_campaign(load_campaign(folder), jobs=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(TRUTHS))
def test_a_new_transient_is_foreseen_to_its_noise(tmp_path, kind):
    campaign = reduced(tmp_path, kind)
    tree = workflow.estimate(campaign, TRUTHS[kind][0](), SETTINGS)
    found = predict(tree, campaign, runs=list("cdef"), jobs=1)
    # Noise alone: what two records leave open of a few parameters is some percent of it.
    np.testing.assert_allclose(found["rms"], NOISE, rtol=0.06)
    np.testing.assert_allclose(found["expected_rms"], NOISE, rtol=0.12)
    np.testing.assert_allclose(found["coverage"], 0.95, atol=0.025)


@pytest.mark.slow
def test_starts_that_noise_leaves_open_are_drawn(tmp_path):
    """The band at the first sample, where only the start counts, against least squares."""
    campaign = reduced(tmp_path, "lag")
    tree = workflow.estimate(campaign, lag(), SETTINGS)
    found = predict(tree, campaign, runs=["c"], draws=4000, jobs=1)
    time = STEP * np.arange(COUNT)
    decay = np.exp(-time / 0.9)
    variance = NOISE**2 * (1.0 + 1.0 / np.sum(decay**2))
    half = 0.5 * float((found["high"] - found["low"])[0, 0, 0])
    # Of 4000 draws a deviation is known to 1.1 %; that of the noise to 0.9 %.
    assert half == pytest.approx(1.959964 * np.sqrt(variance), rel=0.05)


@pytest.mark.slow
def test_a_result_of_periodic_runs_has_no_starts_and_needs_none(tmp_path):
    """Of two masses one is not seen: neither its place nor its rate are in any record."""
    campaign = reduced(tmp_path, "two")
    rng, time = np.random.default_rng(3), STEP * np.arange(COUNT)
    step = 2 * np.pi / 2.5
    found = solve_ivp(
        lambda t, s: TRUTHS["two"][1](s, np.sin(step * t)), (0.0, 60.0 + time[-1]), np.zeros(4),
        t_eval=60.0 + time, rtol=1e-9, atol=1e-10,
    )  # fmt: skip
    y = found.y[0] + NOISE * rng.standard_normal(COUNT)
    table = np.column_stack([time, np.sin(step * (60.0 + time)), y])
    np.savetxt(tmp_path / "p.csv", table, delimiter=",", header="time,u,y", comments="")
    text = (tmp_path / "campaign.toml").read_text()
    cycle = f'[[runs]]\nlabel = "p"\nfile = "p.csv"\nfrequency = {1 / 2.5!r}\n'
    periodic = tmp_path / "periodic"
    periodic.mkdir()
    (tmp_path / "p.csv").rename(periodic / "p.csv")
    (periodic / "campaign.toml").write_text(text[: text.index("[[runs]]")] + cycle)
    tree = workflow.estimate(reduce_campaign(load_campaign(periodic), jobs=1), two(), SETTINGS)
    assert not any("start" in str(name) for name in tree["point"]["parameter"].values)
    forecast = predict(tree, campaign, runs=["c", "d"], jobs=1)
    # One sine leaves more open of the parameters than two records that ring down: it is expected,
    # and happens or not. An unseen mass that began at rest was off by fifteen times the noise.
    assert (forecast["rms"] < 1.4 * NOISE).all()
    assert (forecast["expected_rms"] < 3.0 * NOISE).all()
    assert (forecast["coverage"] > 0.93).all()


def released(height: float, sd: float, **kinds) -> Model:
    """Let go at a height that every run knows to a tolerance."""
    return Model(
        "released",
        inputs={"u": ""},
        dofs={"x": Dof("", initial="h", initial_rate="0")},
        parameters={
            "c": Parameter(2.0, "", relative_sd=0.01),
            "k": Parameter(32.0, "", relative_sd=0.01),
            "h": Parameter(height, "", sd=sd, by_run=True, **kinds),
        },
        equations={"x": "ddot(x) + c*dot(x) + k*x - 1*u"},
        outputs={"y": Output("x", "")},
    )


def drawn_for(
    model: Model, height: float, noise: float, seed: int, memory: float = 0.0
) -> np.ndarray:
    """Starts drawn for a run, all else being known; its noise is AR(1)."""
    rng, time = np.random.default_rng(seed), STEP * np.arange(400)
    found = solve_ivp(
        lambda t, s: [s[1], -2.0 * s[1] - 32.0 * s[0]], (0.0, time[-1]), [height, 0.0],
        t_eval=time, rtol=1e-9, atol=1e-12,
    )  # fmt: skip
    error = rng.standard_normal(time.size)
    error[1:] *= np.sqrt(1.0 - memory**2)
    y = found.y[0] + noise * lfilter([1.0], [1.0, -memory], error)
    record = transient_record("r", time, {"u": 1e-9 * np.sin(time), "y": y})
    predictor = Predictor(model, [record], steps=256, backend="numpy", jobs=1)
    theta = predictor.layout.start(model)
    predictor.set_anchor(theta)
    starts = unknown_starts(predictor, {"c", "k"})
    theta = estimated_starts(predictor, theta, starts)
    draws = np.repeat(theta[None], 400, axis=0)
    return drawn_starts(predictor, theta, starts, draws, np.array([noise]), rng)[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize("sd", [0.1, 0.005, 0.002])
def test_a_start_is_known_by_its_record_and_by_its_prior(sd):
    """Truths drawn from the prior, which is worse than the record, as good, and better."""
    scores = []
    for seed in range(40):
        height = 0.02 + sd * np.random.default_rng([seed, 1]).standard_normal()
        found = drawn_for(released(0.02, sd), height, 0.03, seed)
        scores.append((height - found.mean()) / found.std())
    # Forty standard normal scores: within three standard errors of one.
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=3 / np.sqrt(80))


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.5, 0.9, 0.97])
def test_a_start_beside_correlated_noise_is_known_less_well(memory):
    """As independent, samples would tell it up to three times better than they do."""
    scores = []
    for seed in range(80):
        height = 0.02 + 0.1 * np.random.default_rng([seed, 1]).standard_normal()
        found = drawn_for(released(0.02, 0.1), height, 0.01, seed, memory)
        scores.append((height - found.mean()) / found.std())
    # Eighty normal scores are known to 8 %; the spectrum of 400 samples to a few times that where
    # the memory is a tenth of them.
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.35


def test_no_start_beyond_its_limits_is_drawn():
    """A height close to zero, which may not be below."""
    found = drawn_for(released(0.02, 0.02, bounds=(0.0, 1.0)), 5e-4, 0.005, 0)
    assert found.min() > 0.0
    assert found.max() < 0.02
    assert np.unique(found).size > 300
