"""The campaigns of ``identification.py``: six runs of a shock strut, as a rig would record them.

What a model lacks shows apart where runs differ. So they go from a creep, where friction is all
there is, over one that takes most of the stroke, to one where damping is felt, and lie at either
end of the stroke as well as in its middle.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from typing import Any

import numpy as np

from bayesoleo._workflow.simulating import to_simulated_run
from bayesoleo.data import ReducedCampaign, load_campaign, reduce_campaign, write_campaign
from bayesoleo.model import Model
from bayesoleo.prediction import RunPlan, motion, simulate_run

SYSTEM, DRIVE = "f16n2d2", "displacement"
NOISE = {"displacement": 5e-5, "force": 20.0, "pressure": 5e3}
CHANNELS = {"displacement": ("x_mm", "mm"), "force": ("F_kN", "kN"), "pressure": ("p_bar", "bar")}
#: Label, frequency in Hz, mean and amplitude of the stroke in m, role.
RUNS = (
    ("a", 0.02, 0.13, 0.015, "fit"),
    ("b", 0.1, 0.13, 0.110, "fit"),
    ("c", 1.0, 0.05, 0.040, "fit"),
    ("d", 3.0, 0.19, 0.030, "fit"),
    ("e", 0.2, 0.13, 0.080, "hold-out"),
    ("f", 2.0, 0.10, 0.030, "hold-out"),
)
UNITS = {"initial_pressure": "Pa", "ambient_temperature": "K"}
PERIODS, PER_PERIOD = 4.3, 250.4
#: Steps that data are simulated with: what the mesh changes stays far below the noise.
STEPS = 4096


def simulated(
    model: Model, values: dict[str, Any], seed: int, frame: float = 0.0
) -> ReducedCampaign:
    """Six runs of a model driven by displacement, as they are written to files and read again.

    A value of six numbers has one for each run; the displacement measured is larger than the
    strut's by what a frame gives under the force, metres a newton.
    """
    # Settings are those of the rig, the same in all campaigns: only noise differs between them.
    rig, rng, runs = np.random.default_rng(1993), np.random.default_rng([seed, 1993]), []
    for k, (label, frequency, mean, amplitude, role) in enumerate(RUNS):
        distorted = [amplitude, 0.01 * amplitude, 0.005 * amplitude]
        stroke = motion(mean, distorted, rig.uniform(0, 6, 3))
        pressure = 4.9e5 * (1 + 0.015 * rig.standard_normal())
        plan = RunPlan(
            label,
            frequency * (1 + 0.002 * rig.standard_normal()),
            {DRIVE: stroke},
            {"initial_pressure": pressure, "ambient_temperature": 293.0},
            periods=PERIODS,
            samples_per_period=PER_PERIOD,
            role=role,
        )
        own = {n: float(v[k]) if np.ndim(v) else float(v) for n, v in values.items()}
        run = simulate_run(model, plan, own, steps=STEPS)
        samples = dict(run.samples)
        samples[DRIVE] = samples[DRIVE] + frame * samples["force"]
        for name, x in samples.items():
            samples[name] = x + NOISE[name] * rng.standard_normal(x.size)
        runs.append(to_simulated_run(replace(run, samples=samples), UNITS))
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(
            folder, name="study", channels=CHANNELS, runs=runs, controlled=DRIVE, overwrite=True
        )
        return reduce_campaign(load_campaign(folder), jobs=1)
