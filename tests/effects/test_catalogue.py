"""What the catalogue lists, finds and refuses."""

from __future__ import annotations

import json
import pickle

import cloudpickle
import pytest
from matplotlib.mathtext import MathTextParser

from bayesoleo.effects import (
    FAMILIES,
    Amplitude,
    Effect,
    InternalState,
    ShapeParameter,
    candidates,
    catalogue,
    describe,
    find_effect,
    force_effect,
)
from bayesoleo.effects._forces import SMOOTHING, AddedTerm
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.systems import system


def test_ids_are_unique():
    ids = [effect.id for effect in catalogue()]
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize("effect", catalogue(), ids=lambda effect: effect.id)
def test_every_effect_is_described_and_its_formulas_render(effect):
    listed = json.loads(json.dumps(describe(effect)))
    assert listed["family"] in FAMILIES
    assert all(listed[key] for key in ("title", "formula", "applies_to", "parameters", "source"))
    for parameter in listed["parameters"].values():
        if parameter["kind"].startswith("amplitude"):
            assert parameter["null"] == 0.0
        if parameter["kind"] == "shape":
            assert parameter["scan"], "what is scanned is said"
    parser = MathTextParser("path")
    parser.parse(f"${effect.formula}$")
    for parameter in listed["parameters"].values():
        parser.parse(f"${parameter['latex'] or 'c'}$")


def controlled_damper() -> Model:
    """A damper whose friction a current may change."""
    return Model(
        "controlled damper",
        inputs={"displacement": "m", "current": "A"},
        parameters={
            "damping": Parameter(1.0, "N*s/(m*A)", sd=1.0),
            "friction": Parameter(1.0, "N", sd=1.0),
        },
        outputs={
            "force": Output(
                {
                    "damping": "damping*current*dot(displacement)",
                    "friction": "friction*tanh(100*dot(displacement))",
                },
                "N",
            )
        },
    )


def two_tanks() -> Model:
    """Two stores, the one above the other."""
    return Model(
        "two tanks",
        inputs={"pump": "V"},
        dofs={"x": "V", "y": "V"},
        parameters={"a": Parameter(1.0, "1/s", sd=1.0), "b": Parameter(1.0, "1/s", sd=1.0)},
        equations={"x": "dot(x) + a*x - b*pump", "y": "dot(y) + b*y - a*x"},
        outputs={"level": Output("y", "V")},
    )


def test_every_effect_applies_to_some_system(offered):
    names = ("f16n1d2", "f16n2d2", "viscous_damper", "duffing")
    used = {c.effect for name in names for c in offered(system(name))}
    used |= {c.effect for model in (controlled_damper(), two_tanks()) for c in offered(model)}
    assert used == {effect.id for effect in catalogue()}


def test_unknown_effect_names_the_closest():
    with pytest.raises(InputError, match="did you mean cubic_stiffness"):
        find_effect("cubic_stifness")


def test_effect_where_it_does_not_apply(scales):
    with pytest.raises(ModelError, match="heat_exchange does not apply to 'position'"):
        find_effect("heat_exchange").extend(system("duffing"), "position", scales)


def test_own_effect_in_a_few_lines(scales):
    drag = force_effect(
        "drag", "damping", "k*velocity**3", {"k": "force/(position/s)**3"}, formula="k v^3"
    )
    (candidate,) = candidates(system("duffing"), scales, [drag])
    assert candidate.parameters == ("drag_k",)
    assert candidate.model.parameters["drag_k"].unit == "N/(m/s)**3"
    assert "drag" in candidate.model.equations["position"]


def test_excluded_effects_are_left_out(scales):
    model = system("duffing")
    everything = candidates(model, scales)
    fewer = candidates(model, scales, exclude=("coulomb_friction", "sensor_gain at force"))
    gone = {(c.effect, c.target) for c in everything} - {(c.effect, c.target) for c in fewer}
    assert gone == {("coulomb_friction", "position"), ("sensor_gain", "force")}


@pytest.mark.parametrize("name", ["f16n1d2", "viscous_damper"])
def test_an_effect_that_is_in_is_no_candidate_again(name, scales):
    """Whatever is accepted, its place is not offered a second time."""
    model = system(name)
    for candidate in candidates(model, scales):
        again = candidates(candidate.model, scales, [find_effect(candidate.effect)])
        assert candidate.target not in {c.target for c in again}, candidate.effect


