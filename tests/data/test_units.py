"""Units: SI factors and names, pounds per square inch of both kinds, and inverses."""

import re

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bayesoleo._units import angle_hint, check_kind, parse_unit, same_quantity
from bayesoleo.errors import CampaignError

UNITS = [
    "mm",
    "in",
    "kN",
    "lbf",
    "bar",
    "psi",
    "psia",
    "psig",
    "bara",
    "barg",
    "degC",
    "K",
    "mV",
    "rpm",
    "1",
    "m/s",
]


@pytest.mark.parametrize(
    ("name", "value", "si", "si_name"),
    [
        ("mm", 1.0, 1e-3, "m"),
        ("kN", 2.0, 2000.0, "N"),
        ("bar", 1.0, 1e5, "Pa"),
        ("psia", 100.0, 689475.729, "Pa"),
        ("psig", 100.0, 689475.729, "Pa"),
        ("degC", 20.0, 293.15, "K"),
        ("degF", 68.0, 293.15, "K"),
        ("lbf", 1.0, 4.4482216, "N"),
        ("V", 1.0, 1.0, "V"),
        ("mN*m", 2.0, 2e-3, "N*m"),
        ("l/min", 60.0, 1e-3, "m**3/s"),
        ("kg/m**3", 2.0, 2.0, "kg/m**3"),
        ("lbf*ft", 1.0, 1.3558179, "N*m"),
        ("kJ", 2.0, 2000.0, "J"),
        ("Hz", 3.0, 3.0, "Hz"),
        ("1", 3.0, 3.0, "1"),
        ("W/K", 1.0, 1.0, "kg*m**2/K/s**3"),
        ("rev/min", 60.0, 2 * np.pi, "rad/s"),
        ("bar(a)", 2.0, 2e5, "Pa"),
        ("psi (g)", 100.0, 689475.729, "Pa"),
        ("bar abs", 2.0, 2e5, "Pa"),
    ],
)
def test_to_si(name, value, si, si_name):
    unit = parse_unit(name)
    assert float(unit.to_si(value)) == pytest.approx(si, rel=1e-7)
    assert unit.si_name == si_name


@given(st.sampled_from(UNITS), st.floats(-1e6, 1e6))
def test_inverse(name, value):
    unit = parse_unit(name)
    # A temperature's shift of 273 K costs its absolute rounding.
    assert np.isclose(unit.from_si(unit.to_si(value)), value, rtol=1e-12, atol=1e-10)


def test_unknown_unit():
    with pytest.raises(CampaignError, match=r"unknown unit \(got 'foo/bar'\)"):
        parse_unit("foo/bar")


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("Nm", "N*m"),
        ("mNm", "mN*m"),
        ("m/s2", "m/s**2"),
        ("Ns/m", "N*s/m"),
        ("kg/m3", "kg/m**3"),
        ("KN", "kN"),
        ("MPA", "MPa"),
        ("Bar", "bar"),
        ("barA", "bara"),
        ("Kelvin", "kelvin"),
        ("degrC", "degC"),
        ("ms-2", "m*s**-2"),
        ("m s-2", "m s**-2"),
    ],
)
def test_an_unknown_unit_gets_a_suggestion_that_is_known(wrong, meant):
    with pytest.raises(CampaignError, match=re.escape(f"did you mean {meant}?")):
        parse_unit(wrong)
    assert parse_unit(meant).factor > 0


@pytest.mark.parametrize(
    ("written", "factor", "unit"),
    [("1e-6", "1e-06", "1"), ("10 mm", "10", "mm"), ("0.1 bar", "0.1", "bar")],
)
def test_a_factor_in_a_unit_belongs_in_scale(written, factor, unit):
    hint = re.escape(f"write scale = {factor} and unit = '{unit}'")
    with pytest.raises(CampaignError, match=rf"a unit has no factor.*{hint}"):
        parse_unit(written)


def test_kind():
    check_kind("initial_pressure", parse_unit("psia"))
    with pytest.raises(CampaignError, match=r"does not measure temperature \(got 'bar'\)"):
        check_kind("ambient_temperature", parse_unit("bar"))


def test_a_torque_may_be_called_an_energy_but_no_force():
    assert same_quantity("N*m", "J")
    assert same_quantity("J", "J")
    assert not same_quantity("N*m", "N")


@pytest.mark.parametrize("given", ["1/min", "min**-1", "1/s", "Hz", "kHz", "1 / min"])
def test_events_of_an_angle_are_turns_or_radians(given):
    """Each unit that is proposed is in rad/s, and the two differ by one turn."""
    hint = angle_hint(given, "rad/s")
    assert hint.startswith(f"{given} counts events, rad/s measures an angle")
    turns, radians = (parse_unit(name) for name in re.findall("'([^']+)'", hint))
    assert (turns.si_name, radians.si_name) == ("rad/s", "rad/s")
    assert turns.factor == pytest.approx(2 * np.pi * parse_unit(given).factor, rel=1e-12)
    assert radians.factor == pytest.approx(parse_unit(given).factor, rel=1e-12)


def test_revolutions_a_minute_are_proposed_by_their_usual_name():
    assert "'rpm' if each event is a turn" in angle_hint("1/min", "rad/s")


@pytest.mark.parametrize("wanted", ["Hz", "1/s"])
@pytest.mark.parametrize("given", ["rpm", "rad/s", "deg/s"])
def test_an_angle_where_events_are_counted_is_told(given, wanted):
    assert "declare the model in rad/s" in angle_hint(given, wanted)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [("mm", "rad/s"), ("Hz", "1/s"), ("rpm", "rad/s"), ("N*m", "N*m/rad"), ("%", "rad")],
)
def test_other_units_differ_by_no_angle(given, wanted):
    assert angle_hint(given, wanted) == ""
