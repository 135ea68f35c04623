"""Numbers and units on axes and in tables say what is stored."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, strategies as st

from bayesoleo.plots._style import engineering, format_number, format_unit, format_value

UNITS = ["N", "Pa", "m", "m/s", "s/m", "N/m", "m^2", "m**3", "kg", "1", "", "N*s^2/m^2", "mol/Pa"]


@pytest.mark.parametrize(
    ("value", "unit", "sd", "text"),
    [
        (0.0123, "m", None, "12.30 mm"),
        (5.2e4, "N", None, "52.00 kN"),
        (2.1e6, "Pa", 1e4, "2.100 MPa"),
        (4.02e-3, "m^2", 3e-6, "40.200 cm²"),
        (1.131e-3, "m**3", 1.4e-6, "1131.0 cm³"),
        (-2.4e-6, "mol/Pa", 4e-8, "−2.400 µmol/Pa"),
        (1150.0, "s/m", 62.0, "1150 s/m"),
        (1.39, "1", 0.002, "1.3900"),
        (2.5e-7, "kg", None, "250.0 10⁻⁹ kg"),
        (0.0, "N", 2.0, "0.0 N"),
        (913.0, "N*s^2/m^2", 21.0, "913 N·s²/m²"),
        (8.7e-4, "rad", None, "870.0 µrad"),
        (0.3, "N*m", 1e-3, "300.0 mN·m"),
        (None, "N", None, "–"),
        (math.nan, "N", 1.0, "–"),
    ],
)
def test_values_as_an_engineer_reads_them(value, unit, sd, text):
    assert format_value(value, unit, sd) == text


@given(st.floats(1e-12, 1e12), st.sampled_from(UNITS))
def test_a_scale_is_a_power_of_ten_and_leaves_a_readable_number(size, unit):
    scale = engineering(unit, size)
    exponent = math.log10(scale.factor)
    assert exponent == pytest.approx(round(exponent), abs=1e-9)
    assert 9e-3 <= size * scale.factor < 1.1e5


@given(st.floats(-1e9, 1e9).filter(lambda v: abs(v) > 1e-9), st.floats(1e-6, 1e6))
def test_rounding_keeps_a_number_within_a_tenth_of_its_sd(value, sd):
    shown = float(format_number(value, sd).replace("−", "-"))
    assert abs(shown - value) <= 0.1 * sd + 1e-12 * abs(value)


def test_unit_text():
    assert format_unit("N*s/m**2") == "N·s/m²"
    assert format_unit("kg m^-3") == "kg·m⁻³"
    assert format_unit("ln((V)^2)") == "ln V²"
    assert format_unit("dimensionless") == ""
    assert engineering("V", 3e-5).label("voltage") == "voltage in µV"
    assert engineering("1", 0.5).label("phase") == "phase"
