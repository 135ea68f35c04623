"""A pendulum with a viscous bearing."""

from bayesoleo.model import Dof, Model, Output, Parameter

model = Model(
    "pendulum",
    dofs={"swing": Dof("rad", guess="1.0")},
    parameters={
        "stiffness": Parameter(40.0, "1/s**2", relative_sd=0.5),
        "viscous": Parameter(0.1, "1/s", relative_sd=1.0),
    },
    equations={
        "swing": {
            "inertia": "ddot(swing)",
            "damping": "viscous*dot(swing)",
            "gravity": "stiffness*sin(swing)",
        }
    },
    outputs={"angle": Output("swing", "rad")},
)
