"""A model in the making: effects come and go, and what is known of the parameters stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import damper

from bayesoleo.discovery._assembly import Assembly
from bayesoleo.effects import Amplitude, Effect, Scales, find_effect
from bayesoleo.effects._nonparametric import Axis, Spline
from bayesoleo.model import Normal
from bayesoleo.model._expressions import symbol
from bayesoleo.systems import system

SCALES = Scales(
    position={"displacement": (-0.01, 0.01), "position": (-0.01, 0.01), "stroke": (0.01, 0.2)},
    velocity={"displacement": 0.1, "position": 0.1, "stroke": 0.5},
    output={"force": 50.0, "displacement": 0.02},
    shortest_period=0.5,
    longest_period=2.0,
)


def add(assembly: Assembly, effect: str, target: str | None = None) -> Assembly:
    found = assembly.options(SCALES, [find_effect(effect)])
    return next(o.assembly for o in found if target in (None, o.candidate.target))


@pytest.fixture(params=[None, "displacement"])
def oscillator(request) -> Assembly:
    """In its own drive, and driven by the displacement."""
    return Assembly(system("linear_oscillator"), request.param)


def test_an_effect_adds_its_parameters_at_the_null(oscillator):
    grown = add(oscillator, "cubic_stiffness")
    before, after = oscillator.model().parameters, grown.model().parameters
    assert {name: after[name] for name in before} == dict(before)
    (new,) = set(after) - set(before)
    assert after[new].value == 0.0
    assert grown.steps[0].amplitudes == (new,)


def test_effects_are_listed_in_the_order_in_which_they_were_added(oscillator):
    names = ["coulomb_friction", "sensor_gain", "cubic_stiffness"]
    assembly = oscillator
    for name in names:
        assembly = add(assembly, name)
    assert [effect for effect, _ in assembly.added] == names
    assert oscillator.added == ()


def test_physics_and_sensors_can_be_added_in_either_order(oscillator):
    one = add(add(oscillator, "sensor_offset", "displacement"), "cubic_stiffness")
    other = add(add(oscillator, "cubic_stiffness"), "sensor_offset", "displacement")
    assert set(one.model().parameters) == set(other.model().parameters)
    assert one.model().inputs == other.model().inputs
    for channel in one.model().outputs:
        a, b = (sum(item.model().output_terms(channel).values()) for item in (one, other))
        assert a.equals(b)


def test_values_reach_parameters_wherever_they_live(oscillator):
    grown = add(add(oscillator, "sensor_gain", "displacement"), "cubic_stiffness")
    cubic, gain = grown.steps[1].amplitudes[0], grown.steps[0].amplitudes[0]
    values = {"damping": 0.7, cubic: 123.0, gain: 0.02}
    changed = grown.with_values(values).model().parameters
    assert {name: changed[name].value for name in values} == values
    # Whatever is added next must not lose them.
    more = add(grown.with_values(values), "coulomb_friction").model().parameters
    assert {name: more[name].value for name in values} == values


def test_priors_are_replaced_wherever_the_parameters_live(oscillator):
    grown = add(add(oscillator, "sensor_gain", "displacement"), "cubic_stiffness")
    prior = Normal(0.0, 7.0)
    for step in grown.steps:
        (name,) = step.amplitudes
        present = grown.model().parameters[name]
        grown = grown.with_parameters({name: replace(present, prior=prior)})
    for step in grown.steps:
        assert grown.model().parameters[step.amplitudes[0]].prior == prior


@pytest.mark.parametrize("removed", [0, 1, 2])
def test_without_an_effect_the_rest_stays_with_its_values(oscillator, removed):
    names = ["sensor_gain", "cubic_stiffness", "coulomb_friction"]
    assembly = oscillator
    for name in names:
        assembly = add(assembly, name)
    unknowns = assembly.model().estimated()
    values = {name: 0.01 * (k + 1) for k, name in enumerate(unknowns)}
    assembly = assembly.with_values(values)
    less = assembly.without(assembly.steps[removed])
    assert [effect for effect, _ in less.added] == [n for k, n in enumerate(names) if k != removed]
    kept = less.model().parameters
    gone = set(assembly.model().parameters) - set(kept)
    assert set(assembly.steps[removed].amplitudes) <= gone
    for name in less.model().estimated():
        assert kept[name].value == values[name]


def test_what_acts_on_an_effect_leaves_with_it(oscillator):
    """A stiffness that varies by run is nothing without the stiffness."""
    grown = add(oscillator, "cubic_stiffness")
    grown = add(grown, "varies_by_run", "cubic_stiffness")
    grown = add(add(grown, "sensor_offset", "force"), "varies_by_run", "damping")
    less = grown.without(grown.steps[0])
    assert less.added == (("sensor_offset", "force"), ("varies_by_run", "damping"))


def test_a_curve_over_what_an_effect_brought_leaves_with_it():
    """A function of the memory of a friction law cannot be evaluated without that memory."""
    grown = add(Assembly(damper()), "dahl_friction")
    memory = Axis("dahl_friction_memory", symbol("dahl_friction_memory"), "", -1.0, 1.0)
    stroke = Axis("displacement", symbol("displacement"), "m", -0.01, 0.01)
    for axis in (memory, stroke):
        curve = Spline("force", (axis,), (4,), np.eye(7)).effect()
        grown = grown.option(curve, "force", SCALES).assembly
    less = grown.without(grown.steps[0])
    assert less.added == (("nonparametric_displacement", "force"),)
    assert "dahl_friction_memory" not in less.model().dofs
    used = less.model().output("force").free_symbols
    assert symbol("dahl_friction_memory") not in used
    assert symbol("displacement") in used


def test_without_its_only_effect_the_model_is_the_declared_one(oscillator):
    grown = add(oscillator, "coulomb_friction")
    assert grown.without(grown.steps[0]).model().digest() == oscillator.model().digest()


def test_a_second_effect_of_the_same_id_can_be_removed(oscillator):
    """Offsets on two channels are two steps; taking one out leaves the other."""
    channels = (*oscillator.model().inputs, *oscillator.model().outputs)
    grown = oscillator
    for channel in channels:
        grown = add(grown, "sensor_offset", channel)
    less = grown.without(grown.steps[0])
    assert less.added == (("sensor_offset", channels[1]),)


def test_an_effect_that_is_in_is_not_offered_again(oscillator):
    grown = add(oscillator, "cubic_stiffness")
    assert grown.options(SCALES, [find_effect("cubic_stiffness")]) == []
    sensed = add(oscillator, "sensor_gain", "displacement")
    again = sensed.options(SCALES, [find_effect("sensor_gain")])
    assert [o.candidate.target for o in again] == ["force"]


def test_only_terms_of_the_declared_model_are_said_to_depend_on_something():
    """A term that an effect added is a supposition; another one about it would lean on that."""
    effects = [find_effect(f"{kind}_dependent_term") for kind in ("direction", "stroke")]

    def places(assembly: Assembly) -> set[str]:
        return {option.candidate.target for option in assembly.options(SCALES, effects)}

    declared = Assembly(system("f16n2d2"), "displacement")
    grown = add(declared, "coulomb_friction")
    assert places(declared)
    assert places(grown) == places(declared)
    # A user's model that has the term is asked about it.
    assert places(Assembly(grown.native, "displacement")) > places(declared)


def test_options_that_leave_no_inverse_are_skipped():
    """A term in the square of the force has no unique inverse for a displacement drive."""

    def change(model, target, names):
        term = names["square"] * symbol("force") ** 2
        return model.with_term("equation", target, "square", term)

    square = Effect(
        id="square",
        family="nonparametric",
        title="Square of the force",
        formula="s F^2",
        amplitudes=(Amplitude("square", "1/force", "s", "square of the force"),),
        places=lambda model: tuple(model.dofs),
        change=change,
    )
    model = system("linear_oscillator")
    assert len(Assembly(model).options(SCALES, [square])) == 1
    assert Assembly(model, "displacement").options(SCALES, [square]) == []


def test_every_catalogue_option_keeps_the_outputs_and_the_present_parameters(oscillator):
    present = oscillator.model()
    found = oscillator.options(SCALES)
    assert len(found) > 20
    for option in found:
        assert set(option.model.outputs) == set(present.outputs), option.key
        assert set(present.parameters) <= set(option.model.parameters)
        assert set(option.candidate.parameters) <= set(option.model.estimated())


def test_a_static_force_law_has_its_own_options():
    found = {option.key[0] for option in Assembly(damper()).options(SCALES)}
    assert {"coulomb_friction", "quintic_stiffness", "mass_error", "dahl_friction"} <= found
    assert np.all([name.isidentifier() for name in found])
