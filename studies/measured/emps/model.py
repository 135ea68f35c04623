"""A positioning drive: a mass with viscous and Coulomb friction."""

from bayesoleo.model import Model, Output, Parameter

model = Model(
    "positioning drive",
    inputs={"force": "N"},
    dofs={"slide": "m"},
    parameters={
        "mass": Parameter(100.0, "kg", relative_sd=0.5),
        "viscous": Parameter(200.0, "N*s/m", relative_sd=0.5),
        "coulomb": Parameter(20.0, "N", relative_sd=0.5),
        "friction_slope": Parameter(1000.0, "s/m", fixed=True),
    },
    equations={
        "slide": {
            "inertia": "mass*ddot(slide)",
            "viscous": "viscous*dot(slide)",
            "friction": "coulomb*2/pi*atan(friction_slope*dot(slide))",
            "drive": "-force",
        }
    },
    outputs={"position": Output("slide", "m")},
)
