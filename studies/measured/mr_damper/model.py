"""A viscous damper whose force has an unknown offset in every run."""

from bayesoleo.model import Model, Output, Parameter

model = Model(
    "viscous damper",
    inputs={"displacement": "m"},
    parameters={
        "damping": Parameter(1000.0, "N*s/m", sd=1000.0, bounds=(0.0, 1e5)),
        "force_offset": Parameter(0.0, "N", sd=500.0, by_run=True),
    },
    outputs={
        "force": Output({"damping": "damping*dot(displacement)", "offset": "force_offset"}, "N")
    },
)
