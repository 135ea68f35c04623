"""Units of a model are known and of SI, because nothing is converted; names are free in results."""

from __future__ import annotations

import subprocess
import sys

import cloudpickle
import pytest

from bayesoleo._units import in_si
from bayesoleo.errors import ModelError
from bayesoleo.model import Condition, Dof, Model, Output, Parameter


def law(unit: str = "N/m", **changes) -> Model:
    parts = {
        "inputs": {"x": "m"},
        "parameters": {"k": Parameter(5.0, unit, sd=1.0)},
        "outputs": {"force": Output("k*x", "N")},
    }
    return Model("law", **{**parts, **changes})


@pytest.mark.parametrize(
    ("unit", "message"),
    [
        (
            "N/mm",
            r"parameter 'k' is in N/mm.*in SI.*write 5000 in N/m, and its sd and bounds times 1000",
        ),
        ("bananas", r"parameter 'k' has a unit that is not known \(got 'bananas'\); write one"),
        ("Nm", r"not known \(got 'Nm'\); did you mean N\*m"),
        ("bar", r"write 500000 in Pa, and its sd and bounds times 100000"),
        ("degC", r"write 278.15 in K; differences keep their size"),
        ("rpm", r"write 0.5235987756 in rad/s"),
    ],
)
def test_a_unit_that_would_be_misread_is_refused_with_what_to_write(unit, message):
    with pytest.raises(ModelError, match=message):
        law(unit)
    with pytest.raises(ModelError, match=message):
        law().with_parameters(k=Parameter(5.0, unit, sd=1.0))


@pytest.mark.parametrize("unit", ["", "1", "N/m", "N*s/m", "kg*m**2", "W/K", "N/m**1.5", "rad/s"])
def test_units_of_si_are_taken(unit):
    assert law(unit).parameters["k"].unit == unit


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": {"x": "mm"}}, "input 'x' is in mm.*declare it in m"),
        ({"outputs": {"force": Output("k*x", "kN")}}, "output 'force' is in kN.*declare it in N"),
        ({"conditions": {"p": Condition("bar", 2.0)}}, "condition 'p' is in bar.*write 200000 in"),
        (
            {"dofs": {"q": Dof("mm")}, "equations": {"q": "ddot(q) + k*q"}},
            "dof 'q' is in mm.*declare it in m",
        ),
    ],
)
def test_so_are_those_of_all_that_is_declared(changes, message):
    with pytest.raises(ModelError, match=message):
        law(**changes)


@pytest.mark.parametrize(
    ("unit", "written"),
    [("kN*s/mm", "N*s/m"), ("mm**2", "m**2"), ("g/cm**3", "kg/m**3"), ("W/degC", "W/K")],
)
def test_the_si_unit_keeps_the_way_it_was_written(unit, written):
    assert in_si(unit) == written


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"parameters": {"correlation_k": Parameter(1.0)}}, "parameter 'correlation_k'"),
        ({"parameters": {"log_variance_x": Parameter(1.0)}}, "parameter 'log_variance_x'"),
        ({"parameters": {"chain": Parameter(1.0)}}, "parameter 'chain'"),
        ({"inputs": {"phase": "m"}}, "input 'phase'"),
        ({"outputs": {"run": Output("1.0")}}, "output 'run'"),
        ({"conditions": {"role": ""}}, "condition 'role'"),
        ({"conditions": {"frequency": "Hz"}}, "condition 'frequency'"),
    ],
)
def test_a_name_that_results_use_is_refused_at_once(changes, name):
    plain = {"outputs": {"force": Output("1.0")}}
    with pytest.raises(ModelError, match=f"{name} has a name that results use.*rename it, for exa"):
        Model("law", **{**plain, **changes})


def test_a_model_that_is_sent_on_is_not_checked_again(tmp_path):
    """A process that is sent models would take a second to learn what units there are."""
    (tmp_path / "model").write_bytes(cloudpickle.dumps(law()))
    text = (
        "import pickle, sys; model = pickle.load(open('model', 'rb'));"
        " model.fixing('k'); model.with_parameters(k=model.parameters['k']);"
        " print('pint' in sys.modules)"
    )
    line = [sys.executable, "-c", text]
    said = subprocess.run(line, cwd=tmp_path, capture_output=True, check=True, text=True)
    assert said.stdout == "False\n"
