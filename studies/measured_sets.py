"""Close the loop on the measured sets: the errors of each, and what was found.

Campaigns and models are those of ``studies/measured``; the data are found through
``BAYESOLEO_DATA``. What a set gives is kept in a folder, as ``<set>.json`` and the folder
``<set>``, and used again while neither the package nor the set's campaign and model have changed:

    python studies/measured_sets.py --only emps

measures one set; without ``--only`` all of them, with ``--store`` it writes the table
``studies/tables/measured.json``. A page of the gallery for a set reads
what is kept: run this first, and then the page with ``BAYESOLEO_STORE_FIGURES=1``. Keys are
explained in ``tests/benchmarks/measured.py``.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import bayesoleo as bo
from bayesoleo._workflow import Settings, close
from bayesoleo._workflow.simulating import model_of
from bayesoleo.effects import Scales, find_effect
from bayesoleo.gallery import print_added
from bayesoleo.model import Model
from bayesoleo.prediction._predictor import Predictor

ROOT = Path(__file__).resolve().parents[1]
STUDIES = ROOT / "studies" / "measured"
PSI, KIP = 6894.757293, 4448.2216
#: Where results are kept.
OUT = Path(tempfile.gettempdir()) / "bayesoleo-measured"

Figures = dict[str, float | str]


def rms(tree: xr.DataTree, output: str, *runs: str, stage: str = "after") -> float:
    """Root mean square of the residual over the samples of some runs, SI."""
    residual = tree["residual"].to_dataset()[f"{output}_{stage}"].sel(run=list(runs)).values
    return float(np.sqrt(np.nanmean(residual**2)))


def simulated(
    tree: xr.DataTree, campaign: Path, run: str, model: Model | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A run's measured output and its simulation at the estimate, by the final model or another.

    A start that the model does not declare is the measured one.
    """
    record = bo.load_campaign(campaign, progress=False).reduced.record(run)
    predictor = Predictor(model or model_of(tree), [record])
    point = tree["point"].to_dataset()
    known = dict(zip(point["parameter"].values, point["estimate"].values, strict=True))
    start = zip(predictor.layout.names, predictor.layout.start(predictor.model), strict=True)
    theta = np.array([known.get(name, value) for name, value in start])
    (status,) = predictor.set_anchor(theta)
    if not status.ok:
        raise RuntimeError(f"{campaign.name}, run {run}: {status.message}")
    (name,) = predictor.outputs
    return record.samples[name], predictor.simulate(theta[None], 0).y[0, 0]


def in_its_own_drive(tree: xr.DataTree, name: str) -> Model:
    """A set's model as declared, with the effects that were added, driven by its own inputs.

    Without effects of sensors, which were added to the model as the rig drives it.
    """
    model, driven = bo.load_model(STUDIES / name / "model.py"), model_of(tree)
    summary = json.loads(tree.attrs["summary"])
    scales = Scales(
        dict.fromkeys(model.dofs, (0.0, 1.0)), dict.fromkeys(model.dofs, 1.0), {}, 1.0, 1.0
    )
    for effect, target in zip(summary["effects"], summary["targets"], strict=True):
        if not find_effect(effect).on_channels:
            model = find_effect(effect).extend(model, target, scales).model
    # Constants, such as a largest velocity, are those of the fit.
    values = {key: item.value for key, item in driven.parameters.items() if key in model.parameters}
    return model.with_values(values)


def silverbox(tree: xr.DataTree) -> Figures:
    """Simulations of the other file, with the offset of the sensor that the result states.

    The output drifts by 0.05 mV. The mean of each run is therefore an unknown of its own, and a
    simulation has none. The offset, 0.7 mV, differs by less than 0.1 mV between both files.
    """
    offset = float(bo.Fit(tree).offsets.loc["output_voltage", "offset"])
    folder = STUDIES / "silverbox" / "snls"
    measured, predicted = simulated(tree, folder, "arrow")
    # Beyond the first sample that is larger than all of the estimation data it extrapolates.
    largest = np.nanmax(np.abs(tree["records"].to_dataset()["output_voltage"].values))
    first = int(np.argmax(np.abs(measured) > largest)) or measured.size
    error = 1e3 * (measured - predicted - offset)
    several, of_several = simulated(tree, folder, "multisine")
    of_several = of_several + offset
    return {
        "silverbox_arrow_mV": float(np.sqrt(np.mean(error**2))),
        "silverbox_arrow_inside_mV": float(np.sqrt(np.mean(error[:first] ** 2))),
        "silverbox_multisine_mV": 1e3 * float(np.sqrt(np.mean((several - of_several) ** 2))),
        "silverbox_offset_mV": 1e3 * offset,
    }


def emps(tree: xr.DataTree) -> Figures:
    """Force by position, and position by force."""
    found: Figures = {
        "emps_fit_N": rms(tree, "force", "trajectory"),
        "emps_pulses_N": rms(tree, "force", "pulses"),
    }
    try:
        own = in_its_own_drive(tree, "emps")
        measured, predicted = simulated(tree, STUDIES / "emps", "pulses", own)
    except Exception as error:  # the other figures stand without it
        return {**found, "emps_failed": f"position: {error}"[:200]}
    return {**found, "emps_position_mm": 1e3 * float(np.sqrt(np.mean((measured - predicted) ** 2)))}


def cascaded_tanks(tree: xr.DataTree) -> Figures:
    """Level, with the start of each run estimated on it."""
    return {
        "tanks_estimation_V": rms(tree, "level", "estimation"),
        "tanks_validation_V": rms(tree, "level", "validation"),
    }


