"""Measure the coverage of intervals, what honest error models cost, and how often probabilities of
structures are right.

Run with ``python tests/benchmarks/structures.py --json`` for one flat object, or without ``--json``
for a table; the keys are explained in the files that measure them, :mod:`structures_coverage`,
:mod:`structures_nuisance` and :mod:`structures_round`. Those of probabilities come from the stored
tables of ``studies/structure_probabilities.py``, with their commands, seeds and versions.
``--count`` is the number of campaigns of each question, ``--only`` names keys.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import structures_coverage as coverage
import structures_nuisance as nuisance
import structures_round

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
import structure_figures

from bayesoleo._workflow.model_files import load_model
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.simulating import demo_campaign
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._signatures import noise_of, signatures_of
from bayesoleo.posterior import LogDensity
from bayesoleo.posterior._laplace import start_coordinates

SEED = 20261122
#: Vectors of one timing, and timings of which the quickest counts.
ROWS, REPEATS = 64, 7


def density_ratio(count: int) -> dict[str, float]:
    """Time of the log density with the catalogue over independent errors, on the demonstration."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(jobs=1)
        path = demo_campaign(Path(folder) / "campaign")
        task = prepare(path, load_model("f16n2d2"), settings)
        fit = fit_model(task.assembly.model(), task.roles.fitted, settings.numerics)
    fit.problem.signatures = signatures_of(fit, task.assembly, noise_of(fit), jobs=1)
    spent = {}
    for word in ("independent", "catalogue"):
        density = LogDensity(fit.problem, errors=word)
        phi = start_coordinates(density, fit.point.theta)
        rng = np.random.default_rng(SEED)
        rows = phi + 1e-3 * rng.standard_normal((ROWS, phi.size))
        density(rows)
        times = []
        for _ in range(REPEATS):
            begin = time.process_time()
            density(rows)
            times.append(time.process_time() - begin)
        spent[word] = min(times)
    return {"density_ratio": spent["catalogue"] / spent["independent"]}


#: Keys of the stored study of probabilities.
PROBABILITIES = ("calibration_error", "brier_ratio", "sure_and_wrong", "outside_called_outside")


def probabilities(_: int) -> dict[str, float | str]:
    """Reliability of probabilities of structures, from the stored tables: of effects drawn from
    the whole catalogue, and as ``..._sixteen`` of sixteen usual ones."""
    kept: dict[str, float | str] = {}
    for draw, end in ((structure_figures.CATALOGUE, ""), (structure_figures.SIXTEEN, "_sixteen")):
        table = structure_figures.stored(draw)
        if table is None:
            continue
        for key, value in structure_figures.figures(table["rows"]).items():
            if key.endswith("_by_mix"):
                kept[key] = value
            elif key in PROBABILITIES or key.startswith(("statements_", "said_", "true_")):
                kept[key + end] = value
        for key in ("campaigns", "failed", "command", "seed", "version"):
            kept[f"structure_{key}{end}"] = table[key]
    return kept


#: What is measured, by the keys that it gives.
MEASURED: dict[tuple[str, ...], Callable[[int], Mapping[str, float | str]]] = {
    ("coverage_inside",): lambda count: coverage.inside(count, SEED),
    ("coverage_outside",): lambda count: coverage.outside(count, SEED),
    ("coverage_plain", "width_plain"): lambda count: coverage.plain(count, SEED),
    ("coverage_coloured",): lambda count: coverage.coloured(count, SEED),
    ("coverage_prediction",): lambda count: coverage.prediction(count, SEED),
    tuple(
        f"{key}_{word}"
        for word in coverage.WORDS
        for key in ("coverage_inside", "coverage_outside", "width_inside")
    ): lambda count: coverage.side_by_side(count, SEED),
    ("density_ratio",): density_ratio,
    ("round_ratio",): structures_round.round_ratio,
    ("nuisance_named", "nuisance_significant"): lambda count: nuisance.figures(
        min(count / (3 * nuisance.EACH), 1.0), lambda text: print(text, file=sys.stderr)
    ),
    PROBABILITIES: probabilities,
}


def _short(value: float | str) -> float | str:
    return round(value, 4) if isinstance(value, float) else value


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat object")
    parser.add_argument("--count", type=int, default=300, help="campaigns of each question")
    parser.add_argument("--only", nargs="+", default=[], metavar="KEY")
    chosen = parser.parse_args()
    found: dict[str, float | str] = {}
    for keys, measure in MEASURED.items():
        if chosen.only and not set(keys) & set(chosen.only):
            continue
        print(f"measure {', '.join(keys)}", file=sys.stderr)
        found |= measure(chosen.count)
    if chosen.json:
        print(json.dumps({key: _short(value) for key, value in found.items()}))
        return
    for key, value in found.items():
        print(f"{key:24} {_short(value)}")


if __name__ == "__main__":
    main()
