"""An effect that the catalogue lacks is found as a curve, with its shape; plain data get none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted, scored
from scipy.interpolate import BSpline
from small_campaigns import damper, damper_campaign, oscillator_campaign, spring_damper_force

from bayesoleo import _schema as schema
from bayesoleo._workflow.model_files import from_document, to_document
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._curves import shapes
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._nonparametric_round import _goes_on
from bayesoleo.discovery._nonparametric_search import search
from bayesoleo.discovery._result_tree import loop_groups
from bayesoleo.discovery._summary import summarise
from bayesoleo.effects import find_effect
from bayesoleo.effects._nonparametric import Axis, Spline, bspline_values
from bayesoleo.effects._parts import Scales
from bayesoleo.model._expressions import bspline, derivative_symbol, symbol
from bayesoleo.systems import equations_latex, system

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quadratic_damping", "quintic_stiffness")))
ABOUT = {"campaign": "small", "model": "small", "drive": "displacement", "seed": 0}


def inner_wall(x, v, _):
    """Two ripples of the force at places inside the stroke, of a shape that nobody named."""
    return spring_damper_force(x, v, _) + ripple(x)


def ripple(x):
    return 8.0 * np.exp(-(((x - 0.004) / 0.0015) ** 2)) - 5.0 * np.exp(
        -(((x + 0.003) / 0.002) ** 2)
    )


@pytest.fixture(scope="module")
def strange(tmp_path_factory):
    reduced = damper_campaign(tmp_path_factory.mktemp("strange"), inner_wall)
    return close_loop(Assembly(damper()), assign(reduced.records), NUMERICS, effects=EFFECTS)


def test_cardinal_splines_are_those_of_de_boor():
    t = np.linspace(-3, 3, 61)
    exact = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)(t)
    np.testing.assert_allclose(bspline_values(t), np.nan_to_num(exact), atol=1e-15)


def test_splines_of_an_axis_are_shifted_copies_of_one():
    """Inside, at and beyond the ends; of a value that is not a number they are none either."""
    axis, pieces = Axis("x", symbol("x"), "m", -1.0, 2.0), 7
    values = np.array([-1.9, -1.0, -0.3, 0.5, 1.999, 2.0, 3.4, np.nan])
    place = pieces * (values + 1.0) / 3.0
    expected = bspline_values(place - np.arange(-1, pieces + 2)[:, None])
    np.testing.assert_allclose(axis.basis(values, pieces), expected, atol=1e-14)


@pytest.mark.slow
def test_what_the_catalogue_lacks_ends_as_a_curve_without_a_name(strange):
    assert strange.effects == ("nonparametric_displacement",)
    assert strange.verdict == schema.EFFECT_ADDED
    assert strange.final.hold_errors.worst_ratio() < 1.15 < strange.first.hold_errors.worst_ratio()
    accepted = strange.rounds[-2].accepted
    assert accepted.p_value < 1e-6
    assert accepted.closest
    assert max(cosine**2 for _, cosine in accepted.closest) < 0.95
    assert any("is no named effect" in note for note in strange.notes)


def test_its_shape_is_the_true_one_within_its_band(strange):
    """Beside what the model's own terms do: the difference is a sum of these, within the band."""
    (shape,) = shapes(strange.final)
    x = shape.places[0]
    inside = np.abs(x) < 0.0115
    own = np.stack([x, x**3, np.ones_like(x)])[:, inside]
    weight = 1 / shape.sd[inside]
    difference = (shape.value - ripple(x))[inside]
    fitted_, *_ = np.linalg.lstsq((own * weight).T, difference * weight, rcond=None)
    z = (difference - fitted_ @ own) * weight
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.abs(shape.value[inside]).max() > 20 * np.median(shape.sd[inside])


def test_the_curve_is_kept_and_told(strange):
    groups = loop_groups(strange)
    found = groups[schema.NONPARAMETRIC]
    assert found.attrs["effect"] == "nonparametric_displacement"
    assert found["value"].attrs[schema.UNITS] == "N"
    summary = summarise(strange, None, ABOUT)
    first = next(e for e in summary["rounds"] if e["accepted"] == "nonparametric_displacement")
    first = first["candidates"][0]
    assert first["family"] == "nonparametric"
    assert first["closest"][0]["effect"]


