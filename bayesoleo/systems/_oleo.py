"""The oleo of Verbeek (1993): gas spring, damping, friction; drop test; published values.

The parameters are physical, so that a change of the initial volume reaches every coefficient that
contains it; the theta of the thesis are definitions of them. The ``thesis`` variants follow the
thesis instead: theta_4, theta_6 and one more are estimated and the other theta are numbers,
although they contain the area and the volume. Code ``f16nXdZ``: X dofs, Z outputs. Stroke is
positive in compression, pressure is gauge.

In the drop test a mass on top is released at rest with the oleo fully extended. Gravity alone
compresses the oleo, and its force is measured (Verbeek 1993, section 6.4: theta_1 = 350 or 825 kg,
F_e = 0, theta_2 = -9.81 m/s**2).

The published values are the shaker grid and the estimates run by run, as printed; digits that are
illegible in the scan are NaN. Reproductions are compared with them; no model uses them as defaults.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from bayesoleo.errors import InputError
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Condition, Dof, Output, Parameter
from bayesoleo.model._priors import LogNormal

NAN = float("nan")


@dataclass(frozen=True)
class ShakerRun:
    """A run of the shaker tests.

    Parameters
    ----------
    label, group : str
        Tables 5.1 and 5.2; the group is the static position.
    frequency : float
        Hz.
    position, amplitude : float
        Static position and amplitude of the stroke, m.
    """

    label: str
    group: str
    frequency: float
    position: float
    amplitude: float


#: Tables 5.1 and 5.2. Run a was run over the full stroke and the amplitude of b is illegible; both
#: are given the largest that stays off the stops, and k and m are trimmed to a stroke that stays
#: positive.
SHAKER_RUNS = (
    ShakerRun("a", "middle", 0.04, 0.133, 0.130),
    ShakerRun("b", "middle", 0.1, 0.133, 0.130),
    ShakerRun("c", "high", 0.2, 0.179, 0.075),
    ShakerRun("d", "high", 0.5, 0.219, 0.032),
    ShakerRun("e", "high", 1.0, 0.229, 0.020),
    ShakerRun("f", "high", 2.0, 0.249, 0.010),
    ShakerRun("g", "middle", 0.2, 0.133, 0.078),
    ShakerRun("h", "middle", 0.5, 0.133, 0.034),
    ShakerRun("i", "middle", 1.0, 0.133, 0.021),
    ShakerRun("j", "middle", 2.0, 0.133, 0.010),
    ShakerRun("k", "low", 0.2, 0.079, 0.078),
    ShakerRun("l", "low", 0.5, 0.039, 0.035),
    ShakerRun("m", "low", 1.0, 0.017, 0.016),
    ShakerRun("n", "low", 2.0, 0.014, 0.010),
)

#: Table 6.2, mechanical model, by run: theta_4 in m**2, theta_6 in 1/m, theta_7, and the largest
#: residual in m. Runs j and n did not converge.
TABLE_6_2: dict[str, tuple[float, float, float, float]] = {
    "a": (3.198e-3, -3.788, 0.974, 15e-3),
    "b": (2.872e-3, -3.734, 1.163, 20e-3),
    "c": (2.205e-3, -3.619, 1.382, 11e-3),
    "d": (1.649e-3, -3.574, 1.527, 2e-3),
    "e": (1.480e-3, -3.601, 1.495, 0.7e-3),
    "f": (2.072e-3, -3.742, 1.166, 0.9e-3),
    "g": (3.030e-3, -3.758, 1.198, 9e-3),
    "h": (2.956e-3, -3.810, 1.217, 1e-3),
    "i": (3.201e-3, -4.474, 0.863, 1e-3),
    "k": (3.447e-3, -3.922, 1.101, 5e-3),
    "l": (3.710e-3, -3.810, 1.176, 2e-3),
    "m": (3.857e-3, -3.050, 1.494, 2e-3),
}

#: Table 6.5, thermo-mechanical model, by run: theta_4 in m**2, theta_6 in 1/m, theta_16 in W/K, and
#: the largest residual in m. Theta_16 of a and b is illegible; those of j, m and n were negative,
#: and rejected.
TABLE_6_5: dict[str, tuple[float, float, float, float]] = {
    "a": (3.262e-3, -3.512, NAN, 6e-3),
    "b": (3.227e-3, -3.409, NAN, 3.7e-3),
    "c": (2.941e-3, -3.477, 5.958, 6e-3),
    "d": (3.158e-3, -3.461, 7.189, 2e-3),
    "e": (3.574e-3, -3.439, 7.350, 0.6e-3),
    "f": (3.592e-3, -3.451, 0.928, 0.5e-3),
    "g": (3.607e-3, -3.334, 3.309, 2e-3),
    "h": (3.694e-3, -3.346, 1.533, 0.9e-3),
    "i": (3.710e-3, -3.354, 1.513, 0.9e-3),
    "j": (3.628e-3, -3.437, NAN, 1e-3),
    "k": (3.868e-3, -3.160, 1.957, 3e-3),
    "l": (3.937e-3, -2.981, 0.807, 1e-3),
    "m": (3.970e-3, -2.921, NAN, 2e-3),
    "n": (3.948e-3, -3.390, NAN, 1e-3),
}

#: Table 6.7, which is lost in the scan, rebuilt from table 6.5: mean and standard deviation over
#: runs; theta_16 over the nine that are legible and positive.
TABLE_6_7: dict[str, tuple[float, float]] = {
    "theta_4": (3.580e-3, 0.321e-3),
    "theta_6": (-3.334, 0.184),
    "theta_16": (3.39, 2.70),
}


#: Solubility coefficient theta_7 of the tables, in 1/K: the physical sign is positive.
THETA_7 = 1.42e-4


def _common_parameters() -> dict[str, Parameter]:
    """Nominal values of Verbeek (1993), tables C.1 and D.1."""
    return {
        "mass": Parameter(25.0, "kg", fixed=True, latex="m"),
        "gravity": Parameter(9.81, "m/s**2", fixed=True, latex="g"),
        "orifice_damping": Parameter(
            2897.0,
            "kg/m",
            fixed=True,
            relative_sd=0.1,
            latex="\\theta_3",
            description="rho/(2 C_d^2) sum A_h^3/A_o^2",
        ),
        "piston_area": Parameter(3484e-6, "m**2", relative_sd=0.1, latex="A_p"),
        "initial_volume": Parameter(9.20e-4, "m**3", relative_sd=0.1, latex="V_0"),
        "ambient_pressure": Parameter(1.0e5, "Pa", fixed=True, latex="p_a"),
        "friction_base": Parameter(65.0, "N", relative_sd=0.5, latex="\\theta_8"),
        "friction_per_pressure": Parameter(2.0e-5, "m**2", relative_sd=0.5, latex="\\theta_9"),
        "friction_slope": Parameter(
            3400.0, "s/m", prior=LogNormal(3400.0, 0.7), latex="\\theta_{10}"
        ),
    }


def _gas_constants() -> dict[str, Parameter]:
    return {
        "specific_heat": Parameter(743.0, "J/(kg*K)", fixed=True, latex="c_v"),
        "specific_gas_constant": Parameter(296.8, "J/(kg*K)", fixed=True, latex="R_{N_2}"),
        "gas_constant": Parameter(8.314, "J/(mol*K)", fixed=True, latex="R"),
    }


def _conditions() -> dict[str, Condition]:
    return {
        "initial_pressure": Condition("Pa", 4.9e5, "absolute, at full extension"),
        "ambient_temperature": Condition("K", 293.0),
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


def _energy() -> dict[str, dict[str, str]]:
    """Energy balance of the gas, Verbeek (1993), eq. 6.4."""
    return {
        "temperature": {
            "storage": "heat_capacity*dot(temperature)",
            "conduction": "heat_loss",
            "compression": "-gas_power",
        }
    }


def _outputs(number: int) -> dict[str, Output]:
    outputs = {"displacement": Output({"stroke": "stroke"}, "m")}
    if number == 2:
        pressure = {"absolute": "gas_pressure", "atmosphere": "-ambient_pressure"}
        outputs["pressure"] = Output(pressure, "Pa")
    return outputs


def mechanical_oleo(outputs: int = 1) -> Model:
    """Model ``f16n1d1`` or ``f16n1d2``: one dof, polytropic gas (Verbeek 1993, eqs. 6.1-6.2)."""
    exponent = Parameter(1.10, "", relative_sd=0.1, bounds=(0.9, 1.7), latex="n")
    return Model(
        name=f"f16n1d{outputs}",
        description="Oleo with a polytropic gas spring, driven by force.",
        inputs={"force": "N"},
        dofs={"stroke": Dof("m", guess="initial_volume/piston_area*0.5")},
        conditions=_conditions(),
        parameters=_common_parameters() | {"gas_exponent": exponent},
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
    """Model ``f16n2d1`` or ``f16n2d2``: temperature and solubility (Verbeek 1993, eqs. 6.3-6.4).

    Solubility has the physical sign: gas dissolves as pressure rises, dn/dp < 0 and
    theta_7 = -(dn/dp) R/V_0 > 0, with theta_5 = p_0 (1/T_0 + theta_7), so that the pressure at rest
    is p_0.
    """
    parameters = _common_parameters() | _gas_constants()
    parameters["solubility"] = Parameter(-1.570e-8, "mol/Pa", relative_sd=0.5, latex="dn/dp")
    parameters["heat_conduction"] = Parameter(2.567, "W/K", relative_sd=0.5, latex="\\theta_{16}")
    return Model(
        name=f"f16n2d{outputs}",
        description="Oleo with gas temperature and solubility, driven by force.",
        inputs={"force": "N"},
        dofs={
            "stroke": Dof("m", guess="initial_volume/piston_area*0.5"),
            "temperature": Dof("K", guess="ambient_temperature"),
        },
        conditions=_conditions(),
        parameters=parameters,
        definitions={
            "solubility_ratio": "-solubility*gas_constant/initial_volume",  # theta_7
            # theta_5
            "gas_stiffness": "initial_pressure*(1/ambient_temperature + solubility_ratio)",
            # theta_15
            "heat_capacity": "initial_pressure*initial_volume*specific_heat"
            "/(specific_gas_constant*ambient_temperature)",
            "volume_ratio": "1 - piston_area*stroke/initial_volume",
            "temperature_ratio": "temperature/ambient_temperature",
            "free_volume_ratio": "volume_ratio + solubility_ratio*temperature",
            "gas_pressure": "gas_stiffness*temperature/free_volume_ratio",
            "gas_power": "piston_area*(gas_pressure - ambient_pressure)*dot(stroke)",
            "heat_loss": "heat_conduction*volume_ratio*(temperature - ambient_temperature)",
            "friction_amplitude": "friction_base + friction_per_pressure*gas_pressure",
        },
        equations=_motion() | _energy(),
        outputs=_outputs(outputs),
        admissible=["volume_ratio", "free_volume_ratio", "temperature"],
    )


# -- the thesis's own way --------------------------------------------------------------------------


def _thesis_parameters() -> dict[str, Parameter]:
    """Theta_4 and theta_6 with the thesis's priors, sigma = 0.1 theta; the rest fixed."""
    fixed = {name: _fixed(item) for name, item in _common_parameters().items()}
    del fixed["piston_area"]
    return fixed | {
        "theta_4": Parameter(3484e-6, "m**2", relative_sd=0.1, latex="\\theta_4"),
        "theta_6": Parameter(-3.787, "1/m", relative_sd=0.1, latex="\\theta_6"),
        "theta_11": Parameter(
            -348.4, "N", fixed=True, latex="\\theta_{11}", description="-p_a A_p"
        ),
    }


