"""A measured channel as an input at another one's harmonics: what a frame's compliance needs."""

import numpy as np
import pytest

from bayesoleo.errors import CampaignError
from bayesoleo.model._expressions import within
from bayesoleo.prediction._inputs import harmonics_of, input_rows, signal_of
from bayesoleo.prediction._records import Harmonics, Record


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
