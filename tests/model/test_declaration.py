"""A model says what is wrong with it, and changes without changing the original."""

from __future__ import annotations

import pytest
import sympy as sp

from bayesoleo._session.function_work import parameters_of
from bayesoleo.errors import ModelError
from bayesoleo.model import Condition, LogNormal, Model, Normal, Output, Parameter
from bayesoleo.model._expressions import derivative_symbol, symbol


def declare(**changes):
    """A spring and a mass, with changes."""
    parts = {
        "inputs": {"force": "N"},
        "dofs": {"q": "m"},
        "parameters": {"k": Parameter(2.0, "N/m", sd=1.0), "m": Parameter(1.0, "kg", fixed=True)},
        "conditions": {"preload": Condition("N", 0.5)},
        "definitions": {"spring": "k*q + preload"},
        "equations": {"q": {"inertia": "m*ddot(q)", "spring": "spring", "drive": "-force"}},
        "outputs": {"displacement": Output("q", "m")},
    }
    return Model("test", **(parts | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outputs": {}}, "no outputs"),
        ({"outputs": {"force": "q"}}, "'force' is both input and output"),
        ({"conditions": {"k": "N"}}, "'k' is both parameter and condition"),
        ({"inputs": {"the force": "N"}}, "input 'the force' is not usable.*underscores"),
        ({"inputs": {"lambda": "N"}}, "input 'lambda' is not usable.*reserved"),
        ({"parameters": {"k": 2.0}}, "parameter 'k' is not a Parameter.*2.0"),
        ({"equations": {}}, "dofs and equations do not match at q"),
        ({"equations": {"q": "q", "p": "1"}}, "dofs and equations do not match at p"),
        ({"definitions": {"spring": "later", "later": "q"}}, "definition 'spring'.*later"),
        ({"equations": {"q": {"a": "kk*q"}}}, "equation 'q', term 'a': unknown name kk"),
        ({"admissible": ["1 - p"]}, "admissible region: unknown name p"),
    ],
)
def test_what_is_wrong_is_named(changes, message):
    with pytest.raises(ModelError, match=message):
        declare(**changes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"value": float("nan")}, "finite value"),
        ({"value": 1.0, "sd": 1.0, "relative_sd": 0.1}, "prior stated twice"),
        ({"value": 0.0, "relative_sd": 0.1}, "key relative_sd: is relative to a value of zero"),
        ({"value": 3.0, "bounds": (0.0, 2.0)}, "bounds exclude the start.*between 0 and 2"),
        ({"value": 1.0, "sd": -1.0}, "key sd: must be positive"),
        ({"value": 1.0, "bounds": (2.0, 0.0)}, "low < high"),
    ],
)
def test_bad_parameters_are_refused(arguments, message):
    with pytest.raises(ModelError, match=message):
        Parameter(**arguments)


@pytest.mark.parametrize(
    "use",
    [
        lambda start: declare(parameters={**declare().parameters, "k": start}),
        lambda start: declare().with_parameters(slope=start),
        lambda start: parameters_of({"slope": start}),
    ],
)
def test_a_start_without_a_logarithm_is_refused_by_name(use):
    start = Parameter(0.0, prior=LogNormal(3400.0, 0.7))
    words = r"parameter '\w+' starts where its prior has no density \(got 0.0\); start above 0"
    with pytest.raises(ModelError, match=words + r", say at the prior's mean: Parameter\(4343"):
        use(start)


def test_a_start_on_a_limit_that_its_prior_includes_is_kept():
    assert (
        declare().with_parameters(c=Parameter(0.0, bounds=(0.0, 2.0))).parameters["c"].value == 0.0
    )


def test_priors_follow_from_what_is_stated():
    assert Parameter(2.0, relative_sd=0.1).prior == Normal(2.0, 0.2)
    assert Parameter(2.0, prior=LogNormal(2.0, 0.5)).prior == LogNormal(2.0, 0.5)
    assert Parameter(2.0, fixed=True).prior is None


def test_changes_leave_the_original_alone():
    model = declare()
    extended = model.with_parameters(c=Parameter(0.0, sd=1.0)).with_term(
        "equation", "q", "damping", "c*dot(q)"
    )
    assert "damping" not in model.equations["q"]
    assert extended.equation("q").has(derivative_symbol("q", 1))
    assert model.digest() != extended.digest()
    assert declare().digest() == model.digest()


def test_redefinition_reaches_every_term():
    """Also those beside a time derivative."""
    model = declare(
        equations={"q": {"inertia": "m*ddot(q)", "mixed": "spring*dot(q)", "drive": "-force"}}
    )
    changed = model.with_definition("spring", "k*q**3")
    expected = symbol("k") * symbol("q") ** 3 * derivative_symbol("q", 1)
    assert changed.expand(changed.equations["q"]["mixed"]) == expected


def test_rate_of_a_definition_inside_a_definition():
    model = declare(definitions={"spring": "k*q", "power": "dot(spring)*q"})
    expected = symbol("k") * symbol("q") * derivative_symbol("q", 1)
    assert model.definitions["power"] == expected


def test_coordinates_know_where_forces_act():
    (place,) = declare().coordinates()
    assert (place.name, place.kind, place.target, place.sign) == ("q", "equation", "q", 1)
    law = Model("law", {"force": Output("3*dot(x)", "N")}, inputs={"x": "m"})
    (place,) = law.coordinates()
    assert (place.kind, place.target, place.velocity) == ("output", "force", symbol("dot(x)"))


def test_signs_of_coordinates_follow_the_values_of_parameters():
    """Also where they were asked for before the value changed."""
    model = declare()
    assert model.coordinates()[0].sign == 1
    other = model.with_parameters(m=Parameter(-1.0, "kg", fixed=True))
    assert other.coordinates()[0].sign == -1
    assert other.with_parameters(new=Parameter(1.0, "kg")).coordinates()[0].sign == -1


def test_one_expression_becomes_numbered_terms():
    model = declare(equations={"q": "m*ddot(q) + k*q - force"})
    assert sorted(model.equations["q"]) == ["term 1", "term 2", "term 3"]
    assert sp.expand(model.equation("q") - sp.Add(*model.equations["q"].values())) == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"value": "1200"},
            r'key value: is not a number \(got \'1200\'\); .*Parameter\(1200.0, "N/m"',
        ),
        ({"value": None}, "key value: is not a number"),
        ({"value": 1.0, "sd": "3"}, r"key sd: is not a number \(got '3'\)"),
        ({"value": 1.0, "unit": 3}, r"key unit: is not the text of a unit \(got 3\)"),
        ({"value": 1.0, "bounds": 3}, r"key bounds: is not a pair \(got 3\); .*bounds=\(0\.0"),
        ({"value": 1.0, "bounds": (0, "1")}, r"key bounds: is not a number \(got '1'\)"),
        (
            {"value": 1.0, "prior": 3},
            r"key prior: is not a prior \(got 3\); write bo\.model\.Normal",
        ),
    ],
)
def test_what_is_no_parameter(wrong, message):
    with pytest.raises(ModelError, match=message):
        Parameter(**wrong)
