"""Results made up from closed formulas, in the layout of `bayesoleo._schema`: 14 runs, and 2."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._storage.result_files import provenance

PHASES = (np.arange(100) + 0.5) / 100
NOISE = {"force": 20.0, "pressure": 5e3}
UNITS = {"displacement": "m", "force": "N", "pressure": "Pa", "voltage": "V"}
FREQUENCIES = (0.04, 0.04, 0.1, 0.1, 0.1, 0.2, 0.2, 0.4, 0.4, 0.4, 0.7, 0.7, 1.0, 1.0)
FRICTION = ("viscous", "quadratic", "Coulomb", "asymmetric", "Dahl", "Stribeck", "pressure")
OTHERS = {
    "stiffness": ("linear", "quadratic", "cubic", "end_stop"),
    "gas": ("heat_exchange", "solubility", "wall", "oil_compressibility"),
    "sensor": ("offset", "gain", "lag", "frame_compliance"),
}
TRUTH = {
    "piston_area": (4.02e-3, 3e-6, "m^2"),
    "gas_volume": (1.131e-3, 1.4e-6, "m^3"),
    "solubility_slope": (-2.4e-6, 4e-8, "mol/Pa"),
    "conduction": (5.6, 0.11, "W/K"),
    "coulomb_force": (182.0, 1.7, "N"),
    "friction_slope": (1150.0, 62.0, "s/m"),
    "pressure_friction": (4.2e-5, 1.3e-6, "N/Pa"),
    "damping": (913.0, 21.0, "N*s^2/m^2"),
    "breakaway": (137.0, 2.4, "N"),
    "stribeck_velocity": (5.9e-3, 1.2e-4, "m/s"),
    "offset[run a]": (0.4, 1.1, "N"),
    "offset[run b]": (-2.2, 1.2, "N"),
}


def oleo_tree(label: str = "run", description: str = "Shaker rig, made up.") -> xr.DataTree:
    """14 runs, force and pressure; breakaway friction found in the first of 2 rounds."""
    rng = np.random.default_rng(7)
    runs = [f"{label} {'abcdefghijklmn'[i]}" for i in range(14)]
    roles = [schema.HOLD_OUT if i in (4, 9, 12) else schema.FIT for i in range(14)]
    time, phase = _clock(runs, 4, 260)
    stroke, velocity = _motion(phase)
    channels = _oleo_channels(stroke, velocity, phase)
    missing = {
        "force": 137 * np.exp(-((velocity / 0.006) ** 2)) * np.sign(velocity),
        "pressure": 9e3 * np.sin(4 * np.pi * phase + 0.4),
    }
    noise = {name: NOISE[name] * rng.normal(size=time.shape) for name in missing}
    tree = _tree(runs, roles, time, phase, {"displacement": stroke}, channels, missing, noise)
    tree["residual"] = xr.DataTree(
        _with(tree["residual"], {"stroke": (stroke, "m"), "velocity": (velocity, "m/s")})
    )
    _add_posterior(tree, rng, runs, roles, channels)
    rounds = [
        _round(runs, roles, (7.3, 2.1), _candidates(rng, "Stribeck"), "Stribeck_friction"),
        _round(runs, roles, (1.02, 0.99), _candidates(rng, None), None),
    ]
    summary = _summary(rounds, ["Stribeck_friction"], schema.EFFECT_ADDED)
    _finish(tree, summary, description)
    return tree


def two_run_tree() -> xr.DataTree:
    """2 runs, one of them transient, 1 output, 1 round, nothing sampled, no effect added."""
    rng = np.random.default_rng(1)
    runs, roles = ["fit block", "transient"], [schema.FIT, schema.HOLD_OUT]
    time = np.tile(np.arange(900) / 600.0, (2, 1))
    phase = time * 2.0
    time[1, 700:] = phase[1, :] = phase[0, 800:] = time[0, 800:] = np.nan
    voltage = 0.05 * np.sin(2 * np.pi * 2 * time) * np.exp(-time * np.array([[0.0], [2.0]]))
    noise = {"voltage": 1e-4 * rng.normal(size=time.shape)}
    missing = {"voltage": 0.0 * voltage}
    channels = {"voltage": voltage}
    tree = _tree(runs, roles, time, phase, {}, channels, missing, noise, after=False)
    error = {
        runs[0]: _error(schema.FIT, 1.04e-4, 4.1e-5, 4e-5),
        runs[1]: {**_error(schema.HOLD_OUT, 1.1e-4, 1.0, 1.0), **dict.fromkeys(_REPEATING)},
    }
    one = {"error": {"voltage": error}, "candidates": [], "accepted": None}
    one["reason"] = "every ratio is below 1.15 and no candidate explains 10 % of the excess"
    parameters = {"stiffness": _parameter(1.0e3, 0.4, "N/m", sampled=False)}
    summary = _summary([one], [], schema.NOTHING_MISSING, parameters)
    tree["residual/voltage_noise"][1] = np.nan
    _add_point(tree, {"stiffness": (1.0e3, 0.4, "N/m")}, rng)
    _finish(tree, summary, "")
    return tree


_REPEATING = ("repeating", "noise", "ratio_to_noise")


def _clock(runs, periods, per_period):
    """Times and phases; every third run is shorter and padded with NaN."""
    count = periods * per_period
    frequency = np.array(FREQUENCIES)[:, None]
    phase = np.tile(np.arange(count) / per_period, (len(runs), 1))
    phase[::3, 3 * per_period :] = np.nan
    return phase / frequency, phase


def _motion(phase):
    amplitude = np.linspace(0.02, 0.055, len(phase))[::-1, None]
    rate = 2 * np.pi * np.array(FREQUENCIES)[:, None]
    angle = 2 * np.pi * phase
    return amplitude * np.sin(angle), amplitude * rate * np.cos(angle)


def _oleo_channels(stroke, velocity, phase):
    pressure = 6e5 * ((1 - stroke / 0.25) ** -1.3 - 0.2) + 2e4 * np.cos(2 * np.pi * phase)
    force = 4e-3 * pressure + 180 * np.tanh(velocity / 1e-3) + 900 * velocity * abs(velocity)
    return {"force": force, "pressure": pressure}


def _variable(values, unit, dims, name=""):
    return (dims, values, {"units": unit, "long_name": name})


def _with(node, more):
    dims = (schema.RUN, schema.SAMPLE)
    return node.to_dataset().assign(
        {name: _variable(values, unit, dims, name) for name, (values, unit) in more.items()}
    )


def _tree(runs, roles, time, phase, inputs, outputs, missing, noise, after=True):
    dims, by_run = (schema.RUN, schema.SAMPLE), {schema.RUN: runs}
    observed = {name: outputs[name] + missing[name] + noise[name] for name in outputs} | inputs
    data = {name: _variable(v, UNITS[name], dims, name) for name, v in observed.items()}
    data |= {"time": _variable(time, "s", dims), "phase": _variable(phase, "1", dims)}
    frequency = np.array([*FREQUENCIES, 2.0])[: len(runs)] if len(runs) > 2 else [2.0, np.nan]
    constant = {
        "frequency": _variable(frequency, "Hz", schema.RUN),
        "periods": (schema.RUN, np.full(len(runs), 4)),
        "role": (schema.RUN, roles),
        "group": (schema.RUN, ["middle"] * len(runs)),
        "initial_pressure": _variable(np.full(len(runs), 4.9e5), "Pa", schema.RUN),
    }
    sd = {
        name: _variable(np.nanstd(noise[name], axis=1), UNITS[name], schema.RUN) for name in noise
    }
    sd |= {name: _variable(np.full(len(runs), 5e-5), "m", schema.RUN) for name in inputs}
    prediction, residual = {}, {}
    for name in outputs:
        unit = UNITS[name]
        kinds = {"before": missing[name] + noise[name]} | ({"after": noise[name]} if after else {})
        for kind, e in kinds.items():
            prediction[f"{name}_{kind}"] = _variable(observed[name] - e, unit, dims)
            residual[f"{name}_{kind}"] = _variable(e, unit, dims)
            average = _average(phase, e)
            residual[f"{name}_{kind}_mean"] = _variable(average, unit, (schema.RUN, schema.PHASE))
        error = np.nanstd(noise[name], axis=1) / np.sqrt(8)
        residual[f"{name}_noise"] = _variable(error, unit, schema.RUN)
    return xr.DataTree.from_dict(
        {
            "records": xr.Dataset(data, coords=by_run),
            "constant_data": xr.Dataset(constant, coords=by_run),
            "noise": xr.Dataset(sd, coords=by_run),
            "prediction": xr.Dataset(prediction, coords=by_run),
            "residual": xr.Dataset(residual, coords={**by_run, schema.PHASE: PHASES}),
        }
    )


def _average(phase, values):
    """Averages over periods in bins of phase, NaN for a transient."""
    out = np.full((len(phase), PHASES.size), np.nan)
    for row, (p, v) in enumerate(zip(phase, values, strict=True)):
        keep = np.isfinite(p)
        if keep.any():
            index = np.floor(p[keep] % 1 * PHASES.size).astype(int)
            out[row] = np.bincount(index, v[keep], PHASES.size) / np.bincount(index)
    return out


def _add_posterior(tree, rng, runs, roles, channels):
    chains, draws, names = 24, 250, list(TRUTH)
    mean, sd = (np.array([TRUTH[name][i] for name in names]) for i in (0, 1))
    mixing = np.eye(len(names)) + 0.35 * rng.normal(size=(len(names), len(names)))
    mixing /= np.linalg.norm(mixing, axis=1, keepdims=True)
    z = rng.normal(size=(chains, draws, len(names))) @ mixing.T
    z += 0.08 * (z[..., :1] ** 2 - 1)
    theta = mean + sd * z
    coords = {"ensemble": ("chain", np.repeat([0, 1, 2, 3], 6))}
    draws_of = {
        name: (("chain", "draw"), theta[..., i], {"units": TRUTH[name][2]})
        for i, name in enumerate(names)
    }
    for output in channels:
        log_v = np.log(NOISE[output] ** 2) + 0.02 * rng.normal(size=(chains, draws))
        draws_of[f"log_variance_{output}"] = (("chain", "draw"), log_v)
    tree["posterior"] = xr.DataTree(xr.Dataset(draws_of, coords=coords))
    lp = -0.5 * (z**2).sum(axis=-1) - 4e4
    stats = xr.Dataset({"lp": (("chain", "draw"), lp)})
    stats.attrs = {
        "acceptance": 0.41,
        "autocorrelation_time": 9.3,
        "effective_sample_size": 1210.0,
        "rhat_nested": 1.004,
        "evaluations": 31_200,
        "failures": json.dumps({"inadmissible": 12, "no convergence": 0}),
    }
    tree["sample_stats"] = xr.DataTree(stats)
    _add_point(tree, TRUTH, rng)
    _add_predictive(tree, rng, runs, roles)


def _add_point(tree, truth, rng):
    names = list(truth)
    mean, sd = (np.array([truth[name][i] for name in names]) for i in (0, 1))
    path = mean * (1 + 0.3 * np.exp(-np.arange(9.0))[:, None])
    point = xr.Dataset(
        {
            "start": ("parameter", 1.3 * mean),
            "mbe": ("parameter", mean + 0.2 * sd),
            "estimate": ("parameter", mean + 0.1 * sd * rng.normal(size=len(names))),
            "sd": ("parameter", sd),
            "unit": ("parameter", [truth[name][2] for name in names]),
            "history": (("iteration", "parameter"), path),
            "objective": ("iteration", 4e4 + 1e6 * np.exp(-2.0 * np.arange(9))),
        },
        coords={"parameter": names},
        attrs={"status": "converged", "iterations": 8, "halvings": 1},
    )
    tree["point"] = xr.DataTree(point)


def _add_predictive(tree, rng, runs, roles):
    values = {}
    for output in ("force", "pressure"):
        mean = _average(tree["records/phase"].values, tree[f"prediction/{output}_after"].values)
        wave = np.sin(2 * np.pi * (PHASES + rng.random((4, 30, 14, 1))))
        spread = 0.15 * NOISE[output] * rng.normal(size=(4, 30, 14, 1)) * wave
        dims, about = ("chain", "draw", "run", "phase"), {"units": UNITS[output]}
        errors = NOISE[output] * rng.normal(size=spread.shape)
        values[output] = (dims, mean + spread + errors, about)
        values[f"{output}_expected"] = (dims, mean + spread, about)
        values[f"{output}_at_estimate"] = (dims[2:], mean, about)
        values[f"{output}_average_sd"] = (dims[:3], np.full((4, 30, 14), NOISE[output] / 3), about)
    coords = {"run": runs, "phase": PHASES}
    tree["period_predictive"] = xr.DataTree(xr.Dataset(values, coords=coords))


def _error(role, rms, repeating, noise):
    return {
        "role": role,
        "rms": rms,
        "repeating": repeating,
        "noise": noise,
        "ratio_to_noise": repeating / noise,
    }


def _round(runs, roles, ratios, candidates, accepted):
    error = {}
    for output, ratio in zip(NOISE, ratios, strict=True):
        noise, floor = NOISE[output], NOISE[output] / np.sqrt(8)
        error[output] = {}
        for i, (run, role) in enumerate(zip(runs, roles, strict=True)):
            own = 1 + (ratio - 1) * (0.4 + 0.1 * i) + 0.01 * (i % 5)
            rms = float(np.hypot(noise, own * floor))
            error[output][run] = _error(role, rms, float(own * floor), float(floor))
    reason = (
        "the error on the hold-out runs fell by 86 % and the posterior excludes the null"
        if accepted
        else "every ratio is below 1.15 and no candidate explains 10 % of the excess"
    )
    return {"error": error, "candidates": candidates, "accepted": accepted, "reason": reason}


def _candidates(rng, winner):
    names = [(f"{name}_friction", "friction") for name in FRICTION]
    names += [(name, family) for family, group in OTHERS.items() for name in group]
    candidates = []
    for name, family in names:
        first = winner is not None and name.startswith(winner)
        gain = 0.94 if first else float(rng.random() ** 2 * (0.45 if winner else 0.03))
        same = ["Stribeck_friction"] if name.startswith("Dahl") else ["Dahl_friction"]
        candidates.append(
            {
                "effect": name,
                "target": "force" if family == "sensor" else None,
                "family": family,
                "gain": 0.91 if winner and name.startswith("Dahl") else gain,
                "p_value": 0.0005 if gain > 0.3 else float(rng.random()),
                "expected": {"breakaway": 131.2} if first else {name: float(rng.normal())},
                "indistinguishable_from": same if name.startswith(("Dahl", "Stribeck")) else [],
            }
        )
    return sorted(candidates, key=lambda candidate: -candidate["gain"])


def _parameter(estimate, sd, unit, sampled=True):
    interval = [estimate - 1.96 * sd, estimate + 1.96 * sd]
    mean = estimate + 0.05 * sd if sampled else None
    entry = {"estimate": estimate, "mean": mean, "sd": sd, "unit": unit}
    return entry | {"interval": interval if sampled else None}


def _summary(rounds, effects, verdict, parameters=None):
    parameters = parameters or {name: _parameter(*truth) for name, truth in TRUTH.items()}
    summary = {
        "format": 1,
        "campaign": "made-up",
        "model": "f16n2d2",
        "drive": "displacement",
        "seed": 7,
        "hold_out": "runs marked hold-out in campaign.toml",
        "re_estimated": 0,
        "units": {output: UNITS[output] for output in rounds[0]["error"]},
        "rounds": rounds,
        "effects": effects,
        "parameters": parameters,
        "error_before": _by_role(rounds[0]["error"]),
        "error_after": _by_role(rounds[-1]["error"]),
        "verdict": verdict,
        "notes": ["run k: the first period was left out; it had not settled"],
    }
    schema.validate_summary(summary)
    return summary


def _by_role(error):
    table = {}
    for role in (schema.FIT, schema.HOLD_OUT):
        table[role] = {}
        for output, runs in error.items():
            own = [entry for entry in runs.values() if entry["role"] == role]
            table[role][output] = {
                key: _root_mean_square([entry[key] for entry in own])
                for key in ("rms", "repeating", "noise", "ratio_to_noise")
            }
    return table


def _root_mean_square(values):
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _finish(tree, summary, description):
    equations = "inertia + gas_spring + friction + damping = force\nfriction = F_c*sign(qdot)"
    tree.attrs = provenance(
        7,
        campaign=summary["campaign"],
        campaign_description=description,
        campaign_sha256="3f5a" * 16,
        model=summary["model"],
        drive="displacement",
        command="bayesoleo close made-up --model f16n2d2 --seed 7",
        equations=equations,
        equations_latex=[
            r"m \ddot{q} + A_p p_0 \left(\frac{T}{T_0}\right) \left(1 - \frac{A_p q}{V_0}\right)"
            r"^{-n} + \frac{2 F_c}{\pi} \operatorname{atan}{\left(b \dot{q} \right)} = F",
            r"\begin{cases} 1 & \text{for}\: q > 0 \\0 & \text{otherwise} \end{cases}",
        ],
        effects=summary["effects"],
        verdict=summary["verdict"],
        summary=summary,
    )
