"""The oleo of Verbeek (1993): gas spring, orifice damping and pressure-dependent friction; mechanical and thermo-mechanical.

Parametrised physically, so that a change of the initial volume reaches every coefficient it is in; the thesis's theta are definitions of
these. Code ``f16nXdZ``: X dofs, Z outputs. Stroke is positive in compression, pressure is gauge.
"""

from __future__ import annotations

from bayesoleo.model import Condition, Dof, Model, Output, Parameter

GAS_CONSTANT = 8.314  # J/(mol K)
GAS_CONSTANT_NITROGEN = 296.8  # J/(kg K)


def _common_parameters() -> dict[str, Parameter]:
    """Nominal values of the thesis, section 6 and tables C.1 and D.1 of the digest."""
    return {
        "mass": Parameter(25.0, "kg", fixed=True, latex="m"),
        "gravity": Parameter(9.81, "m/s**2", fixed=True, latex="g"),
        "orifice_damping": Parameter(2897.0, "kg/m", fixed=True, latex="\\theta_3", description="rho/(2 C_d^2) sum A_h^3/A_o^2"),
        "piston_area": Parameter(3484e-6, "m**2", relative_sd=0.1, latex="A_p"),
        "initial_volume": Parameter(9.20e-4, "m**3", relative_sd=0.1, latex="V_0"),
        "ambient_pressure": Parameter(1.0e5, "Pa", fixed=True, latex="p_a"),
        "friction_base": Parameter(65.0, "N", relative_sd=0.5, latex="\\theta_8"),
        "friction_per_pressure": Parameter(2.0e-5, "m**2", relative_sd=0.5, latex="\\theta_9"),
        "friction_slope": Parameter(3400.0, "s/m", relative_sd=0.5, bounds=(100.0, 1e5), latex="\\theta_{10}"),
    }


def _motion() -> dict[str, dict[str, str]]:
    """Equation of motion, Verbeek (1993), eqs. 6.1 and 6.3."""
    return {
        "stroke": {
            "inertia": "mass*ddot(stroke)",
            "weight": "mass*gravity",
            "damping": "orifice_damping*dot(stroke)*abs(dot(stroke))",
            "gas_spring": "piston_area*gas_pressure",
            "friction": "friction_amplitude*atan(friction_slope*dot(stroke))",
            "atmosphere": "-ambient_pressure*piston_area",
            "excitation": "-force",
        }
    }


def _outputs(number: int) -> dict[str, Output]:
    outputs = {"displacement": Output({"stroke": "stroke"}, "m")}
    if number == 2:
        outputs["pressure"] = Output({"absolute": "gas_pressure", "atmosphere": "-ambient_pressure"}, "Pa")
    return outputs


def mechanical_oleo(outputs: int = 1) -> Model:
    """Mechanical model ``f16n1d1`` or ``f16n1d2``: one dof, polytropic gas (Verbeek 1993, eqs. 6.1-6.2)."""
    return Model(
        name=f"f16n1d{outputs}",
        description="Oleo with a polytropic gas spring, driven by force.",
        inputs={"force": "N"},
        dofs={"stroke": Dof("m", guess="initial_volume/piston_area*0.5")},
        conditions={
            "initial_pressure": Condition("Pa", 4.9e5, "absolute, at full extension"),
            "ambient_temperature": Condition("K", 293.0),
        },
        parameters=_common_parameters()
        | {"gas_exponent": Parameter(1.10, "", relative_sd=0.1, bounds=(0.9, 1.7), latex="n")},
        definitions={
            "volume_ratio": "1 - piston_area*stroke/initial_volume",
            "temperature_ratio": "1",
            "free_volume_ratio": "volume_ratio",
            "gas_pressure": "initial_pressure*temperature_ratio*free_volume_ratio**(-gas_exponent)",
            "friction_amplitude": "friction_base + friction_per_pressure*gas_pressure",
        },
        equations=_motion(),
        outputs=_outputs(outputs),
        admissible=["free_volume_ratio"],
    )


def thermomechanical_oleo(outputs: int = 1) -> Model:
    """Thermo-mechanical model ``f16n2d1`` or ``f16n2d2``: gas temperature and solubility (Verbeek 1993, eqs. 6.3-6.4).

    Solubility has the physical sign: gas dissolves as pressure rises, dn/dp < 0 and theta_7 = -(dn/dp) R/V_0 > 0, with theta_5 =
    p_0 (1/T_0 + theta_7), so that the pressure at rest is p_0.
    """
    parameters = _common_parameters()
    parameters["solubility"] = Parameter(-1.570e-8, "mol/Pa", relative_sd=0.5, latex="dn/dp")
    parameters["heat_conduction"] = Parameter(2.567, "W/K", relative_sd=0.5, latex="\\theta_{16}")
    parameters["specific_heat"] = Parameter(743.0, "J/(kg*K)", fixed=True, latex="c_v")
    return Model(
        name=f"f16n2d{outputs}",
        description="Oleo with gas temperature and solubility, driven by force.",
        inputs={"force": "N"},
        dofs={
            "stroke": Dof("m", guess="initial_volume/piston_area*0.5"),
            "temperature": Dof("K", guess="ambient_temperature"),
        },
        conditions={
            "initial_pressure": Condition("Pa", 4.9e5, "absolute, at full extension"),
            "ambient_temperature": Condition("K", 293.0),
        },
        parameters=parameters,
        definitions={
            "solubility_ratio": f"-solubility*{GAS_CONSTANT}/initial_volume",  # theta_7
            "gas_stiffness": "initial_pressure*(1/ambient_temperature + solubility_ratio)",  # theta_5
            "heat_capacity": "initial_pressure*initial_volume*specific_heat"
            f"/({GAS_CONSTANT_NITROGEN}*ambient_temperature)",  # theta_15
            "volume_ratio": "1 - piston_area*stroke/initial_volume",
            "temperature_ratio": "temperature/ambient_temperature",
            "free_volume_ratio": "volume_ratio + solubility_ratio*temperature",
            "gas_pressure": "gas_stiffness*temperature/free_volume_ratio",
            "gas_power": "piston_area*(gas_pressure - ambient_pressure)*dot(stroke)",
            "heat_loss": "heat_conduction*volume_ratio*(temperature - ambient_temperature)",
            "friction_amplitude": "friction_base + friction_per_pressure*gas_pressure",
        },
        equations=_motion()
        | {
            "temperature": {
                "storage": "heat_capacity*dot(temperature)",
                "conduction": "heat_loss",
                "compression": "-gas_power",
            }
        },
        outputs=_outputs(outputs),
        admissible=["volume_ratio", "free_volume_ratio", "temperature"],
    )