def test_the_formula_of_a_curve_can_be_read_and_the_model_kept(strange):
    model = strange.final.fit.model
    assert max(map(len, equations_latex(model))) < 300
    assert any("B_k" in text for text in equations_latex(model))
    again = from_document(to_document(model))
    at = {**model.nominal(), symbol("displacement"): 0.004, symbol("dot(displacement)"): 0.01}
    values = [float(item.output("force").xreplace(at).evalf(20)) for item in (model, again)]
    assert values[0] == pytest.approx(values[1], rel=1e-12)


def test_plain_data_get_no_curve(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force)
    loop = close_loop(Assembly(damper()), assign(reduced.records), NUMERICS, effects=EFFECTS)
    assert loop.effects == ()


@pytest.mark.statistical
def test_noise_alone_seldom_asks_for_a_curve(tmp_path):
    """The corrected p-value of the best of all functions is above one in a hundred, mostly."""
    values = []
    for seed in range(12):
        state = fitted(
            damper_campaign(tmp_path / str(seed), spring_damper_force, seed=seed), damper()
        )
        values.append(search(state.base(), state.assembly, 1).p_value)
    # Of twelve with the probability 0.01 or less, two have it once in 150 times.
    assert sum(value < 0.01 for value in values) <= 1
    assert np.median(values) > 0.1


def test_a_named_effect_keeps_its_name(tmp_path):
    loop = close_loop(
        Assembly(damper()), assign(damper_campaign(tmp_path).records), NUMERICS, effects=EFFECTS
    )
    assert loop.effects == ("coulomb_friction",)


def softened(x, v, t):
    """A spring that meets a second one gradually: no effect of the catalogue's."""
    return 2.0e4 * x + 200.0 * v + 20.0 * np.logaddexp(0.0, (x - 0.004) / 0.0012)


SEVERAL = ("end_stop_upper", "quadratic_stiffness", "cubic_stiffness", "coulomb_friction")


