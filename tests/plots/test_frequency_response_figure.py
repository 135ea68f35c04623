"""The figure of multisine runs shows each level, its kinds of lines and what is known of them."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.text import Text
from multisines import ODD_GRID, multisine_campaign, resonance

from bayesoleo import plots
from bayesoleo.data import frequency_response
from bayesoleo.data._frequency_response import stored
from bayesoleo.errors import InputError
from bayesoleo.plots import _style as style


def texts(figure) -> list[str]:
    figure.savefig(io.BytesIO(), format="png", dpi=40)
    return [text for item in figure.findobj(Text) if (text := item.get_text())]


def law(u):
    return resonance(u) + 0.05 * u**2


@pytest.fixture(scope="module")
def two_levels():
    return frequency_response(multisine_campaign(law, noise=0.02, levels=(0.5, 1.0)))


def test_a_row_for_each_level_with_its_lines(two_levels):
    figure = plots.frequency_response(two_levels)
    assert len(figure.axes) == 4
    shown = texts(figure)
    assert {"excited lines", "even lines", "odd lines", "between realisations"} <= set(shown)
    assert any(text.startswith("1.000 N rms, 4 realisations") for text in shown)
    assert sum(text.startswith("times the noise: even ") for text in shown) == 2
    # On the last row on the left: noise, total, and the response at the excited lines.
    response = figure.axes[2].lines[-1]
    assert response.get_color() == style.INK
    drawn = np.isfinite(response.get_ydata())
    assert drawn.sum() == len(ODD_GRID)


def test_what_is_stored_is_drawn_alike(two_levels):
    first, second = (
        plots.frequency_response(data, "displacement") for data in (two_levels, stored(two_levels))
    )
    for one, other in zip(first.axes, second.axes, strict=True):
        for line, same in zip(one.lines, other.lines, strict=True):
            np.testing.assert_allclose(line.get_ydata(), same.get_ydata(), rtol=1e-12)


def test_one_realisation_has_no_scatter_and_a_sine_has_harmonics():
    one = frequency_response(multisine_campaign(law, noise=0.02, realisations=1))
    assert "between realisations" not in texts(plots.frequency_response(one))
    sine = frequency_response(multisine_campaign(law, noise=0.02, realisations=1, orders=(1,)))
    shown = texts(plots.frequency_response(sine))
    assert any(text.startswith("1.000 N rms, 1 realisation, ") for text in shown)


@pytest.mark.slow
def test_many_levels_are_cut_and_said_so():
    levels = tuple(0.5 * 1.5**k for k in range(8))
    found = frequency_response(
        multisine_campaign(law, noise=0.02, realisations=1, levels=levels, periods=2)
    )
    figure = plots.frequency_response(found)
    assert len(figure.axes) == 12
    assert "first 6 of 8 levels" in texts(figure)


def test_an_output_that_is_not_there_is_named(two_levels):
    with pytest.raises(InputError, match="displacement"):
        plots.frequency_response(two_levels, "voltage")
