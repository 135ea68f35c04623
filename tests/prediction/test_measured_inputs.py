"""A measured channel as an input at another one's harmonics: what a frame's compliance needs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from multisines import multisine_campaign, resonance

from bayesoleo.errors import CampaignError
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.model._expressions import within
from bayesoleo.prediction import _inputs, _run_errors
from bayesoleo.prediction._band_limited import declared
from bayesoleo.prediction._inputs import harmonics_of, input_rows, signal_of
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record, transient_record
from bayesoleo.prediction._run_errors import counted_parts, errors_known, input_columns


def harmonics(**amplitudes):
    orders = np.array([int(name[1:]) for name in amplitudes])
    coefficients = np.array(list(amplitudes.values()), dtype=complex)
    return Harmonics(orders, coefficients, 1e-4 * np.ones(orders.size))


@pytest.fixture
def record():
    time = np.arange(40) / 20.0
    channels = {
        "force": harmonics(h0=3.0, h1=5.0 - 2.0j, h2=1.0j, h7=0.4),
        "displacement": harmonics(h1=0.1, h3=0.02),
    }
    samples = {name: item.evaluate(time, 1.0) for name, item in channels.items()}
    noise = dict.fromkeys(channels, 0.01)
    return Record("a", "", "fit", "periodic", 1.0, 0.0, 2, time, samples, channels, noise)


def test_only_common_harmonics_are_left(record):
    name = within("force", "displacement")
    item = harmonics_of(record, name)
    assert item.orders.tolist() == [1]
    assert item.coefficients.tolist() == [5.0 - 2.0j]
    phase = np.linspace(0, 1, 7)
    omega = 2 * np.pi
    rate = -5.0 * omega * np.sin(omega * phase) + 2.0 * omega * np.cos(omega * phase)
    np.testing.assert_allclose(input_rows(record, ((name, 1),), phase)[0], rate, atol=1e-12)


def test_what_both_channels_show_alike_cancels(record):
    """Position behind a frame: cut off alike, a jump in the force leaves no ripple."""
    compliance = 1e-3
    behind = record.harmonics["displacement"].coefficients[0]
    shown = behind + compliance * signal_of(record, within("force", "displacement")).coefficients[0]
    assert shown - compliance * record.harmonics["force"].coefficients[1] == pytest.approx(behind)


def test_an_unknown_channel_is_still_one(record):
    with pytest.raises(CampaignError, match="the model needs channel 'torque_within_displacement'"):
        signal_of(record, "torque_within_displacement")


def test_of_a_transient_noise_above_the_band_of_the_motion_is_not_fed_back():
    """A force whose noise nobody can tell from signal, behind a frame: the noise of the output must
    not enter its prediction."""
    rng, time = np.random.default_rng(3), np.arange(400) / 100.0
    motion = 0.01 * np.sin(2 * np.pi * 1.3 * time) * np.exp(-time) + 1e-6 * rng.standard_normal(400)
    noise = rng.standard_normal(400)
    force = 2e3 * motion + noise
    record = transient_record("a", time, {"force": force, "displacement": motion})
    whole = declared(force, 0.01, 50.0)  # as where its spectrum shows no floor
    record = replace(record, smoothed={**record.smoothed, "force": whole})
    cut = signal_of(record, "displacement", 1).band.cut
    assert cut < 10.0
    restricted = signal_of(record, within("force", "displacement"), 1)
    shown = restricted.at(time)
    window = np.hanning(time.size)  # the ends differ
    spectrum = np.abs(np.fft.rfft(window * (shown - shown.mean()))) ** 2
    frequency = np.fft.rfftfreq(time.size, 0.01)
    measured = np.abs(np.fft.rfft(window * noise)) ** 2
    above = frequency > 2.0 * cut  # the curve fades out over half its bandwidth
    # A thousandth of the power: amplitude is down by thirty.
    assert spectrum[above].sum() < 1e-3 * measured[above].sum()
    # What moves the frame is left as it is.
    slow = 2e3 * motion
    assert np.std((shown - slow)[20:-20]) < 0.6 * noise.std()


@pytest.mark.parametrize(
    ("highest", "count"), [(40, 40), (130, 130), (900, 900), (900, 100), (900, 30)]
)
@pytest.mark.parametrize("derivative", [0, 2])
def test_many_harmonics_are_the_sum_of_each(highest, count, derivative):
    rng = np.random.default_rng(highest)
    orders = np.sort(rng.choice(highest + 1, size=count, replace=False))
    value = rng.standard_normal((2, orders.size)) / (1.0 + orders**derivative)
    signal = Harmonics(orders, value[0] + 1j * value[1] * (orders > 0), np.ones(orders.size))
    phase, expected = rng.uniform(0.0, 3.0, 700), np.zeros(700)
    for order, real, imaginary in zip(orders, *value, strict=True):
        turn, rate = 2 * np.pi * order * phase, (2 * np.pi * 5.0 * order) ** derivative
        sign = -1.0 if derivative == 2 else 1.0
        expected += sign * rate * (real * np.cos(turn) - imaginary * np.sin(turn))
    found = signal.evaluate(phase, 5.0, derivative)
    # A phase is good to 1e-16 of three cycles, and the highest order turns 900 times as far.
    np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())


def test_noise_moves_an_input_along_every_part_of_its_harmonics_but_that_of_a_mean():
    orders = np.array([0, 1, 5])
    item = Harmonics(orders, np.ones(3, dtype=complex), np.array([1.0, 4.0, 0.0]))
    # A mean moves the value, and not its rate; what has no noise moves nothing.
    assert counted_parts(item, [0, 1]).tolist() == [True, True, False, False, True, False]
    assert counted_parts(item, [1, 2]).tolist() == [False, True, False, False, True, False]


def of_a_multisine(outputs):
    """A resonator under a force of 700 lines with noise."""
    (record,) = multisine_campaign(
        resonance, realisations=1, orders=range(1, 401), input_noise=0.3, noise=1e-3
    ).records
    model = Model(
        "resonator",
        dofs={"x": Dof("m")},
        inputs={"force": "N"},
        parameters={"damping": Parameter(0.1, sd=0.1), "cubic": Parameter(0.0, sd=1.0)},
        equations={"x": "ddot(x)/125.7**2 + damping*dot(x)/125.7 + x + cubic*x**3 - force"},
        outputs=outputs,
    )
    predictor = Predictor(model, [record], steps=2048, backend="numpy", jobs=1)
    return predictor, predictor.runs[0]


@pytest.mark.parametrize("cubic", [0.0, 0.05])
def test_many_harmonics_with_noise_are_a_few_columns_of_the_same_size(cubic, monkeypatch):
    predictor, run = of_a_multisine({"displacement": Output("x", "m")})
    p = predictor.constants(np.array([[0.1, cubic]]), 0)[0]
    run.set_anchor(p)
    few = input_columns(run, p)
    assert few.shape[1] == _run_errors.MOST_LINES
    assert not errors_known(run)
    monkeypatch.setattr(_run_errors, "MOST_LINES", 10_000)
    every = input_columns(run, p)
    assert every.shape[1] > 700
    assert errors_known(run)
    together, each = (np.sum(part[0] ** 2, axis=0) for part in (few, every))
    # Harmonics of a linear answer are orthogonal, up to its mesh. A cubic spring mixes neighbours,
    # and a dozen columns about the resonance hold most of it.
    assert together.mean() == pytest.approx(each.mean(), rel=1e-6 if cubic == 0.0 else 0.15)
    # Where in the spectrum it is, a band of lines each.
    bands = [
        np.abs(np.fft.rfft(part[0], axis=1)[:, : 4 * 400].reshape(len(part[0]), 40, -1)) ** 2
        for part in (few, every)
    ]
    sums = [band.sum(axis=(0, 2)) for band in bands]
    np.testing.assert_allclose(sums[0], sums[1], rtol=1e-5 if cubic == 0.0 else 0.5)


def test_changes_by_the_inputs_are_kept_until_anything_that_they_depend_on_is_another():
    predictor, run = of_a_multisine({"displacement": Output("x", "m")})
    model, (record,) = predictor.model, predictor.records
    p = predictor.constants(np.array([[0.1, 0.05]]), 0)[0]
    run.set_anchor(p)
    first = input_columns(run, p)
    assert not first.flags.writeable
    assert input_columns(run, p) is first
    assert input_columns(run, p, draws=4) is first  # draws are of transients
    assert not np.array_equal(input_columns(run, p + np.array([0.0, 0.01])), first)

    def by_another(model, record, steps=2048):
        other = Predictor(model, [record], steps=steps, backend="numpy", jobs=1).runs[0]
        other.set_anchor(p)
        return input_columns(other, p)

    # A score of the same run has a predictor of its own, and one solution in all digits or not.
    np.testing.assert_allclose(by_another(model, record), first, atol=1e-9)
    twice = replace(model, outputs={"displacement": Output("2*x", "m")})
    np.testing.assert_allclose(by_another(twice, record), 2.0 * first, atol=1e-9)
    louder = replace(record, harmonics=louder_harmonics(record))
    np.testing.assert_allclose(by_another(model, louder), 3.0 * first, atol=1e-9)
    assert not np.allclose(by_another(model, record, steps=1024), first, rtol=0.0, atol=1e-9)


def louder_harmonics(record):
    """Three times the noise in each."""
    return {
        name: replace(item, variances=9.0 * item.variances)
        for name, item in record.harmonics.items()
    }


def test_few_harmonics_keep_a_column_each():
    (known,) = multisine_campaign(resonance, realisations=1, input_noise=0.1).records
    item = known.harmonics["force"]
    found = _run_errors._harmonic_changes(item, known.frequency, (0,), known.phase)
    assert found.shape[1] == 2 * item.orders.size - (0 in item.orders)
    first = item.orders[1 if 0 in item.orders else 0]
    sd = np.sqrt(item.variances[list(item.orders).index(first)])
    np.testing.assert_allclose(
        found[0, 1 if 0 in item.orders else 0], sd * np.cos(2 * np.pi * first * known.phase),
        atol=1e-12,
    )  # fmt: skip


def test_changes_by_harmonics_are_kept_for_the_next_model_and_not_for_another_run(
    record, monkeypatch
):
    phase, turned = np.linspace(0, 1, 9), np.linspace(0, 2, 9)
    asked = [("force", 1, (0, 1), phase), ("force", 1, (0, 1), turned), ("force", 1, (1,), phase)]
    asked += [("displacement", 1, (0, 1), phase)]
    found = {}
    for other in (record, replace(record, frequency=2.0)):
        for channel, highest, derivatives, at in asked:
            item = harmonics_of(other, channel).for_derivative(highest)
            rightly = _run_errors._harmonic_changes(item, other.frequency, derivatives, at)
            now = _run_errors._changes_of(other, channel, highest, derivatives, at)
            np.testing.assert_array_equal(now, rightly)
            found[len(found)] = now
    monkeypatch.setattr(_run_errors, "_harmonic_changes", None)  # nothing is made again
    assert _run_errors._changes_of(record, *asked[0]) is found[0]


@pytest.mark.parametrize("rows", [(("force", 0), ("force", 1)), (("displacement", 2),)])
def test_inputs_at_looks_are_made_once_for_all_models_of_a_run(record, monkeypatch, rows):
    def looked(of):
        run = SimpleNamespace(
            record=of,
            kernels=SimpleNamespace(derived=SimpleNamespace(inputs=rows)),
            period=1.0 / of.frequency,
        )
        return _run_errors._inputs_at(run)

    phase = np.linspace(0.0, 1.0, 50)
    for other in (record, replace(record, frequency=2.0 * record.frequency)):
        np.testing.assert_allclose(
            looked(other)(phase), input_rows(other, rows, phase), rtol=1e-9, atol=1e-9
        )
        np.testing.assert_allclose(
            looked(other)(0.5 * phase), input_rows(other, rows, 0.5 * phase), rtol=1e-9, atol=1e-9
        )
    monkeypatch.setattr(_run_errors, "evaluate", None)  # nothing is made again
    assert looked(record)(phase).shape == (len(rows), 50)


def test_models_of_a_periodic_run_share_its_rows_on_a_grid(record, monkeypatch):
    rows, phase = (("force", 1),), np.linspace(0.0, 1.0, 30)
    first = input_rows(record, rows, phase, "a grid", {})
    other = replace(record, frequency=2.0 * record.frequency)
    np.testing.assert_allclose(input_rows(other, rows, phase, "a grid", {}), 2.0 * first)
    monkeypatch.setattr(_inputs, "signal_of", None)  # nothing is made again
    np.testing.assert_array_equal(input_rows(record, rows, phase, "a grid"), first)
