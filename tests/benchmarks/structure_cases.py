"""Effects that act between two bodies, in one term of the model, or in series: whether the loop
names them and tells their size.

Each case is a simulated campaign of a few runs whose truth has one effect beside the declared
model: a cubic spring between two masses that are declared by their heights, friction that depends
on pressure and differs between the directions, friction that rises with temperature, friction
behind a gap, and a temperature sensor of first order. The true models are written down as
equations, independently of the catalogue. The whole catalogue is searched with default settings;
nothing is sampled.

Run as ``python tests/benchmarks/structure_cases.py [--json] [--case NAME] [--seed 0] [--seeds 1]
[--alone]``. It prints by case, and by seed where there are several, whether the effect was named
(``named``: it is the only one, or in the class of the only one), its size with the 95 % interval
and the truth, and how many base parameters lie within theirs. With ``--alone`` no other effect is
offered, so that intervals are seen over many seeds in little time.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesoleo._workflow.simulating import to_simulated_run
from bayesoleo.data import load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import ClosedLoop, close_loop
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.effects import find_effect
from bayesoleo.model import Condition, Dof, Model, Output, Parameter
from bayesoleo.prediction import RunPlan, motion, simulate_run
from bayesoleo.prediction._records import Record

Array = NDArray[np.float64]

#: Standard deviations of a 95 % interval.
_INTERVAL = 1.96


@dataclass(frozen=True)
class Case:
    """A campaign with one effect that the declared model lacks.

    Parameters
    ----------
    effect, target : str
        What the catalogue calls it, and its place.
    size : str
        Parameter of the extended model that is its size.
    truth : float
        Its true value, SI.
    declared, true : Model
        The true model has the same parameters and more.
    plans : sequence of RunPlan
        The last two are held out.
    noise : mapping of str to float
        By channel, SI.
    values : mapping of str to float
        True values of the base parameters that are not the declared ones.
    drive : str or None
        Channel that drives the declared model.
    shown : callable (plan, samples) -> samples
        What the true model does not say.
    """

    effect: str
    target: str
    size: str
    truth: float
    declared: Model
    true: Model
    plans: Sequence[RunPlan]
    noise: Mapping[str, float]
    values: Mapping[str, float]
    drive: str | None = None
    shown: Callable[[RunPlan, dict[str, Array]], dict[str, Array]] = lambda _, samples: samples

    def records(self, seed: int) -> tuple[Record, ...]:
        """A new campaign, written to files and read back."""
        streams = np.random.default_rng(seed).spawn(len(self.plans))
        units = {name: item.unit for name, item in self.true.conditions.items()}
        runs = []
        for plan, rng in zip(self.plans, streams, strict=True):
            run = simulate_run(self.true, plan, self.values, noise=self.noise, rng=rng)
            run = replace(run, samples=self.shown(plan, dict(run.samples)))
            runs.append(to_simulated_run(run, units))
        outputs = {name: item.unit for name, item in self.true.outputs.items()}
        channels = {**self.true.inputs, **outputs}
        with tempfile.TemporaryDirectory() as folder:
            write_campaign(
                folder,
                name=self.true.name,
                controlled=next(iter(self.true.inputs)),
                channels={name: (name, unit) for name, unit in channels.items()},
                runs=runs,
                overwrite=True,
            )
            return tuple(reduce_campaign(load_campaign(folder), jobs=1).records)


def _known(value: float, unit: str, spread: float) -> Parameter:
    """A positive constant known to a part of its value."""
    return Parameter(value, unit, relative_sd=spread, bounds=(0.1 * value, 10 * value))


def _runs(
    channel: str,
    settings: Sequence[tuple[float, float]],
    mean: float = 0.0,
    second: float = 0.0,
    **conditions: Sequence[float],
) -> list[RunPlan]:
    """One run for each frequency in Hz and amplitude in SI; the last two are held out."""
    plans = []
    for k, (frequency, amplitude) in enumerate(settings):
        given = {name: values[k] for name, values in conditions.items()}
        signal = motion(mean, [amplitude, second * amplitude], [0.0, 1.0])
        role = "fit" if k < len(settings) - 2 else "hold-out"
        plans.append(
            RunPlan(f"run {k + 1}", frequency, {channel: signal}, given, 6, 120.3, role=role)
        )
    return plans


# -- two masses by their heights -------------------------------------------------------------------

_HEIGHTS = {
    "upper": {
        "inertia": "upper_mass*ddot(upper)",
        "spring": "coupling*(upper - lower)",
        "damper": "coupling_damping*(dot(upper) - dot(lower))",
    },
    "lower": {
        "inertia": "lower_mass*ddot(lower)",
        "ground": "ground_stiffness*lower",
        "ground damper": "ground_damping*dot(lower)",
        "spring": "-coupling*(upper - lower)",
        "damper": "-coupling_damping*(dot(upper) - dot(lower))",
        "excitation": "-force",
    },
}


def _heights(more: Mapping[str, str], **parameters: Parameter) -> Model:
    """Two masses; ``more`` is a force on the upper one, and its opposite on the lower one."""
    equations = {name: dict(terms) for name, terms in _HEIGHTS.items()}
    for name, force in more.items():
        equations["upper"][name], equations["lower"][name] = force, f"-({force})"
    return Model(
        "two masses by heights",
        inputs={"force": "N"},
        dofs={"upper": Dof("m"), "lower": Dof("m")},
        parameters={
            "upper_mass": Parameter(1.0, "kg", fixed=True),
            "lower_mass": Parameter(2.0, "kg", fixed=True),
            "coupling": _known(1.5e4, "N/m", 0.3),
            "coupling_damping": _known(8.0, "N*s/m", 0.5),
            "ground_stiffness": _known(2e4, "N/m", 0.3),
            "ground_damping": _known(15.0, "N*s/m", 0.5),
            **parameters,
        },
        equations=equations,
        outputs={
            "upper_height": Output("upper", "m"),
            "lower_height": Output("lower", "m"),
        },
    )


def between() -> Case:
    """A cubic spring between two masses that are declared by their heights."""
    return Case(
        "cubic_stiffness",
        "upper-lower",
        "cubic_stiffness_upper_lower",
        1e9,
        _heights({}),
        _heights(
            {"cubic": "cubic*(upper - lower)**3"}, cubic=Parameter(1e9, "N/m**3", fixed=True)
        ),
        _runs("force", [(8.0, 20.0), (12.0, 15.0), (16.0, 30.0), (24.0, 40.0), (9.0, 20.0),
                        (18.0, 30.0)]),
        {"upper_height": 1e-5, "lower_height": 1e-5},
        {"coupling": 1.62e4, "coupling_damping": 9.1, "ground_stiffness": 1.9e4},
    )  # fmt: skip


# -- an oleo with friction of its own law ----------------------------------------------------------

_FRICTION = "(friction_base + friction_per_pressure*gas_pressure)*atan(3400*dot(stroke))"


def _oleo(friction: str, *, warm: bool = False, **parameters: Parameter) -> Model:
    """A gas spring with an orifice under a controlled stroke; ``warm`` gas loses its heat."""
    law = (
        "initial_pressure*(temperature/ambient_temperature)/volume_ratio"
        if warm
        else ("initial_pressure*volume_ratio**(-gas_exponent)")
    )
    heat: dict[str, Any] = {}
    if warm:
        heat["dofs"] = {"temperature": Dof("K", guess="ambient_temperature")}
        heat["equations"] = {
            "temperature": {
                "storage": "heat_capacity*dot(temperature)",
                "loss": "heat_conduction*(temperature - ambient_temperature)",
                "work": "-(gas_pressure - ambient_pressure)*piston_area*dot(stroke)",
            }
        }
        parameters = {
            "heat_capacity": Parameter(4.0, "J/K", fixed=True),
            "heat_conduction": _known(2.5, "W/K", 0.3),
            **parameters,
        }
    else:
        parameters = {"gas_exponent": _known(1.1, "", 0.1), **parameters}
    return Model(
        "oleo",
        inputs={"stroke": "m"},
        conditions={
            "initial_pressure": Condition("Pa", 4.9e5),
            **({"ambient_temperature": Condition("K", 293.0)} if warm else {}),
        },
        parameters={
            "mass": Parameter(25.0, "kg", fixed=True),
            "orifice_damping": _known(2900.0, "N*s**2/m**2", 0.2),
            "piston_area": _known(3.484e-3, "m**2", 0.05),
            "initial_volume": _known(9.2e-4, "m**3", 0.1),
            "ambient_pressure": Parameter(1e5, "Pa", fixed=True),
            "friction_base": _known(65.0, "N", 0.5),
            "friction_per_pressure": _known(1e-4, "m**2", 0.5),
            **parameters,
        },
        definitions={
            "volume_ratio": "1 - piston_area*stroke/initial_volume",
            "gas_pressure": law,
        },
        outputs={
            "force": Output(
                {
                    "inertia": "mass*ddot(stroke)",
                    "damping": "orifice_damping*dot(stroke)*abs(dot(stroke))",
                    "gas": "piston_area*(gas_pressure - ambient_pressure)",
                    "friction": friction,
                },
                "N",
            ),
            "pressure": Output("gas_pressure - ambient_pressure", "Pa"),
        },
        **heat,
    )


_STROKES = [(0.1, 0.05), (0.4, 0.04), (1.0, 0.03), (2.0, 0.025), (0.2, 0.045), (1.4, 0.03)]
_OLEO_NOISE = {"force": 5.0, "pressure": 1e3}
_OLEO = {"piston_area": 3.5e-3, "orifice_damping": 2700.0, "friction_base": 58.0}


def asymmetric() -> Case:
    """Friction that depends on pressure and is larger in compression than in extension."""
    one_way = f"(1 + asymmetry*sign(dot(stroke)))*{_FRICTION}"
    return Case(
        "direction_dependent_term",
        "force.friction",
        "direction_dependent_term_force_friction",
        0.25,
        _oleo(_FRICTION),
        _oleo(one_way, asymmetry=Parameter(0.25, fixed=True)),
        _runs("stroke", _STROKES, 0.1, 0.02),
        _OLEO_NOISE,
        _OLEO,
    )


def warm() -> Case:
    """Friction that rises with the temperature of the gas."""
    rising = f"(1 + rise*(temperature/293 - 1))*{_FRICTION}"
    return Case(
        "temperature_dependent_term",
        "force.friction.temperature",
        "temperature_dependent_term_force_friction_temperature",
        4.0,
        _oleo(_FRICTION, warm=True),
        _oleo(rising, warm=True, rise=Parameter(4.0, fixed=True)),
        _runs("stroke", _STROKES, 0.1, 0.02),
        _OLEO_NOISE,
        {**_OLEO, "heat_conduction": 2.2},
    )


# -- friction behind a gap -------------------------------------------------------------------------

_DAMPER = Model(
    "damper",
    inputs={"displacement": "m"},
    parameters={
        "mass": Parameter(0.5, "kg", fixed=True),
        "damping": _known(200.0, "N*s/m", 0.5),
        "stiffness": _known(1000.0, "N/m", 0.5),
    },
    outputs={
        "force": Output(
            {
                "inertia": "mass*ddot(displacement)",
                "damping": "damping*dot(displacement)",
                "stiffness": "stiffness*displacement",
            },
            "N",
        )
    },
)


def behind_gap(x: Array, friction: float, gap: float, give: float) -> Array:
    """Force of an elastic slider behind a gap, along a motion that repeats.

    The slider and the gap together deflect by the motion, until the force is the friction: a march
    in which nothing is smooth.
    """
    z, deflection = 0.0, np.zeros(x.size)
    for _ in range(2):
        for k in range(x.size):
            z = float(np.clip(z + x[k] - x[k - 1], -gap - give, gap + give))
            deflection[k] = z
    return friction * (deflection - np.clip(deflection, -gap, gap)) / give


def _with_slider(plan: RunPlan, samples: dict[str, Array]) -> dict[str, Array]:
    """What is measured with a slider of 6 N behind a gap of 3 mm."""
    phase = np.arange(8192) / 8192
    force = behind_gap(plan.inputs["displacement"].evaluate(phase, 1.0), 6.0, 1.5e-3, 2e-4)
    now = (plan.time * plan.frequency + plan.phase) % 1.0
    return {**samples, "force": samples["force"] + np.interp(now, phase, force, period=1.0)}


def backlash() -> Case:
    """A friction element behind a gap of 3 mm, in series."""
    return Case(
        "backlash_friction",
        "force",
        "backlash_friction",
        6.0,
        _DAMPER,
        _DAMPER,
        _runs("displacement", [(1.0, 0.010), (2.0, 0.006), (0.5, 0.012), (1.5, 0.008),
                               (1.0, 0.012), (2.5, 0.005)], 0.0, 0.05),
        {"force": 0.2},
        {"damping": 180.0, "stiffness": 1100.0},
        shown=_with_slider,
    )  # fmt: skip


# -- a slow sensor ---------------------------------------------------------------------------------


def _heated(late: bool) -> Model:
    """A body with a time constant of four minutes; its sensor may follow within 25 s."""
    dofs = {"temperature": Dof("K", guess=320.0)}
    equations = {
        "temperature": {
            "storage": "heat_capacity*dot(temperature)",
            "loss": "conductance*(temperature - 293)",
            "heating": "-power",
        }
    }
    if late:
        dofs["reading"] = Dof("K", guess=320.0)
        equations["reading"] = {"lag": "25*dot(reading) + reading", "input": "-temperature"}
    return Model(
        "heated body",
        inputs={"power": "W"},
        dofs=dofs,
        parameters={
            "heat_capacity": _known(500.0, "J/K", 0.4),
            "conductance": _known(2.0, "W/K", 0.4),
        },
        equations=equations,
        outputs={"body": Output("reading" if late else "temperature", "K")},
    )


def slow_sensor() -> Case:
    """A temperature sensor of first order whose time constant is no short delay."""
    return Case(
        "first_order_lag",
        "body",
        "first_order_lag_time_constant_body",
        25.0,
        _heated(False),
        _heated(True),
        _runs("power", [(1 / 60, 60.0), (1 / 200, 40.0), (1 / 600, 40.0), (1 / 1500, 30.0),
                        (1 / 100, 60.0), (1 / 400, 40.0)], 90.0, 0.3),
        {"body": 0.01},
        {"conductance": 2.2, "heat_capacity": 470.0},
    )  # fmt: skip


CASES = {
    "between": between,
    "asymmetric": asymmetric,
    "warm": warm,
    "backlash": backlash,
    "slow_sensor": slow_sensor,
}


# -- what the loop makes of them -------------------------------------------------------------------


def closed(case: Case, seed: int = 0, *, alone: bool = False) -> ClosedLoop:
    """The loop on a new campaign of a case; ``alone`` offers it the true effect only."""
    numerics, roles = Numerics(jobs=1, backend="numpy"), assign(case.records(seed))
    own = Assembly(case.declared, case.drive)
    if not alone:
        return close_loop(own, roles, numerics)
    effects = (find_effect(case.effect),)
    return close_loop(own, roles, numerics, effects=effects, max_effects=1, nonparametric=False)


def judged(case: Case, loop: ClosedLoop) -> dict[str, Any]:
    """What a loop says of the effect and of the base parameters."""
    accepted = [
        item.accepted
        for item in loop.rounds
        if item.accepted and (item.accepted.effect, item.accepted.target) in loop.added
    ]
    classes = {name for item in accepted for name in (item.effect, *item.same)}
    first = loop.added == ((case.effect, case.target),)
    named = first or (len(loop.added) == 1 and case.effect in classes)
    fit = loop.final.fit
    estimates = dict(zip(fit.problem.names, fit.point.theta, strict=True))
    errors = dict(zip(fit.problem.names, np.sqrt(np.diag(fit.point.covariance)), strict=True))
    value, error = estimates.get(case.size), errors.get(case.size)
    base = {
        name: abs(estimates[name] - case.values.get(name, case.declared.parameters[name].value))
        <= _INTERVAL * errors[name]
        for name in case.declared.estimated()
    }
    found = value is not None and abs(value - case.truth) <= _INTERVAL * error
    return {
        "named": bool(named),
        "first": first,
        "added": [f"{effect} @ {target}" for effect, target in loop.added],
        "class": sorted(classes),
        "certainty": loop.certainty,
        "size": None if value is None else float(value),
        "low": None if value is None else float(value - _INTERVAL * error),
        "high": None if value is None else float(value + _INTERVAL * error),
        "truth": case.truth,
        "size_inside": bool(found),
        "base_inside": int(sum(base.values())),
        "base": len(base),
        "outside": [name for name, inside in base.items() if not inside],
    }


def main() -> None:
    """Close the loop on every case, and print what it says."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object")
    parser.add_argument("--case", choices=CASES, help="of one case only")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--seeds", type=int, default=1, help="how many, from that one on")
    parser.add_argument("--alone", action="store_true", help="offer the true effect only")
    options = parser.parse_args()
    flat: dict[str, Any] = {}
    for name in [options.case] if options.case else CASES:
        for seed in range(options.seed, options.seed + options.seeds):
            case, begin = CASES[name](), time.perf_counter()
            result = judged(case, closed(case, seed, alone=options.alone))
            result["seconds"] = round(time.perf_counter() - begin, 1)
            prefix = name if options.seeds == 1 else f"{name}_{seed}"
            flat |= {f"{prefix}_{key}": value for key, value in result.items()}
    if options.json:
        print(json.dumps(flat))
    else:
        print("\n".join(f"{key:<28} {value}" for key, value in flat.items()))


if __name__ == "__main__":
    main()
