"""The catalogue as discrepancy: its density by definition, its draws, and the choice of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp
from test_error_model_densities import Campaign

from bayesoleo.discovery._inference import error_model_by
from bayesoleo.discovery._signatures import Lines, colour_of, spectrum_of_process
from bayesoleo.error_models import CatalogueErrors, Frame, Signatures, error_model
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._catalogue_evidence import ALONE, REMAINDERS
from bayesoleo.error_models._correlated import covariance
from bayesoleo.error_models._signatures import (
    POINTS,
    alike,
    curves_of,
    equal_shares,
    interpolated,
    smooth_basis,
)
from bayesoleo.model._priors import LogUniform

WHITE = (0.0, 1.0)
CASES = {
    "two outputs, one coloured": (("force", "pressure"), (41, 60), 0.5, (WHITE, (0.6, 0.3)), 5),
    "transients of different lengths": (("force",), (30, 50, 20), None, ((0.3, 0.2),), 4),
    "more effects than can be told apart": (("force",), (60,), 0.5, (WHITE,), 90),
    "no effects": (("force", "pressure"), (41, 60), 0.5, (WHITE, WHITE), 0),
}


def campaign_of(outputs, lengths, frequency, colour, count, scale=1.0):
    """A campaign with random signatures; ``scale`` is a change of the outputs' units."""
    runs = tuple("abcdef"[: len(lengths)])
    found = Campaign(outputs=outputs, runs=runs, lengths=lengths, frequency=frequency)
    if not count:
        found.signatures = None
        return found
    rng, s = np.random.default_rng(2), len(outputs)
    found.signatures = Signatures(
        names=tuple(f"effect {k}" for k in range(count)),
        runs=runs,
        columns=tuple(scale * rng.standard_normal((s, count, n)) for n in lengths),
        noise=scale * np.array([1.5, 0.3])[:s],
        colour=colour,
        curves={run: scale * rng.standard_normal((s, count, POINTS)) for run in runs},
        share=rng.uniform(0.1, 0.9, count),
        single=np.array([0, 2]),
        odds=np.array([0.3, 0.7]),
        origins={},
    )
    return found


def flat(campaign, parts):
    """Arrays (s, ..., n) of each run, outputs one after the other."""
    return np.concatenate(
        [part[b] for part in parts for b in range(len(campaign.outputs))], axis=-1
    )


def dense(campaign, model, eta):
    """Covariance without an effect that acts alone, by its definition."""
    value = dict(zip(model.names, model.natural(eta[None])[0], strict=True))
    given, size = campaign.signatures, value["remainder_size"]
    places = [(r, b) for r in range(len(campaign.runs)) for b in range(len(campaign.outputs))]
    rows = []
    for r, b in places:
        v = np.exp(value[f"log_variance_{campaign.outputs[b]}"])
        mine, row = smooth_basis(campaign.samples[r].phase), []
        for q, c in places:
            block = np.zeros((campaign.lengths[r], campaign.lengths[q]))
            if b == c:
                other = smooth_basis(campaign.samples[q].phase)
                block += 0.5 * size**2 * v * (1 + (r == q)) * mine @ other.T
            if (r, b) == (q, c):
                share, time = WHITE if given is None else given.colour[b]
                block += covariance(campaign.samples[r].time, v, share, time)
            if given is not None:
                table = given.columns[r][b].T @ given.columns[q][c]
                block += value["catalogue_size"] ** 2 * table
            row.append(block)
        rows.append(row)
    return np.block(rows)


def by_definition(campaign, model, eta, x):
    """Log density of residuals, one effect that acts alone included."""
    matrix, given = dense(campaign, model, eta), campaign.signatures
    plain = stats.multivariate_normal(cov=matrix).logpdf(x)
    if given is None:
        return plain
    columns, terms = flat(campaign, given.columns), [np.log(0.5) + plain]
    sizes = np.exp(np.linspace(np.log(0.03), np.log(given.largest), ALONE))
    for odds, k in zip(given.odds, given.single, strict=True):
        alone = columns[k] / np.sqrt(given.share[k])
        for size in sizes:
            wide = matrix + size**2 * np.outer(alone, alone)
            terms.append(np.log(0.5 * odds / ALONE) + stats.multivariate_normal(cov=wide).logpdf(x))
    return float(logsumexp(terms))


