"""An average over structures that is not stated says why, and each reason has its own text."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo.discovery import _averaged_parameters as averaged
from bayesoleo.discovery._adaptive_grid import FINE, GridDensity
from bayesoleo.discovery._structures import AveragedParameter, Structure
from bayesoleo.model import Normal


def exact(probability, outside, *, poor=True, bent=False, followed=False, why=None):
    """One parameter in a structure, that is known unless it is poor."""
    structure = Structure((), outside, probability, 0.0, True)
    known = SimpleNamespace(
        structure=structure, poor=np.array([poor and not bent]), numbers=lambda _: [0],
        mixtures=[None], probability=probability,
    )  # fmt: skip
    one = averaged._Exact(known, None)
    one.poor, one.is_followed, one.why = np.array([poor]), followed, why or {}
    return one


def reason_of(*every):
    unknown = [found for one in every if (found := one.unknown("damping")) is not None]
    return averaged._reason(unknown, sum(one.known.probability for one in every))


def test_what_is_well_known_without_an_unknown_law_is_not_said_to_be_poorly_known():
    """The final model may know it to a thousandth."""
    text = reason_of(exact(0.6, True, followed=True, why={0: averaged.PEAKS}),
                     exact(0.4, False, poor=False))  # fmt: skip
    assert text.startswith(
        "Where something outside the catalogue acts the data determine this parameter to worse than"
        " a tenth of itself, and its density has several peaks along the model: no average"
    )


def test_each_reason_has_its_text():
    assert "In all structures the data determine" in reason_of(exact(0.6, True), exact(0.4, False))
    assert averaged.RARE in reason_of(exact(1.0, False))
    assert averaged.BY_RUN in reason_of(exact(1.0, False, followed=True))
    assert averaged.LONG in reason_of(exact(1.0, False, followed=True, why={0: averaged.LONG}))
    some = reason_of(exact(0.5, False), exact(0.5, False, poor=False))
    assert some.startswith("In structures with a tenth of the probability or more the data")
    bent = reason_of(exact(1.0, False, bent=True))
    assert averaged.BENT in bent
    assert "worse than a tenth" not in bent
    # Of several that with most of the probability.
    assert averaged.RARE in reason_of(exact(0.6, False), exact(0.4, False, followed=True))


@pytest.mark.parametrize(
    ("low", "high", "estimate", "excluded"),
    [
        (14.9, 15.1, 15.0, False),
        (-770.0, 20.0, 15.0, True),  # a linear model carried on far beyond the estimates
        (90.0, 91.0, 90.5, False),  # the data contradict the prior, and an estimate lies there
    ],
)
def test_an_interval_that_only_continuation_reaches_is_not_stated(low, high, estimate, excluded):
    one = exact(1.0, False, poor=False)
    one.known.here = SimpleNamespace(theta=np.array([estimate]), priors=(Normal(12.0, 12.0),))
    found = AveragedParameter(estimate, 1.0, low, high, estimate)
    assert averaged._is_excluded("damping", [one], found) == excluded


def grid(unknown=0.0, gap=0.0, modes=1):
    return GridDensity(np.zeros(FINE), unknown, gap, modes)


@pytest.mark.parametrize(
    ("found", "spent", "why"),
    [
        (grid(), False, ""),
        (grid(), True, ""),
        (grid(unknown=0.2), False, averaged.UNSOLVED),
        (grid(unknown=0.2), True, averaged.SPARSE),
        (None, False, averaged.UNSOLVED),
        (grid(gap=0.4), False, averaged.SPARSE),
        (grid(modes=2), False, averaged.PEAKS),
    ],
)
def test_what_a_density_lacks(found, spent, why):
    assert averaged._lacking(found, spent) == why
