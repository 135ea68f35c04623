"""Campaigns that are hostile: labels, paths, sizes and numbers that nobody should give.

Each takes the folder of a good campaign, ``rig`` with the model ``spring.py``, and spoils it. It
returns a command and what tells whether the result of that command is right.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bayesoleo._storage.result_files import read_tree

Right = Callable[[Path], bool]
Spoil = Callable[[Path], tuple[list[str], Right]]
FAST = ["--jobs", "1", "--quiet"]
ESTIMATE = ["estimate", "rig", "-m", "spring.py", "--out", "out", *FAST]
SIMULATE = ["simulate", "spring.py", "--like", "rig", "--out", "out", "--jobs", "1"]
#: The values with which the campaign was made.
TRUTH = {"damping": 5.0, "stiffness": 2e3}
LABELS = {
    "slash": "a/b",
    "up": "../../a",
    "dots": "..",
    "absolute": "/tmp/a",
    "backslash": "a\\b",
    "newline": "a\nb",
    "null": "a\0b",
    "unicode": "測定 µ 🛩️ \u202eab",
    "long": "r" * 300,
    "empty": "",
    "blank": " ",
    "markup": "<script>alert(1)</script> [bold]",
    "brackets": "a[b]",
    "reserved": "CON",
    "surrogate half": "a\\ud800",
}


def labelled(label: str, command: list[str]) -> Spoil:
    """A run of that name."""

    def spoil(folder: Path) -> tuple[list[str], Right]:
        written = json.dumps(label, ensure_ascii=False).replace("\\\\ud800", "\\ud800")
        change(folder, 'label = "slow"', f"label = {written}")
        return command, near_truth if command is ESTIMATE else lambda made: inside(made / "out")

    return spoil


def change(folder: Path, old: str, new: str) -> None:
    """Replace text of the declaration."""
    path = folder / "rig" / "campaign.toml"
    text = path.read_text(encoding="utf-8")
    if old not in text:
        raise ValueError(old)
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def near_truth(folder: Path) -> bool:
    """Whether the estimate lies within five standard deviations of the truth, or 2 %."""
    point = read_tree(folder / "out" / "results.nc")["point"].to_dataset()
    for name, truth in TRUTH.items():
        one = point.sel(parameter=name)
        if not abs(float(one.estimate) - truth) < max(5 * float(one.sd), 0.02 * truth):
            return False
    return True


def inside(folder: Path) -> bool:
    """Whether a campaign was written, and all its files are in its folder."""
    files = {item.name for item in folder.iterdir()}
    return "campaign.toml" in files and len(files) == 3


def scaled(factor: float, column: int) -> Spoil:
    """A column of very large or very small numbers."""

    def spoil(folder: Path) -> tuple[list[str], Right]:
        for file in (folder / "rig").glob("*.csv"):
            head, values = (
                file.read_text().splitlines()[0],
                np.loadtxt(file, delimiter=",", skiprows=1),
            )
            values[:, column] *= factor
            np.savetxt(file, values, delimiter=",", header=head, comments="", fmt="%.10g")
        return ESTIMATE, finite

    return spoil


def finite(folder: Path) -> bool:
    """Whether an estimate has numbers, and says that it went wrong where it has not converged."""
    point = read_tree(folder / "out" / "results.nc")["point"].to_dataset()
    numbers = [float(value) for value in point.estimate.values]
    return all(map(math.isfinite, numbers)) and bool(point.attrs["status_message"])


def many_columns(folder: Path) -> tuple[list[str], Right]:
    """A hundred thousand columns that nobody asked for."""
    file = folder / "rig" / "slow.csv"
    lines = file.read_text().splitlines()
    count = 100_000
    more = "," + ",".join(f"c{k}" for k in range(count))
    zeros = ",0" * count
    file.write_text("\n".join([lines[0] + more, *(line + zeros for line in lines[1:])]) + "\n")
    return ESTIMATE, near_truth


def many_channels(folder: Path) -> tuple[list[str], Right]:
    """As many columns, of which a thousand are declared as channels."""
    path, count = folder / "rig" / "campaign.toml", 1000
    declared = "".join(f'[channels.c{k}]\ncolumn = "c{k}"\nunit = "1"\n' for k in range(count))
    change(folder, "[[runs]]", declared + "\n[[runs]]")
    rng = np.random.default_rng(0)
    for name in ("slow", "fast"):
        file = path.with_name(f"{name}.csv")
        values = np.loadtxt(file, delimiter=",", skiprows=1)
        head = file.read_text().splitlines()[0] + "".join(f",c{k}" for k in range(count))
        more = rng.normal(size=(len(values), count))
        np.savetxt(
            file, np.hstack([values, more]), delimiter=",", header=head, comments="", fmt="%.6g"
        )
    return ESTIMATE, near_truth


def elsewhere(path: str) -> Spoil:
    """A run's file that is not in the campaign's folder."""

    def spoil(folder: Path) -> tuple[list[str], Right]:
        (folder / "slow.csv").write_bytes((folder / "rig" / "slow.csv").read_bytes())
        change(folder, '"slow.csv"', json.dumps(path.format(folder=folder)))
        return ESTIMATE, near_truth

    return spoil


def linked(folder: Path) -> tuple[list[str], Right]:
    """A link that leads to itself, in the place of a run's file."""
    (folder / "rig" / "slow.csv").unlink()
    os.symlink("slow.csv", folder / "rig" / "slow.csv")
    return ESTIMATE, near_truth


def to_folder(out: str) -> Spoil:
    """A folder of results that cannot be, or is a link."""

    def spoil(folder: Path) -> tuple[list[str], Right]:
        os.symlink("loop", folder / "loop")
        os.symlink("nowhere", folder / "dangling")
        (folder / "file").write_text("")
        arguments = [text if text != "out" else out for text in ESTIMATE]
        return arguments, lambda made: read_tree(made / out / "results.nc") is not None

    return spoil


INPUTS: dict[str, Spoil] = (
    {f"label {name}, estimated": labelled(label, ESTIMATE) for name, label in LABELS.items()}
    | {f"label {name}, simulated": labelled(label, SIMULATE) for name, label in LABELS.items()}
    | {
        f"{channel} times {factor:g}": scaled(factor, column)
        for channel, column in (("force", 1), ("displacement", 2))
        for factor in (1e300, 1e-300, 1e160, 1e-160)
    }
    | {"time times 1e300": scaled(1e300, 0), "time times 1e-300": scaled(1e-300, 0)}
    | {"100 000 columns": many_columns, "1 000 channels": many_channels}
    | {
        f"file {path}": elsewhere(path)
        for path in ("../slow.csv", "{folder}/slow.csv", "..", "/dev/zero", "/etc", "~/slow.csv")
    }
    | {"link to itself": linked}
    | {
        f"results to {out}": to_folder(out)
        for out in ("loop", "dangling", "file", "file/below", "/proc/a", "/dev/null", "a/../b")
    }
)
