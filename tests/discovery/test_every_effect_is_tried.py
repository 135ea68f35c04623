"""No effect of the catalogue is without a test that data made with it are recognised."""

from __future__ import annotations

import test_recognised_effects
import test_recognised_gas_effects

from bayesoleo.effects import catalogue

#: By tests of their own, in the same modules.
ALONE = {
    "periodic_force", "humming_force", "drifting_force", "gravity_error", "extra_volume",
    "direction_dependent_damping", "compression_damping", "pressure_dependent_friction",
    "gas_solubility", "heat_exchange", "input_dependent_term",
    "first_order_lag",  # in tests/benchmarks/structure_cases.py
    "overflow", "overflow_below",  # in test_overflow.py
    "sensor_hum",  # in test_forces_in_time.py
    "sensor_offset_by_run",  # in test_offsets_by_run.py
}  # fmt: skip


def test_every_effect_has_data_made_with_it():
    tried = {*test_recognised_effects.LAWS, *test_recognised_effects.TERMS, *ALONE}
    tried |= set(test_recognised_gas_effects.EFFECTS)
    assert {effect.id for effect in catalogue()} - tried == set()
