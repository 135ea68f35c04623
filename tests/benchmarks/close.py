"""Close the loop on the reference jobs and print the error before and after, as in the README.

Run as ``python tests/benchmarks/close.py [--json] [--job NAME …]``. The data are found through
``BAYESOLEO_DATA``. Beside the errors stand the marks that were set beforehand, what was reached and
whether that is enough, and the new parameters' posteriors. Times are those of this machine now.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesoleo._workflow.closing import close
from bayesoleo._workflow.model_files import load_model
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.data import dataset_folder
from bayesoleo.discovery._state import fit_state
from bayesoleo.model import Parameter
from bayesoleo.plots._discovery import chosen
from bayesoleo.systems import system

MEASURED = Path(__file__).parents[2] / "studies" / "measured"

PSI = 6894.757


@dataclass(frozen=True)
class Job:
    """What is closed, and which marks were set for it.

    Parameters
    ----------
    model, drive : str or None
        Of a simulated campaign; measured ones bring a model file and declare their drive.
    effect : str or None
        What the data have and the model lacks, empty if that is nothing; None where no one knows.
    ratio : float or None
        Largest pooled ratio to the noise on the runs held out.
    """

    model: str | None = None
    drive: str | None = None
    effect: str | None = None
    ratio: float | None = None


def simulated(effect: str) -> Job:
    """A campaign of the thermo-mechanical oleo, driven by what the rig controls."""
    return Job("f16n2d2", "displacement", effect, 1.15)


JOBS = {
    "silverbox": Job(effect="cubic_stiffness"),
    "mr_damper": Job(effect="dahl_friction"),
    "mbari_gas_spring": Job(effect="heat_exchange"),
    "shaker-plain f16n2d2": simulated(""),
    "shaker-plain f16n1d2": Job("f16n1d2", "displacement"),
    "shaker-plain f16n2d1 by force": Job("f16n2d1", "model"),
    "shaker-wall f16n2d2": simulated("wall_heat_capacity"),
    "shaker-breakaway f16n2d2": simulated("stribeck_friction"),
    "shaker-fast-rebound f16n2d2": simulated("direction_dependent_damping"),
    "shaker-compliance f16n2d2": simulated("frame_compliance"),
}


def run(name: str, quick: bool) -> dict[str, Any]:
    """Close the loop on one job and collect what the table shows."""
    job, begin = JOBS[name], time.perf_counter()
    if job.model is None:
        campaign, model = MEASURED / name, load_model(f"{MEASURED / name / 'model.py'}:model")
    else:
        campaign, model = dataset_folder(name.split()[0]), system(job.model)
    settings = Settings(drive=job.drive, quick=quick)
    summary = json.loads(close(campaign, model, settings, progress=True).attrs["summary"])
    seconds = time.perf_counter() - begin
    found = {
        "verdict": summary["verdict"],
        "effects": summary["effects"],
        "before": summary["error_before"]["hold-out"],
        "after": summary["error_after"]["hold-out"],
        "by_run": summary["rounds"][-1]["error"],
        "parameters": new_parameters(summary),
        "hold_out": f"{summary['hold_out']}; parameters of single runs estimated there:"
        f" {summary['re_estimated']}",
        "notes": summary["notes"],
        "seconds": seconds,
    }
    marks = [*common_marks(job, summary)]
    if name in OWN_MARKS:
        marks += OWN_MARKS[name](summary)
    return found | {"marks": [mark._asdict() for mark in marks]}


def new_parameters(summary: Mapping[str, Any]) -> dict[str, str]:
    """Posterior of every parameter that an effect brought: mean, sd and 95 % interval, SI."""
    known = {key.split("[")[0] for entry in summary["rounds"]
             for key in (chosen(entry) or {}).get("expected", {})}  # fmt: skip
    texts = {}
    for name, entry in summary["parameters"].items():
        if name.split("[")[0] in known and entry["interval"] is None:
            texts[name] = f"{entry['mean']:.4g} {entry['unit']}, shared with {entry['shared_with']}"
        elif name.split("[")[0] in known:
            low, high = entry["interval"]
            texts[name] = (
                f"{entry['mean']:.4g} ± {entry['sd']:.2g} {entry['unit']} ({low:.4g} … {high:.4g})"
            )
    return texts


class Mark(NamedTuple):
    """What was asked for, what was reached, and whether that is enough."""

    what: str
    reached: str
    enough: bool


def common_marks(job: Job, summary: Mapping[str, Any]) -> Iterator[Mark]:
    """The effect, first or in the first class, and the ratio on the runs held out."""
    added = chosen(summary["rounds"][0])
    if job.effect == "":
        names = ", ".join(summary["effects"]) or "nothing"
        yield Mark("nothing is added", names, not summary["effects"])
    elif job.effect is not None:
        first = [added["effect"], *added["indistinguishable_from"]] if added else []
        yield Mark(f"{job.effect} first", " ≈ ".join(first) or "nothing", job.effect in first)
    if job.ratio is not None:
        worst = max(e["ratio_to_noise"] for e in summary["error_after"]["hold-out"].values())
        yield Mark(f"ratio ≤ {job.ratio} on hold-out", f"{worst:.3f}", worst <= job.ratio)


def silverbox_marks(summary: Mapping[str, Any]) -> list[Mark]:
    """Of the block held out, mV."""
    left = 1e3 * summary["error_after"]["hold-out"]["output_voltage"]["repeating"]
    return [Mark("repeating ≤ 0.39 mV on hold-out", f"{left:.3f}", left <= 0.39)]


def mr_damper_marks(summary: Mapping[str, Any]) -> list[Mark]:
    """Of each run held out, N."""
    runs = summary["rounds"][-1]["error"]["force"]
    left = [runs[label]["rms"] for label in ("3", "7")]
    return [Mark("rms ≤ 9 N on each run held out", " and ".join(f"{x:.1f}" for x in left),
                 max(left) <= 9.0)]  # fmt: skip


def mbari_marks(summary: Mapping[str, Any]) -> list[Mark]:
    """Of both halves, psi; the isothermal gas is estimated besides."""
    folder = MEASURED / "mbari_gas_spring"
    model = load_model(f"{folder / 'model.py'}:model")
    constant = model.with_parameters(gas_exponent=Parameter(1.0, fixed=True))
    task = prepare(folder, constant, Settings())
    stages = {
        "isothermal": fit_state(task.assembly, task.roles, Settings().numerics).by_role,
        "polytropic": summary["error_before"],
        "after": summary["error_after"],
    }
    limits = {"isothermal": (np.inf, np.inf), "polytropic": (np.inf, np.inf), "after": (0.5, 0.75)}
    marks = []
    for stage, table in stages.items():
        for role, limit in zip(("fit", "hold-out"), limits[stage], strict=True):
            left = table[role]["pressure"]["rms"] / PSI
            what = f"{stage}, {role}, psi" + (f" ≤ {limit}" if np.isfinite(limit) else "")
            marks.append(Mark(what, f"{left:.2f}", bool(left <= limit)))
    return marks


OWN_MARKS = {
    "silverbox": silverbox_marks,
    "mr_damper": mr_damper_marks,
    "mbari_gas_spring": mbari_marks,
}


def row(job: str, result: Mapping[str, Any]) -> str:
    """One line of the table; SI units."""

    def cells(table: dict) -> str:
        parts = [
            f"{output}: rms {v['rms']:.3g}, repeating {v['repeating']:.3g},"
            f" ratio {v['ratio_to_noise']:.2f} (to what is expected {v['ratio_to_expected']:.2f})"
            for output, v in table.items()
        ]
        return "; ".join(parts)

    found = ", ".join(result["effects"]) or "none"
    marks = "; ".join(
        f"{m['what']}: {m['reached']}{'' if m['enough'] else ' (missed)'}" for m in result["marks"]
    )
    new = "; ".join(f"{name} = {text}" for name, text in result["parameters"].items())
    return (
        f"| {job} | {cells(result['before'])} | {cells(result['after'])} |"
        f" {found} | {new} | {marks} | {result['verdict']} | {result['seconds']:.0f} s |"
    )


def main() -> None:
    """Run the jobs asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--job", action="append", choices=list(JOBS), help="by default all")
    parser.add_argument("--full", action="store_true", help="sample to the default effective size")
    options = parser.parse_args()
    results = {}
    if not options.json:
        print(
            "| job | before, hold-out | after, hold-out | effects | posterior | marks | verdict"
            " | time |"
        )
        print(8 * "|---" + "|")
    for job in options.job or list(JOBS):
        results[job] = run(job, not options.full)
        if not options.json:
            print(row(job, results[job]), flush=True)
    if options.json:
        print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
