"""Two tanks: each empties through a hole in its bottom, the upper one into the lower one.

The content of the upper tank is in volts of the lower one's level.
"""

from bayesoleo.model import Dof, Model, Output, Parameter

model = Model(
    "two tanks",
    inputs={"pump": "V"},
    dofs={"upper": Dof("V", guess="5.0"), "lower": Dof("V", guess="5.0")},
    parameters={
        "pump_gain": Parameter(0.05, "1/s", relative_sd=1.0, bounds=(0.0, 10.0)),
        "upper_outflow": Parameter(0.05, "V**0.5/s", relative_sd=1.0, bounds=(0.0, 10.0)),
        "lower_outflow": Parameter(0.05, "V**0.5/s", relative_sd=1.0, bounds=(0.0, 10.0)),
    },
    equations={
        "upper": {
            "storage": "dot(upper)",
            "outflow": "upper_outflow*sqrt(positive(upper))",
            "pump": "-pump_gain*pump",
        },
        "lower": {
            "storage": "dot(lower)",
            "outflow": "lower_outflow*sqrt(positive(lower))",
            "inflow": "-upper_outflow*sqrt(positive(upper))",
        },
    },
    outputs={"level": Output("lower", "V")},
)