@pytest.mark.parametrize("case", CASES)
def test_density_is_that_of_its_definition(case):
    campaign = campaign_of(*CASES[case])
    model, rng = error_model("catalogue", campaign), np.random.default_rng(0)
    eta = rng.normal(0, 0.5, (3, len(model.names)))
    residuals = [rng.standard_normal((3, len(campaign.outputs), n)) for n in campaign.lengths]
    found = model.of_runs(residuals, eta).sum(axis=1)
    for lane in range(3):
        x = flat(campaign, [e[lane] for e in residuals])
        exact = by_definition(campaign, model, eta[lane], x)
        # Directions of the signatures below a tenth of the noise are left out.
        assert found[lane] == pytest.approx(exact, rel=1e-9 if len(x) > 90 else 1e-2)
    rows = [rng.standard_normal((2, len(campaign.outputs), n)) for n in campaign.lengths]
    columns = [[row[:, b] for b in range(len(campaign.outputs))] for row in rows]
    c = flat(campaign, [np.moveaxis(row, 1, 0) for row in rows])
    exact = c @ np.linalg.solve(dense(campaign, model, eta[0]), c.T)
    np.testing.assert_allclose(model.products_of_all(columns, eta[0]), exact, rtol=1e-2)


@pytest.mark.parametrize("scale", [1e3, 1e-6])
def test_units_do_not_matter(scale):
    case, rng = CASES["two outputs, one coloured"], np.random.default_rng(1)
    one, other = (error_model("catalogue", campaign_of(*case, s)) for s in (1.0, scale))
    eta = rng.normal(0, 0.5, (2, len(one.names)))
    residuals = [rng.standard_normal((2, 2, n)) for n in case[1]]
    moved = eta.copy()
    moved[:, :2] += 2 * np.log(scale)
    change = 2 * sum(case[1]) * np.log(scale)
    np.testing.assert_allclose(
        other.of_runs([scale * e for e in residuals], moved).sum(axis=1),
        one.of_runs(residuals, eta).sum(axis=1) - change,
        rtol=1e-9,
    )


def test_a_row_depends_on_itself_alone():
    campaign = campaign_of(*CASES["two outputs, one coloured"])
    model, rng = error_model("catalogue", campaign), np.random.default_rng(3)
    eta = rng.normal(0, 0.5, (9, len(model.names)))
    residuals = [rng.standard_normal((9, 2, n)) for n in campaign.lengths]
    whole = model.of_runs(residuals, eta)
    np.testing.assert_array_equal(model.of_runs([e[4:5] for e in residuals], eta[4:5])[0], whole[4])


def test_an_effect_that_acts_alone_is_found_again():
    """Coefficients given the residuals are those of the effect that was added."""
    campaign = campaign_of(*CASES["two outputs, one coloured"])
    given, rng = campaign.signatures, np.random.default_rng(4)
    alone = [5.0 * c[:, 2] / np.sqrt(given.share[2]) for c in given.columns]
    e = [a + given.noise[:, None] * rng.standard_normal(a.shape) for a in alone]
    model = error_model("catalogue", campaign)
    eta = np.tile(model.start(e), (200, 1))
    common = model.common([np.repeat(one[None], 200, axis=0) for one in e], eta, rng)
    drawn = np.einsum("wk,skn->wsn", common[:, :5], given.columns[0])
    # A tenth of the effect is many standard errors of some hundred samples.
    np.testing.assert_allclose(drawn.mean(axis=0), alone[0], atol=0.1 * np.abs(alone[0]).max())
    j = [[np.ones((1, n)) for _ in range(2)] for n in campaign.lengths]
    left = [list(one) for one in e]
    found = model.linearised(j, left, np.eye(1), np.zeros(1))
    assert found.log_odds > 10
    noise = [given.noise[:, None] * rng.standard_normal(a.shape) for a in alone]
    assert model.linearised(j, [list(n) for n in noise], np.eye(1), np.zeros(1)).log_odds < 1.5


def test_runs_share_what_a_draw_is_given():
    """With no noise to speak of two repetitions differ by their own remainders only."""
    campaign = campaign_of(("force",), (60, 60), 0.5, (WHITE,), 3)
    model, rng = CatalogueErrors(Frame.of(campaign)), np.random.default_rng(0)
    natural = np.tile([-20.0, 0.01, 2.0], (4, 1))
    common = np.zeros((4, 3 + smooth_basis(np.zeros(1)).shape[1]))
    common[:, 1] = 1.0
    when = RunSamples(np.arange(40) / 20, 0.5)
    found = model.draw(natural, "b", when, rng, common)
    exact = campaign.signatures.at("b", 0.5 * when.time, True)[:, 1]
    np.testing.assert_allclose(found, np.repeat(exact[None], 4, axis=0), atol=1e-3)