def _fixed(item: Parameter) -> Parameter:
    return Parameter(
        item.value, item.unit, fixed=True, latex=item.latex, description=item.description
    )


def _thesis_motion() -> dict[str, dict[str, str]]:
    terms = _motion()["stroke"]
    return {"stroke": terms | {"gas_spring": "theta_4*gas_pressure", "atmosphere": "theta_11"}}


def mechanical_oleo_thesis(outputs: int = 1) -> Model:
    """``f16n1dZ`` with theta_4, theta_6 and theta_7 estimated (Verbeek 1993, table 6.2)."""
    exponent = Parameter(1.10, "", relative_sd=0.1, latex="\\theta_7", description="gas exponent")
    return Model(
        name=f"f16n1d{outputs}_thesis",
        description="Oleo with a polytropic gas spring; the thesis's theta, unlinked.",
        inputs={"force": "N"},
        dofs={"stroke": Dof("m", guess=0.132)},
        conditions=_conditions(),
        parameters=_thesis_parameters() | {"theta_7": exponent},
        definitions={
            "volume_ratio": "1 + theta_6*stroke",
            "temperature_ratio": "1",
            "free_volume_ratio": "volume_ratio",
            "gas_pressure": "initial_pressure*temperature_ratio*free_volume_ratio**(-theta_7)",
            "friction_amplitude": "friction_base + friction_per_pressure*gas_pressure",
        },
        equations=_thesis_motion(),
        outputs=_outputs(outputs),
        admissible=["free_volume_ratio"],
    )


