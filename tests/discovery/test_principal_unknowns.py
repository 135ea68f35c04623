"""Unknowns that act alike keep what their priors say of their difference, however wide they are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import damper, damper_campaign, oscillator_campaign, with_friction

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._catalogue_mean import linearised_of, shifted
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._principal_unknowns import PrincipalUnknowns
from bayesoleo.discovery._signatures import FittedSignatures, noise_of
from bayesoleo.effects import find_effect
from bayesoleo.error_models._catalogue_evidence import Linearised
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.model import Normal, Output, Parameter
from bayesoleo.systems import system

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "cubic_stiffness", "sensor_offset")))


def _two_springs(sd):
    """A force law in which only the sum of two stiffnesses acts."""
    model = damper(cubic=False)
    both = {name: Parameter(400.0, "N/m", sd=sd) for name in ("stiffness", "second")}
    terms = model.outputs["force"].terms | {"second": "second*displacement"}
    return replace(model, parameters=model.parameters | both, outputs={"force": Output(terms, "N")})


def _oscillator(sd):
    """The same of an oscillator with measured force."""
    model = system("duffing")
    both = {name: Parameter(50.0, "N/m", sd=sd) for name in ("stiffness", "second")}
    terms = model.equations["position"] | {"second": "second*position"}
    return replace(model, parameters=model.parameters | both, equations={"position": terms})


KINDS = {
    "force law": (_two_springs, lambda folder: damper_campaign(folder, with_friction)),
    "oscillator": (
        _oscillator,
        lambda folder: oscillator_campaign(
            folder, restoring=lambda x, v: 100.0 * x + 0.5 * v + 1e4 * x**3 + 30.0 * x**2
        ),
    ),
}


@pytest.fixture(scope="module", params=KINDS)
def fits(request, tmp_path_factory):
    """Fits of one campaign, by the standard deviation of both priors."""
    make, campaign = KINDS[request.param]
    records = assign(campaign(tmp_path_factory.mktemp("runs")).records).fitted
    return {sd: fit_model(make(sd), records, NUMERICS, check_mesh=False) for sd in (1e4, 1e9, 1e12)}


def _signatures(fit):
    return FittedSignatures.of(fit, Assembly(fit.model), noise_of(fit), effects=EFFECTS, jobs=1)


def _of_sum(fit, found):
    """Standard deviation of the sum of both, and of their difference, in units of their priors'."""
    names = [fit.problem.names.index(name) for name in ("stiffness", "second")]
    part = found.covariance[np.ix_(names, names)]
    total = max(part.sum(), 0.0)  # rounding, where the difference is known much less
    return np.sqrt(total), np.sqrt(part[0, 0] + part[1, 1] - 2 * part[0, 1])


def test_the_evidence_does_not_depend_on_how_wide_priors_of_a_difference_are(fits):
    found = {sd: linearised_of(fit.problem, fit.point.theta, _signatures(fit))
             for sd, fit in fits.items()}  # fmt: skip
    # Estimates end within what is asked of an iteration; the evidence is of squares of thousands
    # of samples there.
    for sd in (1e9, 1e12):
        assert found[sd].log_odds == pytest.approx(found[1e4].log_odds, abs=0.05)


def test_the_difference_has_its_prior_and_the_sum_what_the_data_say(fits):
    deviations = {
        sd: _of_sum(fit, linearised_of(fit.problem, fit.point.theta, _signatures(fit)))
        for sd, fit in fits.items()
    }
    for sd, (total, difference) in deviations.items():
        # The noise's variance scales all of a posterior.
        assert difference == pytest.approx(deviations[1e4][1], rel=1e-2)
        assert 0.5 < difference < 2.0
        # A matrix of both holds no more digits of the sum than of the difference.
        least = 1e-7 * sd
        assert total * sd == pytest.approx(deviations[1e4][0] * 1e4, rel=1e-2, abs=least)


def test_the_mean_is_approached_where_the_table_of_signatures_is_used(fits):
    fit = fits[1e9]
    fit.problem.signatures = _signatures(fit).signatures
    try:
        mean = shifted(fit.problem, fit.point.theta)
    finally:
        fit.problem.signatures = None
    assert np.all(np.isfinite(mean.theta))
    assert 0.5 < _of_sum(fit, mean.found)[1] < 2.0


@pytest.mark.parametrize("apart", [1e-3, 1e-7, 1e-11])
def test_what_a_small_difference_shows_is_kept(apart):
    """Against numbers of many digits; products of the unknowns themselves would have none of it."""
    mpmath = pytest.importorskip("mpmath")
    rng, size = np.random.default_rng(3), 1e8
    one, rest = rng.normal(size=(2, 50))
    table = np.column_stack([size * one, size * (one + apart * rest)])
    scale = PriorScale.of((Normal(0.0, 1.0), Normal(0.0, 1.0)), ("a", "b"))
    found = SimpleNamespace(sensitivity=[table])
    turned = PrincipalUnknowns.of(found, scale, np.zeros(2), [1.0])
    gram = turned.sensitivity[0].T @ turned.sensitivity[0] + turned.precision
    with mpmath.workdps(60):
        exact = mpmath.matrix(table.tolist())
        exact = exact.T * exact + mpmath.eye(2)
        log_det = float(mpmath.log(mpmath.det(exact)))
        spread = float((mpmath.inverse(exact))[0, 0])
    # Rounding of the table itself moves a small difference by parts of it.
    assert np.linalg.slogdet(gram)[1] == pytest.approx(log_det, abs=1e-4)
    back = turned.back(Linearised(0.0, np.zeros(2), np.linalg.inv(gram)))
    assert back.covariance[0, 0] == pytest.approx(spread, rel=1e-4)
    assert np.array_equal(back.covariance, back.covariance.T)


def test_a_step_along_directions_is_a_step_of_the_unknowns():
    """With a joint prior, few samples and an unknown that nothing shows."""
    rng = np.random.default_rng(4)
    scale = PriorScale.of([Normal(1.0, sd) for sd in (0.5, 2.0, 3.0, 1.0)], "abcd")
    tables = [rng.normal(size=(n, 4)) * [1, 1, 1, 0] for n in (2, 1)]
    turned = PrincipalUnknowns.of(
        SimpleNamespace(sensitivity=tables), scale, np.full(4, 0.3), [0.1, 7.0]
    )
    step = rng.normal(size=4)
    whole = turned.turn @ step
    np.testing.assert_allclose(turned.turn.T @ turned.turn, np.eye(4), atol=1e-14)
    for table, ours in zip(tables, turned.sensitivity, strict=True):
        np.testing.assert_allclose(ours @ step, table @ (scale.sd * whole), atol=1e-12)
    pull, precision = scale.quadratic(np.full(4, 0.3))
    assert turned.pull @ step == pytest.approx(pull @ whole)
    assert step @ turned.precision @ step == pytest.approx(whole @ precision @ whole)
    np.testing.assert_allclose(turned.back(Linearised(1.0, step, np.eye(4))).shift, whole)
