"""Extended models can be driven by the channels that the plain ones can."""

from __future__ import annotations

import pytest

from bayesoleo.effects import find_effect
from bayesoleo.errors import ModelError
from bayesoleo.model import driven_by
from bayesoleo.systems import system


@pytest.mark.parametrize("name", ["f16n1d2", "f16n2d2", "duffing"])
def test_every_candidate_can_be_driven_by_displacement(name, offered):
    model = system(name)
    for candidate in offered(model):
        if (candidate.effect, candidate.target) == ("sensor_hum", "displacement"):
            # What follows the clock has no inverse that a model could be driven by.
            with pytest.raises(ModelError, match="cannot be driven by 'displacement'"):
                driven_by(candidate.model, "displacement")
            continue
        driven = driven_by(candidate.model, "displacement")
        assert "displacement" in driven.inputs, candidate.effect
        assert "force" in driven.outputs, candidate.effect
        assert set(candidate.parameters) <= set(driven.parameters)


def test_compliant_frame_keeps_the_dof_when_driven(scales):
    candidate = find_effect("frame_compliance").extend(system("f16n2d2"), "stroke", scales)
    assert "stroke" in driven_by(candidate.model, "displacement").dofs


def test_lagging_force_becomes_a_state_when_driven(scales):
    candidate = find_effect("sensor_lag").extend(system("f16n1d1"), "force", scales)
    driven = driven_by(candidate.model, "displacement")
    assert set(driven.dofs) == {"force_answer"}