def thermomechanical_oleo_thesis(outputs: int = 1, printed: bool = False) -> Model:
    """``f16n2dZ`` with theta_4, theta_6 and theta_16 estimated (Verbeek 1993, table 6.5).

    Parameters
    ----------
    outputs : int
        1: displacement; 2: pressure as well.
    printed : bool
        Take theta_7 with the negative sign of the tables, which makes gas appear as pressure rises.
        The text, and the pressures reached, say the opposite; the printed estimates were found
        with it. Theta_5 = p_0 (1/T_0 + theta_7) either way.
    """
    sign = -1.0 if printed else 1.0
    parameters = _thesis_parameters() | _gas_constants()
    del parameters["gas_constant"]
    parameters["theta_7"] = Parameter(sign * THETA_7, "1/K", fixed=True, latex="\\theta_7")
    parameters["theta_16"] = Parameter(2.567, "W/K", relative_sd=0.1, latex="\\theta_{16}")
    note = ", theta_7 with the printed sign" if printed else ""
    return Model(
        name=f"f16n2d{outputs}_thesis" + ("_printed" if printed else ""),
        description=f"Oleo with gas temperature; the thesis's theta, unlinked{note}.",
        inputs={"force": "N"},
        dofs={"stroke": Dof("m", guess=0.1), "temperature": Dof("K", guess="ambient_temperature")},
        conditions=_conditions(),
        parameters=parameters,
        definitions={
            "theta_5": "initial_pressure*(1/ambient_temperature + theta_7)",
            "heat_capacity": "initial_pressure*initial_volume*specific_heat"
            "/(specific_gas_constant*ambient_temperature)",
            "volume_ratio": "1 + theta_6*stroke",
            "temperature_ratio": "temperature/ambient_temperature",
            "free_volume_ratio": "volume_ratio + theta_7*temperature",
            "gas_pressure": "theta_5*temperature/free_volume_ratio",
            "gas_power": "(theta_4*gas_pressure + theta_11)*dot(stroke)",
            "heat_loss": "theta_16*volume_ratio*(temperature - ambient_temperature)",
            "friction_amplitude": "friction_base + friction_per_pressure*gas_pressure",
        },
        equations=_thesis_motion() | _energy(),
        outputs=_outputs(outputs),
        admissible=["volume_ratio", "free_volume_ratio", "temperature"],
    )