@pytest.mark.parametrize("periodic", [True, False])
def test_curves_give_back_smooth_signatures(periodic):
    rng = np.random.default_rng(0)
    position = np.linspace(0, 3.97 if periodic else 1.0, 700)
    phases = rng.uniform(0, 6, (2, 3, 1))
    columns = np.sin(2 * np.pi * position + phases)
    wanted = rng.uniform(0, 3 if periodic else 1, 50)
    found = interpolated(curves_of(columns, position, periodic), wanted, periodic)
    # Two linear interpolations between 175 and 256 points of a sine: (2 pi / 175)^2 / 8 each.
    np.testing.assert_allclose(found, np.sin(2 * np.pi * wanted + phases), atol=4e-4)


def test_near_copies_share_what_one_of_them_has():
    shares = equal_shares(["friction"] * 4 + ["gas"], ["a", "a", "b", "c", "d"])
    np.testing.assert_allclose(shares, [1 / 6, 1 / 6, 1 / 3, 1 / 3, 1])
    # The second is the first's negative, and the last but 0.89 of the third by its square.
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0.89**0.5, 0.11**0.5]])
    squared = np.square(directions @ directions.T)
    single, odds = alike(squared, np.array([1.0, 1.0, 2.0, 4.0]), 0.9)
    np.testing.assert_array_equal(single, [0, 2, 3])
    np.testing.assert_allclose(odds, [0.25, 0.25, 0.5])
    nothing, none = alike(np.zeros((0, 0)), np.zeros(0), 0.9)
    assert nothing.size == none.size == 0


def test_a_log_uniform_prior_is_one():
    prior, rng = LogUniform(0.1, 10.0), np.random.default_rng(0)
    draws = prior.sample(rng, 20_000)
    assert draws.mean() == pytest.approx(prior.mean, rel=0.03)
    assert draws.std() == pytest.approx(prior.sd, rel=0.03)
    grid = np.linspace(0.1, 10, 20_001)
    assert np.trapezoid(np.exp(prior.log_density(grid)), grid) == pytest.approx(1.0, abs=1e-3)