def test_effects_add_up(scales):
    """Heat exchange, then solubility, then the wall: each is offered once the other is in."""
    model = system("f16n1d2")
    for id_ in ("heat_exchange", "gas_solubility", "wall_heat_capacity", "dahl_friction"):
        (candidate,) = candidates(model, scales, [find_effect(id_)])
        model = candidate.model
    assert set(model.dofs) == {"stroke", "temperature", "wall_excess", "dahl_friction_memory"}


def test_names_do_not_collide(scales):
    taken = system("duffing").with_parameters(
        coulomb_friction=system("duffing").parameters["damping"]
    )
    candidate = find_effect("coulomb_friction").extend(taken, "position", scales)
    assert candidate.parameters == ("coulomb_friction_2",)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("drag", "damping", "k*velocty", {"k": ""}), "unknown name.*velocty.*mean velocity"),
        (("drag", "dampng", "k*velocity", {"k": ""}), "unknown family.*dampng"),
        (("a drag", "damping", "k*velocity", {"k": ""}), "not an identifier.*a drag"),
        (("drag", "damping", "k*", {"k": ""}), r"not an expression.*k\*"),
        (("drag", "damping", "velocity", {}), "no parameters"),
        (("drag", "damping", "k*velocity", {"k": "", "d": ""}), "'d' is not used"),
        (("drag", "damping", "position*velocity", {"position": ""}), "name is reserved"),
        (("drag", "damping", "velocity**2 + k*velocity", {"k": ""}), "not zero where its ampl"),
        (("drag", "damping", "velocity/k", {"k": ""}), "not zero where its amplitudes are"),
        (
            ("drag", "damping", "k*velocity**2", {"k": "force/position"}),
            r"unit of a force, but of .*; state k in force\*position\*\*-2\*s\*\*2",
        ),
    ],
)
def test_bad_effects_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        force_effect(*arguments)


def test_built_in_forces_pass_the_checks_of_one_s_own():
    """They are made without them, so that libraries load sooner."""
    terms = [effect for effect in catalogue() if isinstance(effect.change, AddedTerm)]
    assert len(terms) > 20
    for effect in terms:
        scanned = tuple(shape for shape in effect.shapes if shape is not SMOOTHING)
        effect.change.check(effect.amplitudes, scanned)
        assert effect.change.effect == effect.id


def test_effects_survive_a_pickle_as_equals():
    effects = [find_effect("coulomb_friction"), find_effect("dahl_friction")]
    assert pickle.loads(cloudpickle.dumps(effects[0])).change == effects[0].change
    assert len({*effects, *effects}) == 2


def test_a_state_without_its_rate_is_refused():
    with pytest.raises(InputError, match=r"state 'w' has no rate.*dot\(w\)"):
        force_effect(
            "drag", "friction", "k*w", {"k": "force"}, states={"w": InternalState("velocity - w")}
        )


def test_a_scan_that_is_not_positive_is_refused(scales):
    shape = ShapeParameter(
        "w", "position/s", "w", "width", lambda model, target, scales: (0.0, 1.0)
    )
    effect = force_effect("drag", "damping", "k*exp(-velocity/w)", {"k": "force"}, shapes=(shape,))
    with pytest.raises(InputError, match="scan of 'w' is not ascending and positive"):
        effect.extend(system("duffing"), "position", scales)


@pytest.mark.parametrize(
    ("expression", "unit"),
    [
        ("k*velocity", "N*s/m"),
        ("k*tanh(velocity/0.01)", "force"),
        ("k*velocity*abs(velocity)/largest_velocity**2", "force"),
        ("k*sign(velocity)*abs(velocity)**1.5", "force/(position/s)**1.5"),
    ],
)
def test_units_that_are_right_or_cannot_be_judged_pass(expression, unit):
    assert force_effect("drag", "damping", expression, {"k": unit}).amplitudes[0].unit == unit


def test_effect_of_ones_own_that_changes_a_definition(scales):
    """The general form: any function from model to model."""

    def warm(model, target, names):
        return model.with_definition(target, model.definitions[target] * (1 + names["share"]))

    effect = Effect(
        id="warm_gas",
        family="gas",
        title="Warm gas",
        formula="p (1 + s)",
        amplitudes=(Amplitude("share", "", "s", "share"),),
        places=lambda model: ("gas_pressure",) if "gas_pressure" in model.definitions else (),
        change=warm,
    )
    (candidate,) = candidates(system("f16n1d2"), scales, [effect])
    assert candidate.model.output("pressure").has(*candidate.model.output("pressure").free_symbols)
    assert candidates(system("duffing"), scales, [effect]) == []