#: Terms of the equation of motion that the oleo puts up against the mass.
REACTION = ("damping", "gas_spring", "friction", "atmosphere")


def drop_test(model: Model, mass: float) -> Model:
    """An oleo of the thesis as it stands in a drop test.

    Parameters
    ----------
    model : Model
        A built-in oleo in its own drive, at any parameter values; effects may have been added.
    mass : float
        Dropped, kg.

    Returns
    -------
    Model
        Without input; it starts extended, at rest and at ambient temperature, and has ``force`` as
        an output besides its own: damping, gas spring, friction and atmosphere together.

    Raises
    ------
    InputError
        If the model has no such equation of motion, or the mass is not positive.
    """
    terms = model.equations.get("stroke", {})
    missing = [name for name in ("inertia", "weight", "excitation", *REACTION) if name not in terms]
    if missing or "force" not in model.inputs:
        raise InputError(
            f"model {model.name!r} is no oleo driven by force",
            value=missing or list(model.inputs),
            hint="give a built-in one, e.g. system('f16n2d2'), before choosing another drive",
        )
    if not mass > 0:
        raise InputError("a drop needs a positive mass", key="mass", value=mass)
    motion = {name: term for name, term in terms.items() if name != "excitation"}
    starts = {"stroke": (0.0, 0.0), "temperature": ("ambient_temperature", None)}
    dofs = {
        name: replace(dof, initial=starts[name][0], initial_rate=starts[name][1])
        if name in starts
        else dof
        for name, dof in model.dofs.items()
    }
    gravity = abs(model.parameters["gravity"].value)
    return replace(
        model,
        name=f"{model.name}_drop",
        description=f"{model.description} In a drop test with {mass:g} kg.",
        inputs={},
        dofs=dofs,
        equations={**model.equations, "stroke": motion},
        outputs={**model.outputs, "force": Output({k: terms[k] for k in REACTION}, "N")},
    ).with_values({"mass": mass, "gravity": -gravity})