def lines(rng, coefficient, size=600):
    white = rng.standard_normal(size + 200)
    for k in range(1, white.size):
        white[k] = coefficient * white[k - 1] + np.sqrt(1 - coefficient**2) * white[k]
    x = white[200:]
    power = np.abs(np.fft.rfft(x)[1 : size // 2]) ** 2 / size
    angle = 2 * np.pi * np.arange(1, size // 2) / size
    return Lines(power, angle, 0.01, 1.0, float(size))


def test_colour_is_measured_and_white_noise_seldom_coloured():
    rng = np.random.default_rng(0)
    (share, time), p = colour_of([lines(rng, 0.9) for _ in range(3)])
    assert p < 1e-10
    # AR(1) of coefficient 0.9 at steps of 0.01 s decays in 0.095 s.
    assert share > 0.9
    assert time == pytest.approx(0.095, rel=0.25)
    chances = [colour_of([lines(rng, 0.0, 200)])[1] for _ in range(60)]
    # The probability is conservative: at most one of sixty below one in a hundred and twenty.
    assert np.sum(np.array(chances) < 1 / 120) <= 1


@pytest.mark.parametrize(("share", "steps"), [(0.05, 3.0), (0.6, 0.1), (0.99, 0.03)])
def test_the_spectrum_of_coloured_noise_has_unit_variance_and_these_derivatives(share, steps):
    size = 10_000  # lines as close as they are to resolve a process of 33 steps
    cosine = np.cos(np.pi * (np.arange(size) + 0.5) / size)
    density, by_share, by_steps = spectrum_of_process(cosine, share, steps)
    assert density.mean() == pytest.approx(1.0, abs=1e-6)
    for found, change in ((by_share, (1e-5, 0.0)), (by_steps, (0.0, 1e-4 * steps))):
        up, down = (
            spectrum_of_process(cosine, share + sign * change[0], steps + sign * change[1])[0]
            for sign in (1, -1)
        )
        # Differences over a ten-thousandth of the steps err by its square; the rest is round-off.
        difference = (up - down) / (2 * sum(change))
        assert found == pytest.approx(difference, rel=1e-6, abs=1e-6 * np.abs(found).max())


def test_the_choice_says_why():
    def choice(p, odds, undecided=()):
        return error_model_by([0.5, p], lambda _: odds, ["force", "pressure"], undecided)

    word, why = choice(0.5, -3.0)
    assert word == "independent"
    assert "white" in why
    word, why = choice(1e-9, -3.0)
    assert word == "correlated"
    assert "pressure" in why
    assert choice(1e-9, 20.0)[0] == "catalogue"
    word, why = choice(0.5, -3.0, ["coulomb_friction"])
    assert word == "catalogue"
    assert "coulomb_friction" in why


def test_signatures_can_be_left_out():
    given = campaign_of(*CASES["two outputs, one coloured"]).signatures
    left = given.keeping(np.array([True, True, False, True, False]))
    assert left.names == ("effect 0", "effect 1", "effect 3")
    np.testing.assert_array_equal(left.single, [0])
    np.testing.assert_array_equal(left.columns[0], given.columns[0][:, [0, 1, 3]])
    assert replace(given, columns=()).without_columns().columns == ()


def test_evidence_of_more_than_noise_is_that_of_dense_covariances():
    """Unknowns integrated out, the noise's level the most likely one for each size."""
    campaign = campaign_of(("force", "pressure"), (41, 60), 0.5, (WHITE, WHITE), 0)
    model, rng, unknowns = error_model("catalogue", campaign), np.random.default_rng(3), 3
    columns, residual = (
        [[draw(n) for _ in campaign.outputs] for n in campaign.lengths]
        for draw in (lambda n: rng.standard_normal((unknowns, n)), rng.standard_normal)
    )
    precision, pull = np.diag([0.1, 1.0, 10.0]), np.array([0.5, -1.0, 3.0])
    found = model.linearised(columns, residual, precision, pull)
    rows = flat(campaign, columns)
    e = np.concatenate([part for run in residual for part in run])
    heights = []
    for size in (0.0, *REMAINDERS):
        matrix = np.eye(e.size)
        if size:
            matrix = dense(campaign, model, model.coordinates(np.array([[0.0, 0.0, size]]))[0])
        weighted = np.linalg.solve(matrix, np.vstack([rows, e]).T)
        information, right = rows @ weighted[:, :-1] + precision, rows @ weighted[:, -1] + pull
        x = np.linalg.solve(information, right)
        left = (e - x @ rows) @ np.linalg.solve(matrix, e - x @ rows)
        logs = np.linalg.slogdet(matrix)[1] + np.linalg.slogdet(information)[1]
        heights.append(pull @ x - x @ precision @ x / 2 - 0.5 * (e.size * np.log(left) + logs))
    odds = logsumexp(heights[1:]) - np.log(len(heights)) - heights[0]
    assert found.log_odds == pytest.approx(odds, rel=1e-9)
    centre = np.linalg.solve(rows @ rows.T + precision, rows @ e + pull)
    np.testing.assert_allclose(found.shift, centre, atol=0.05)


def test_evidence_of_known_unknowns_is_that_of_dense_covariances():
    """What steps of an estimate under these errors are judged by."""
    campaign = campaign_of(("force", "pressure"), (41, 60), 0.5, (WHITE, WHITE), 0)
    model, rng = error_model("catalogue", campaign), np.random.default_rng(4)
    heights = []
    for scale in (1.0, 3.0):
        residual = [
            [scale * rng.standard_normal(n) for _ in campaign.outputs] for n in campaign.lengths
        ]
        e, logs = np.concatenate([part for run in residual for part in run]), []
        for size in (0.0, *REMAINDERS):
            matrix = np.eye(e.size)
            if size:
                matrix = dense(campaign, model, model.coordinates(np.array([[0.0, 0.0, size]]))[0])
            left = e @ np.linalg.solve(matrix, e)
            logs.append(-0.5 * (e.size * np.log(left) + np.linalg.slogdet(matrix)[1]))
        heights.append((model.log_evidence(residual), logsumexp(logs)))
    (one, expected), (other, also) = heights
    # Up to a constant.
    assert one - other == pytest.approx(expected - also, rel=1e-9)


def test_evidence_falls_with_what_no_effect_explains():
    campaign = campaign_of(*CASES["two outputs, one coloured"])
    model, rng = error_model("catalogue", campaign), np.random.default_rng(5)
    noise = [
        [0.1 * s * rng.standard_normal(n) for s in (1.5, 0.3)] for n in campaign.lengths
    ]  # fmt: skip
    alike = [
        [e + 3 * campaign.signatures.columns[r][b, 0] for b, e in enumerate(row)]
        for r, row in enumerate(noise)
    ]
    size = [np.std(np.concatenate([row[b] for row in alike])) for b in range(2)]
    any_other = [
        [s * rng.standard_normal(e.size) for s, e in zip(size, row, strict=True)] for row in noise
    ]
    heights = [model.log_evidence(each) for each in (noise, alike, any_other)]
    assert heights[0] > heights[1] > heights[2]