@pytest.mark.parametrize(
    ("law", "names"),
    [
        (softened, ("nonparametric_displacement",)),
        pytest.param(
            lambda x, v, t: 2.0e4 * x + 200.0 * v + 1.5e7 * x**3 + 10.0 * np.sign(v),
            ("coulomb_friction", "cubic_stiffness"),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["one law", "two laws"],
)
def test_several_names_in_one_balance_give_way_to_one_curve_that_is_the_law(tmp_path, law, names):
    """Three names explain a law that the catalogue lacks down to the noise; two true ones stay."""
    # With more noise the second name is hardly more than noise, and two names are enough.
    reduced = damper_campaign(tmp_path, law, per_period=60.3, noise=6.0 if len(names) == 1 else 2.0)
    loop = close_loop(
        Assembly(damper(cubic=False)),
        assign(reduced.records),
        NUMERICS,
        effects=[find_effect(name) for name in SEVERAL],
    )
    assert loop.effects == names
    assert loop.final.at_floor
    assert not loop.certain
    if len(names) == 1:
        *_, last, _ = loop.rounds
        assert last.before.at_floor, "the names had come down to the noise"
        assert "replaces end_stop_upper" in last.reason
        # What does nearly the same was estimated, and leaves more than the curve.
        assert last.accepted.same == ()


@pytest.mark.parametrize(
    ("coarse", "fine", "p_value", "goes_on"),
    [
        (-np.inf, -5.0, 0.0, True),
        (-100.0, -60.0, 0.0, True),
        (-100.0, -80.0, 0.0, False),
        (-5.0, 6.0, 1e-4, True),
        (6.0, 5.0, 1e-4, True),
        (5.0, 6.0, 0.1, False),
        (-5.0, -np.inf, 1.0, False),
    ],
)
def test_pieces_are_cut_finer_while_that_may_pay(coarse, fine, p_value, goes_on):
    """Significance says how fine a curve is; one that stays far behind the names is given up."""
    assert _goes_on(coarse, fine, p_value, NUMERICS.policy) is goes_on


def test_the_score_of_a_curve_that_is_a_named_effect_is_no_less(tmp_path):
    """Quintic stiffness is a smooth function of position: splines explain what it explains."""

    def law(x, v, t):
        return spring_damper_force(x, v, t) + 3e9 * x**5

    state = fitted(damper_campaign(tmp_path, law), damper(cubic=False))
    named = scored(state, "cubic_stiffness")["cubic_stiffness"]
    best = search(state.base(), state.assembly, 1).tried[0]
    assert best.axes[0].name == "displacement"
    assert best.fall > 0.999 * named.fall


@pytest.mark.slow
def test_a_curve_in_an_equation_of_motion(tmp_path):
    """Driven by force: the response of the motion, not the force, is what is compared."""

    def restoring(x, v):
        return (
            100.0 * x
            + 0.8 * v
            + 0.4 * np.tanh(40 * (x - 0.01)) * np.exp(-(((x - 0.01) / 0.02) ** 2))
        )

    reduced = oscillator_campaign(tmp_path, restoring=restoring)
    # Only compiled kernels follow the motion to where it settles, as one of the runs needs.
    state = fitted(reduced, system("duffing"), numerics=replace(NUMERICS, backend="numba"))
    found = search(state.base(), state.assembly, 1)
    assert found.p_value < 0.01
    assert found.tried[0].target == "position"


def test_fewer_splines_are_sums_of_more():
    axis = Axis("x", symbol("x"), "m", -1.0, 2.0)
    x = np.linspace(-1, 2, 50)
    coarse, fine = axis.basis(x, 4), axis.basis(x, 8)
    fitted_ = np.linalg.lstsq(fine.T, coarse.T, rcond=None)[0]
    np.testing.assert_allclose(fine.T @ fitted_, coarse.T, atol=1e-12)
    np.testing.assert_allclose(coarse.sum(axis=0), 1.0, atol=1e-14)


def test_expression_and_values_agree():
    axis = Axis("velocity of x", symbol("v"), "m/s", -1.0, 2.0)
    spline = Spline("x", (axis,), (4,), np.eye(7))
    assert spline.id == "nonparametric_velocity_of_x"
    x = 0.37
    values = [float(item.xreplace({symbol("v"): x}).evalf(20)) for item in axis.splines(4)]
    np.testing.assert_allclose(values, axis.basis(np.array([x]), 4)[:, 0], atol=1e-15)


def of_two_quantities(pieces, weights, direction=None):
    """Of a damper's velocity and place: the spline, its definition and its coefficients."""
    axes = (
        Axis("velocity", derivative_symbol("displacement", 1), "m/s", -1.0, 2.0),
        Axis("displacement", symbol("displacement"), "m", -0.02, 0.01),
    )
    spline = Spline("force", axes, pieces, weights, direction)
    scales = Scales({"displacement": (-0.02, 0.01)}, {"displacement": 2.0}, {}, 1.0, 1.0)
    found = spline.effect().extend(damper(), "force", scales)
    return spline, found.model.definitions[spline.id], found.parameters


@pytest.mark.parametrize("direction", [None, symbol("displacement") + 2])
def test_definition_of_two_quantities_is_what_its_values_say(direction):
    """Any weights, none of some splines: an order of rows or axes that is mistaken shows."""
    rng = np.random.default_rng(5)
    weights = rng.normal(size=(5 * 4, 3)) * rng.integers(0, 2, size=(20, 3))
    spline, body, names = of_two_quantities((2, 1), weights, direction)
    v, x, a = -0.4, -0.006, rng.normal(size=3)
    values = dict(zip(map(symbol, names), a, strict=True))
    values |= {axis.expression: at for axis, at in zip(spline.axes, (v, x), strict=True)}
    factor = 1.0 if direction is None else x + 2
    expected = factor * a @ spline.basis(np.array([v]), np.array([x]))[:, 0]
    # Weights have ten digits in an expression.
    assert float(body.xreplace(values).evalf(20)) == pytest.approx(expected, rel=1e-8)


def test_splines_of_one_quantity_multiply_sums_over_the_other():
    """Compiled code does not group terms, and would have a product for each pair of splines."""
    weights = np.random.default_rng(6).normal(size=(6 * 5, 4))
    _, body, _ = of_two_quantities((3, 2), weights)
    assert len(body.args) == 6
    assert all(sum(isinstance(f, bspline) for f in term.args) == 1 for term in body.args)
    assert all(len(term.atoms(bspline)) == 6 for term in body.args)
