"""A gas spring is known by the names that its model declares, and told of those that it lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from bayesoleo._workflow.model_files import load_model
from bayesoleo.effects import catalogue, find_effect
from bayesoleo.effects._gas import as_gas_spring, undeclared
from bayesoleo.model import Condition, Model, Output, Parameter
from bayesoleo.model._expressions import symbol
from bayesoleo.systems import system

FILE = """
from bayesoleo.model import Condition, Model, Output, Parameter
model = Model(
    "can",
    inputs={"stroke": "m"},
    conditions={"initial_pressure": Condition("Pa")},
    parameters={"full": Parameter(0.3, "m", sd=0.1)},
    definitions={
        "volume_ratio": "1 - stroke/full",
        "gas_pressure": "initial_pressure*volume_ratio**(-1.2)",
    },
    outputs={"pressure": Output("gas_pressure", "Pa")},
)
"""


def polytrope(renamed: str = "") -> Model:
    """With the five names of the documentation, one of which may be another."""

    def known(text: str) -> str:
        return text.replace(renamed, "unheard_of") if renamed else text

    return Model(
        "gas spring",
        inputs={"stroke": "m"},
        conditions={known("initial_pressure"): Condition("Pa")},
        parameters={
            "area": Parameter(3.5e-3, "m**2", fixed=True),
            known("initial_volume"): Parameter(9.2e-4, "m**3", relative_sd=0.1),
            "exponent": Parameter(1.1, relative_sd=0.1),
            known("ambient_temperature"): Parameter(293.0, "K", fixed=True),
        },
        definitions={
            known("volume_ratio"): known("1 - area*stroke/initial_volume"),
            known("gas_pressure"): known("initial_pressure*volume_ratio**(-exponent)"),
        },
        outputs={"pressure": Output(known("gas_pressure"), "Pa")},
    )


def test_names_that_are_made_leave_the_law_alone():
    model = polytrope()
    whole = as_gas_spring(model)
    assert {"free_volume_ratio", "temperature_ratio"} <= set(whole.definitions)
    assert sp.simplify(whole.output("pressure") - model.output("pressure")) == 0
    oleo = system("f16n2d2")
    assert as_gas_spring(oleo).definitions == oleo.definitions


def test_a_polytrope_of_five_names_has_every_effect_of_a_gas_at_its_null(scales):
    model = polytrope()
    numbers = {"initial_pressure": 5e5, "stroke": 0.2, "area": 3.5e-3, "initial_volume": 9.2e-4}
    numbers |= {"exponent": 1.1, "ambient_temperature": 293.0, "temperature": 293.0}
    law = 5e5 * (1 - 3.5e-3 * 0.2 / 9.2e-4) ** -1.1
    assert undeclared(model) == {}
    for name in (
        *("gas_solubility", "oil_compressibility", "cylinder_expansion", "extra_volume"),
        *("initial_pressure_error", "initial_pressure_by_run", "gas_exponent_error"),
        "heat_exchange",
    ):
        effect = find_effect(name)
        (target,) = effect.places(model)
        candidate = effect.extend(model, target, scales)
        absent = dict.fromkeys([*candidate.parameters, *candidate.model.dofs], 0.0)
        values = {symbol(item): value for item, value in {**absent, **numbers}.items()}
        shown = float(candidate.model.output("pressure").xreplace(values))
        assert shown == pytest.approx(law, rel=1e-12), name


def test_the_law_with_dissolved_gas_is_the_law_of_the_oleo(scales):
    """Verbeek (1993), eq. 6.4, by hand: p = p0 ((v + s)/(1 + s))^-n at ambient temperature."""
    model = polytrope()
    found = find_effect("gas_solubility").extend(model, "free_volume_ratio", scales).model
    values = {"initial_pressure": 5e5, "stroke": 0.2, "area": 3.5e-3, "initial_volume": 9.2e-4}
    values |= {"exponent": 1.1, "gas_solubility": 0.04}
    ratio = 1 - 3.5e-3 * 0.2 / 9.2e-4
    pressure = float(found.output("pressure").xreplace({symbol(k): v for k, v in values.items()}))
    assert pressure == pytest.approx(5e5 * ((ratio + 0.04) / 1.04) ** -1.1, rel=1e-12)


def test_conductions_are_tried_about_the_capacity_that_the_runs_state(scales):
    """A condition without a default has no nominal value: C = p0 V0 cv / (R T0)."""
    grids = [
        find_effect("heat_exchange")
        .extend(polytrope(), "temperature_ratio", replace(scales, conditions=stated))
        .shapes["heat_exchange_conduction"]
        for stated in ({"initial_pressure": 2e5}, {"initial_pressure": 8e5})
    ]
    assert np.allclose(grids[1], 4 * np.asarray(grids[0]), rtol=1e-12)


def test_a_model_file_is_told_what_its_names_keep_from_being_tried(tmp_path):
    path = tmp_path / "can.py"
    path.write_text(FILE)
    with pytest.warns(UserWarning, match=r"oil_compressibility.*heat_exchange.*no initial_volume"):
        model = load_model(f"{path}:model")
    assert undeclared(model)["heat_exchange"] == ("initial_volume", "ambient_temperature")
    assert "gas_exponent_error" not in undeclared(model)
    assert undeclared(system("duffing")) == undeclared(system("f16n1d2")) == {}


@pytest.mark.parametrize(
    "name",
    ["volume_ratio", "gas_pressure", "initial_pressure", "initial_volume", "ambient_temperature"],
)
def test_what_is_said_to_be_kept_from_trial_is_what_has_no_place(name):
    """Each name under another: the table of names must not promise what the effects do not do."""
    whole = polytrope()
    told = undeclared(polytrope(name))
    lost = [
        item.id
        for item in catalogue()
        if item.family in ("gas", "thermal")
        and item.places(whole)
        and not item.places(polytrope(name))
    ]
    assert told.keys() <= set(lost)
    assert all(missing == (name,) for missing in told.values())
    assert told
