"""A rigid friction damper: Coulomb friction and viscous damping."""

from bayesoleo.model import Model, Output, Parameter

model = Model(
    "friction damper",
    inputs={"displacement": "m"},
    parameters={
        "coulomb": Parameter(1.0e4, "N", relative_sd=0.5),
        "viscous": Parameter(1.0e4, "N*s/m", relative_sd=2.0),
        "friction_slope": Parameter(1000.0, "s/m", fixed=True),
    },
    outputs={
        "force": Output(
            {
                "friction": "coulomb*2/pi*atan(friction_slope*dot(displacement))",
                "damping": "viscous*dot(displacement)",
            },
            "N",
        )
    },
)
