"""A discrepancy that runs share, against the dense covariance over all of them."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from bayesoleo.error_models import error_model
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._discrepancy import _dense, _diagonal, basis, spectrum
from bayesoleo.estimation._campaign_problem import _samples_of
from bayesoleo.prediction._records import Harmonics, Record

WORD = "shared-discrepancy"


@dataclass
class Runs:
    """As much of a problem as an error model sees; ``even`` runs last whole periods."""

    even: bool
    lengths: tuple = (100, 100, 50)
    outputs: tuple = ("force", "pressure")
    names: tuple = ("stiffness",)

    @property
    def runs(self):
        return tuple(f"run {k}" for k in range(len(self.lengths)))

    @property
    def counts(self):
        return np.array([[n] * len(self.outputs) for n in self.lengths])

    @property
    def samples(self):
        rng = np.random.default_rng(3)
        times = [
            np.arange(n) / 50 if self.even else np.cumsum(rng.uniform(0.01, 0.1, n))
            for n in self.lengths
        ]
        return tuple(
            RunSamples(t, 1.0, origin)
            for t, origin in zip(times, rng.random(len(times)), strict=True)
        )


def drawn(model, rows, seed=0):
    """Coordinates that are anywhere, and residuals of all runs."""
    rng = np.random.default_rng(seed)
    eta = rng.normal(0, 0.8, (rows, len(model.names)))
    outputs = len(model.frame.outputs)
    return eta, [rng.normal(0, 1.5, (rows, outputs, n)) for n in model.frame.counts[:, 0]]


def dense(model, eta, output):
    """Covariance over the samples of all runs by its definition."""
    value = dict(zip(model.names, model.natural(eta[None])[0], strict=True))
    table = np.concatenate([basis(run.phase + run.origin) for run in model.frame.samples])
    weight = spectrum(np.array([value[f"discrepancy_length_{output}"]]))[0]
    which = np.repeat(np.arange(len(model.frame.runs)), model.frame.counts[:, 0])
    alike = np.where(np.equal.outer(which, which), 1.0, value[f"discrepancy_common_{output}"])
    share = value[f"discrepancy_share_{output}"]
    smooth = alike * ((table * weight) @ table.T)
    white = (1 - share) * np.eye(which.size)
    return np.exp(value[f"log_variance_{output}"]) * (white + share * smooth)


@pytest.mark.parametrize("even", [True, False])
def test_runs_given_those_before_are_conditional_normals(even):
    model = error_model(WORD, Runs(even))
    assert model._kernel is (_diagonal if even else _dense)
    eta, residuals = drawn(model, 2)
    found, ends = model.of_runs(residuals, eta), np.cumsum(model.frame.counts[:, 0])
    for lane in range(2):
        up_to = np.zeros(len(ends))
        for b, output in enumerate(model.frame.outputs):
            matrix = dense(model, eta[lane], output)
            e = np.concatenate([run[lane, b] for run in residuals])
            up_to += [
                stats.multivariate_normal(cov=matrix[:end, :end]).logpdf(e[:end]) for end in ends
            ]
        np.testing.assert_allclose(found[lane], np.diff(up_to, prepend=0.0), rtol=1e-9)


def test_without_products_both_ways_are_one():
    model = error_model(WORD, Runs(True))
    eta, residuals = drawn(model, 3)
    quick = model.of_runs(residuals, eta)
    model._kernel = _dense
    np.testing.assert_allclose(model.of_runs(residuals, eta), quick, rtol=1e-11)


@pytest.mark.parametrize("even", [True, False])
def test_a_row_depends_on_itself_alone(even):
    model = error_model(WORD, Runs(even))
    eta, residuals = drawn(model, 9)
    whole = model.of_runs(residuals, eta)
    alone = model.of_runs([e[4:5] for e in residuals], eta[4:5])
    np.testing.assert_array_equal(alone[0], whole[4])


@pytest.mark.parametrize("even", [True, False])
def test_runs_that_share_nothing_have_discrepancies_of_their_own(even):
    """The first run always has: the others tell nothing of it yet."""
    problem = Runs(even)
    model, own = error_model(WORD, problem), error_model("discrepancy", problem)
    eta, residuals = drawn(model, 3)
    apart = eta.copy()
    apart[:, 6:] = -9.0
    expected = own.of_runs(residuals, eta[:, :6])
    np.testing.assert_allclose(model.of_runs(residuals, apart), expected, rtol=1e-9)
    np.testing.assert_allclose(model.of_runs(residuals, eta)[:, 0], expected[:, 0], rtol=1e-9)
    assert np.abs(model.of_runs(residuals, eta)[:, 1:] - expected[:, 1:]).min() > 1e-3


@pytest.mark.parametrize(("common", "expected"), [(4.0, 1.0), (-6.0, np.sqrt(8))])
def test_more_runs_average_away_only_what_each_has_of_its_own(common, expected):
    """Standard deviation of an offset that is alike in all runs, of one run over that of eight."""
    precision = []
    for count in (1, 8):
        model = error_model(WORD, Runs(True, lengths=(100,) * count, outputs=("force",)))
        # Nearly all of the variance is discrepancy: noise adds nothing to what is known of it.
        eta = np.repeat([[-6.0, 3.0, np.log(0.3), common]], 3, axis=0)
        offset = 1e-2 * np.array([-1.0, 0.0, 1.0])
        residuals = [np.tile(offset[:, None, None], (1, 1, 100)) for _ in range(count)]
        height = model.of_runs(residuals, eta).sum(axis=1)
        precision.append(2 * height[1] - height[0] - height[2])
    assert np.sqrt(precision[1] / precision[0]) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_phases_count_from_the_crest_of_the_drive(late):
    """Whenever a record begins, and whichever of its samples counts first."""
    time = np.arange(40) / 20
    turn = np.exp(2j * np.pi * late)  # of x = cos(2 pi (t + late))
    drive = Harmonics(np.array([0, 1]), np.array([3.0, 0.2 * turn]), np.zeros(2))
    record = Record(
        "a", "", "fit", "periodic", 1.0, 0.0, 2, time, {}, {"displacement": drive}, {}
    )  # fmt: skip
    run = _samples_of(record, time[5:], ("displacement",))
    crest = np.cos(2 * np.pi * (run.phase + run.origin))
    np.testing.assert_allclose(crest, np.cos(2 * np.pi * (time[5:] + late)), atol=1e-12)
    assert _samples_of(record, time, ("other",)).origin == 0.0
