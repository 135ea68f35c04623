"""The lower chamber of a nitrogen spring: a polytrope of the volume that the stroke leaves."""

from bayesoleo.model import Model, Output, Parameter

# Bore 5 in less a rod of 1.5 in; the stroke grows as the chamber shrinks.
AREA, FULL_STROKE = 0.0115, 2.03

model = Model(
    "polytropic gas spring",
    inputs={"stroke": "m"},
    parameters={
        "piston_area": Parameter(AREA, "m**2", fixed=True),
        "initial_volume": Parameter(0.0463 + AREA * FULL_STROKE, "m**3", relative_sd=0.2),
        "initial_pressure": Parameter(1.0e6, "Pa", relative_sd=0.2),
        "gas_exponent": Parameter(1.1, relative_sd=0.2, bounds=(0.8, 1.7)),
        "ambient_temperature": Parameter(293.0, "K", fixed=True),
    },
    definitions={
        "volume_ratio": "1 - piston_area*stroke/initial_volume",
        "free_volume_ratio": "volume_ratio",
        "temperature_ratio": "1",
        "gas_pressure": "initial_pressure*temperature_ratio*free_volume_ratio**(-gas_exponent)",
    },
    outputs={"pressure": Output("gas_pressure", "Pa")},
    admissible=["volume_ratio"],
)
