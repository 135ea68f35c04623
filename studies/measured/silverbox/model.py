"""The Silverbox as a linear oscillator: the spring is taken as linear, which it is not."""

from bayesoleo.model import Model, Output, Parameter

model = Model(
    "linear circuit",
    inputs={"input_voltage": "V"},
    dofs={"y": "V"},
    parameters={
        "damping": Parameter(50.0, "1/s", sd=50.0, bounds=(0.0, 1e4)),
        "stiffness": Parameter(2.0e5, "1/s**2", sd=1e5),
        "gain": Parameter(2.0e5, "1/s**2", sd=1e5),
    },
    equations={
        "y": {
            "inertia": "ddot(y)",
            "damping": "damping*dot(y)",
            "spring": "stiffness*y",
            "drive": "-gain*input_voltage",
        }
    },
    outputs={"output_voltage": Output("y", "V")},
)
