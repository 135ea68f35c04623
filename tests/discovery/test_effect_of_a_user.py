"""An effect from a user's own file, on a system that is no oleo."""

from __future__ import annotations

import pytest
from fitted_states import NUMERICS
from small_campaigns import DRAG, HARDENING, SPRING, oscillator_campaign

from bayesoleo._workflow.model_files import load_effects, load_model
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop

DAMPING = 6000.0
MINE = """
from bayesoleo.effects import force_effect

unit = "force*s/position**3"
drag = force_effect("van_der_pol", "damping", "c*position**2*velocity", {"c": unit})
"""
MODEL = """
from bayesoleo import Model, Parameter

model = Model(
    "oscillator",
    inputs={"force": "N"},
    dofs={"position": "m"},
    parameters={
        "mass": Parameter(1.0, "kg", fixed=True),
        "damping": Parameter(0.5, "N*s/m", sd=1.0),
        "stiffness": Parameter(100.0, "N/m", sd=30.0),
        "cubic": Parameter(1e4, "N/m**3", sd=3e4),
    },
    equations={
        "position": "mass*ddot(position) + damping*dot(position) + stiffness*position"
        " + cubic*position**3 - force"
    },
    outputs={"displacement": "position"},
)
"""


@pytest.mark.slow
def test_an_effect_and_a_model_in_files_of_a_few_lines(tmp_path):
    """Damping that grows with displacement, as van der Pol's: no effect of the catalogue."""
    for name, text in (("mine.py", MINE), ("model.py", MODEL)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    effects = load_effects(f"{tmp_path / 'mine.py'}:drag")
    few = ("van_der_pol", "quadratic_damping", "stroke_dependent_damping", "coulomb_friction")
    reduced = oscillator_campaign(
        tmp_path / "rig",
        restoring=lambda x, v: SPRING * x + DRAG * v + HARDENING * x**3 + DAMPING * x**2 * v,
    )
    loop = close_loop(
        Assembly(load_model(f"{tmp_path / 'model.py'}:model")),
        assign(reduced.records),
        NUMERICS,
        effects=[effect for effect in effects if effect.id in few],
        nonparametric=False,
    )
    assert loop.effects == ("van_der_pol",)
    assert loop.final.worst_ratio < 1.15
    point = loop.final.fit.point
    sd = point.sd[loop.final.fit.problem.names.index("van_der_pol_c")]
    assert abs(point["van_der_pol_c"] - DAMPING) < 4 * sd