def brfd(tree: xr.DataTree) -> Figures:
    """Force of the hold-out run."""
    return {"brfd_holdout_kip": rms(tree, "force", "1 Hz 1 in") / KIP}


def single_pendulum(tree: xr.DataTree) -> Figures:
    """Angle, with the start of each run estimated on it."""
    held = rms(tree, "angle", "validation 1", "validation 2")
    return {"pendulum_validation_mrad": 1e3 * held}


def mr_damper(tree: xr.DataTree) -> Figures:
    """Force of both hold-out runs."""
    return {"mr_damper_holdout_N": max(rms(tree, "force", run) for run in ("3", "7"))}


def mbari_gas_spring(tree: xr.DataTree) -> Figures:
    """Pressure of both halves of the record."""
    return {
        "mbari_fit_psi": rms(tree, "pressure", "before 205 s") / PSI,
        "mbari_holdout_psi": rms(tree, "pressure", "after 205 s") / PSI,
    }


#: By set what is measured; the name of the set begins other keys.
SETS: dict[str, Callable[[xr.DataTree], Figures]] = {
    item.__name__: item
    for item in (silverbox, emps, cascaded_tanks, brfd, single_pendulum, mr_damper,
                 mbari_gas_spring)
}  # fmt: skip
SHORT = {
    "cascaded_tanks": "tanks",
    "single_pendulum": "pendulum",
    "mbari_gas_spring": "mbari",
}


def closed(name: str, out: Path, jobs: int = 2) -> xr.DataTree:
    """What ``close --quick`` computes and writes."""
    model = bo.load_model(STUDIES / name / "model.py")
    return close(STUDIES / name, model, Settings(seed=0, quick=True, jobs=jobs), out=out)


def measure(name: str, out: Path = OUT, jobs: int = 2) -> Figures:
    """Close the loop on one set; its result is kept in a folder, as the command leaves it."""
    shutil.rmtree(out / name, ignore_errors=True)  # what goes on from a search takes less time
    begin, worked = time.perf_counter(), time.process_time()
    tree = closed(name, out / name, jobs)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - worked
    summary = json.loads(tree.attrs["summary"])
    short = SHORT.get(name, name)
    rounds = summary["rounds"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    try:
        found = SETS[name](tree)
    except Exception as error:  # a run that cannot be simulated is a result of the set
        found = {f"{short}_failed": str(error)[:200]}
    return {
        **found,
        f"{short}_first_effect": rounds[0]["accepted"] or "",
        f"{short}_effects": ", ".join(summary["effects"]),
        f"{short}_found": found_in(summary),
        f"{short}_certainty": summary["certainty"] or "",
        f"{short}_seconds": seconds,
        f"{short}_cpu_seconds": cpu,
        f"{short}_memory_GB": peak,
    }


def found_in(summary: Mapping[str, Any]) -> str:
    """The effects that were added, with 95 % intervals of their parameters; empty for none."""
    if not summary["effects"]:
        return ""
    caught = io.StringIO()
    with contextlib.redirect_stdout(caught):
        print_added(summary)
    return caught.getvalue().rstrip()


def version(name: str) -> str:
    """Checksum of the package, the campaign and the model."""
    total = hashlib.sha256()
    own = (STUDIES / name).rglob("*.*")
    for path in sorted((*(ROOT / "bayesoleo").rglob("*.py"), *own)):
        if path.suffix in (".py", ".toml"):
            total.update(path.read_bytes())
    return total.hexdigest()


def kept(name: str, out: Path = OUT, jobs: int = 2) -> Figures:
    """A set's figures as kept, or from a process of its own, whose memory is given back."""
    file, expected = out / f"{name}.json", version(name)
    stored = json.loads(file.read_text()) if file.is_file() else {}
    if stored.get("version") != expected:
        print(f"measure {name}", file=sys.stderr, flush=True)
        command = [sys.executable, __file__, "--one", name, "--out", str(out), "--jobs", str(jobs)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["killed"])[-1]
            return {f"{SHORT.get(name, name)}_failed": last[:200]}
        figures = json.loads(done.stdout.splitlines()[-1])
        stored = {"version": expected, "figures": figures}
        file.write_text(json.dumps(stored, indent=1), encoding="utf-8")
    return dict(stored["figures"])


def tree_of(name: str, out: Path = OUT) -> xr.DataTree:
    """The result of a set, which is kept."""
    kept(name, out)
    return bo.load_result(out / name / "results.nc").tree


def all_kept(names: Sequence[str], out: Path, jobs: int) -> Figures:
    """Figures of some sets, one after the other."""
    out.mkdir(parents=True, exist_ok=True)
    found: Figures = {}
    for name in names:
        found |= kept(name, out, jobs)
    return found


def _short(figures: Mapping[str, float | str]) -> Figures:
    return {
        key: round(value, 4) if isinstance(value, float) else value
        for key, value in figures.items()
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=list(SETS), choices=SETS, metavar="SET")
    parser.add_argument("--out", type=Path, default=OUT, help="folder of kept results")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="threads")
    parser.add_argument("--store", action="store_true", help="write studies/tables/measured.json")
    parser.add_argument("--one", choices=SETS, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        print(json.dumps(_short(measure(chosen.one, chosen.out, chosen.jobs))))
        return
    found = all_kept(chosen.only, chosen.out, chosen.jobs)
    for key, value in found.items():
        print(f"{key:28} {value}")
    if chosen.store:
        command = f"python studies/{Path(__file__).name} --store"
        table = {"command": command, "version": bo.__version__, "figures": found}
        text = json.dumps(table, indent=1, ensure_ascii=False) + "\n"
        (ROOT / "studies" / "tables" / "measured.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
