"""How often a probability of a structure is right: simulated campaigns of six kinds of system.

A quarter lacks nothing; the others lack one effect of the catalogue, two, or a law that the
catalogue does not have, at one to ten times the detection limit. Systems, motions and noise are
drawn by the benchmarks' own simulator, which shares no code with the package. Rows go to a file as
they come, so that a run that was stopped goes on, and parts can be run side by side:

    python studies/structure_probabilities.py rows.jsonl --part 1/2 --campaigns 1000

``--store`` writes the table that the gallery shows.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "benchmarks"))
import truth_effects as truth
from truth_systems import KINDS, Extra, Plan, Sizes, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._state import fit_state
from bayesoleo.discovery._structure_search import structure_posterior
from bayesoleo.errors import BayesoleoError

#: What a campaign may lack, in turn.
CLASSES = ("nothing", "one", "one", "two", "outside", "one", "nothing", "outside")
#: Sizes in detection limits.
LEAST, MOST = 1.0, 10.0
#: Probabilities below this are not kept.
KEPT = 0.01
OUTSIDE = "outside"
#: Bands of probabilities in which statements are held against the truth.
BANDS = ((0.5, 0.8), (0.8, 0.95), (0.95, 1.0001))
TABLE = Path(__file__).resolve().parent / "tables" / "structures.json"


def _ripple(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    return Extra(lambda x, v, t, z: sizes.force * np.sin(5.0 * (x - sizes.mean) / sizes.position))


def _grip(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    """Resists more where the stroke is near its middle, whatever the speed's size."""
    return Extra(
        lambda x, v, t, z: (
            sizes.force
            * np.exp(-8.0 * ((x - sizes.mean) / sizes.position) ** 2)
            * np.tanh(3.0 * v / sizes.velocity)
        )
    )


def _memory(sizes: Sizes, _: Mapping[str, float]) -> Extra:
    """Follows the square of a slow average of the position."""
    rate = 2.0 * np.pi * sizes.frequency / 3.0
    return Extra(
        lambda x, v, t, z: sizes.force * z[0] * np.abs(z[0]),
        lambda x, v, t, z: rate * ((x - sizes.mean) / sizes.position - z),
        states=1,
    )


STRANGE = {"ripple": _ripple, "grip": _grip, "memory": _memory}
PLACES = {"linear": "position", "duffing": "position", "two dofs": "first_position"}


def case_of(number: int, rng: np.random.Generator) -> tuple[str, truth.Case]:
    """What campaign ``number`` lacks, and the case that makes it."""
    what = CLASSES[number % len(CLASSES)]
    if what == "nothing":
        return what, truth.Case(str(rng.choice(list(KINDS))), ())
    if what == OUTSIDE:
        name = str(rng.choice(list(STRANGE)))
        kind = str(rng.choice([kind for kind in KINDS if kind != "thermal"]))
        return what, truth.Case(kind, (truth.Missing(name, OUTSIDE, STRANGE[name]),))
    cases = truth.singles() if what == "one" else truth.pairs()
    return what, cases[int(rng.integers(len(cases)))]


def run(number: int) -> dict[str, Any]:
    """Simulate one campaign and compare structures on it."""
    rng = np.random.default_rng([number, 1414])
    what, case = case_of(number, rng)
    seed, sizes = 20000 + number, np.zeros(0)
    # Sizes need not be met exactly: what they came to is kept.
    truth.LEAST, truth.MOST, truth.TRIES = LEAST, MOST, 2
    row: dict[str, Any] = {"number": number, "what": what, "case": case.name, "kind": case.kind}
    try:
        if what == "nothing":
            transient = bool(rng.integers(8) == 0)
            made = make(case.kind, seed, plan=Plan(transient=transient, weak=bool(rng.integers(2))))
        else:
            made, sizes = truth.sized(case, seed, rng)
    except (BayesoleoError, RuntimeError) as error:
        return row | {"failed": str(error).splitlines()[0]}
    begin = time.process_time()
    task = prepare(made.campaign, made.model, Settings(jobs=1))
    state = fit_state(task.assembly, task.roles, truth.NUMERICS)
    base = state.base()
    scores, failed = score_candidates(base, state.assembly, None, 1)
    middle = time.process_time()
    errors = {(entry.run, entry.output): entry for entry in state.fit_errors.entries}
    found = structure_posterior(base, state.assembly, scores, errors, truth.NUMERICS)
    end = time.process_time()
    twins = {}
    for name, reason in failed.items():
        if reason.endswith("in other words"):
            effect, target = name.split(" at ")
            other = reason.removeprefix("the same as ").removesuffix(" in other words")
            twins[f"{effect} @ {target}"] = f"{other} @ {target}"
    names = [f"{item.effect} @ {item.target}" for item in case.missing if what != OUTSIDE]
    return row | {
        "truth": [twins.get(name, name) for name in names],
        "sizes": [round(float(size), 2) for size in sizes],
        "nothing": found.nothing,
        "outside": found.outside,
        "only_outside": found.only_outside,
        "effects": {f"{e} @ {t}": p for (e, t), p in found.effects.items() if p > KEPT},
        "best": [
            [[f"{e} @ {t}" for e, t in s.effects], s.outside, s.probability]
            for s in found.structures[:5]
        ],
        "ratio": state.worst_ratio,
        "score_seconds": middle - begin,
        "seconds": end - middle,
    }


def statements(row: Mapping[str, Any]) -> list[tuple[float, bool]]:
    """Each thing that is said of a campaign with its probability, and whether it is true."""
    said = [
        (row["nothing"], row["what"] == "nothing"),
        (row["only_outside"], row["what"] == OUTSIDE),
    ]
    return said + [(p, name in row["truth"]) for name, p in row["effects"].items()]


def brier(row: Mapping[str, Any]) -> tuple[float, float]:
    """Brier score of the probabilities, and of the most probable structure taken for certain."""
    effects, outside, _ = row["best"][0]
    truth = {"nothing": row["what"] == "nothing", OUTSIDE: row["what"] == OUTSIDE}
    truth |= dict.fromkeys(row["truth"], True)
    said = {"nothing": row["nothing"], OUTSIDE: row["only_outside"], **row["effects"]}
    taken = dict.fromkeys(effects, 1.0) or {OUTSIDE if outside else "nothing": 1.0}
    names = {*truth, *said, *taken}
    scores = [
        sum((given.get(name, 0.0) - truth.get(name, False)) ** 2 for name in names)
        for given in (said, taken)
    ]
    return scores[0], scores[1]


def log_score(row: Mapping[str, Any]) -> float:
    """Mean of minus the logarithm of the probability given to what is true of each statement."""
    said = statements(row)
    chances = [p if true else 1.0 - p for p, true in said]
    return float(-np.mean(np.log(np.maximum(chances, 1e-6))))


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Reliability of all statements, and how campaigns with something outside are called."""
    done = [row for row in rows if "failed" not in row]
    said = np.array([item for row in done for item in statements(row)], dtype=float)
    table: dict[str, float] = {
        "structure_campaigns": len(done),
        "structure_failed": len(rows) - len(done),
    }
    errors = []
    for low, high in BANDS:
        band = said[(said[:, 0] >= low) & (said[:, 0] < high)]
        key = f"{low:g}_to_{min(high, 1.0):g}"
        table[f"statements_{key}"] = len(band)
        if len(band):
            table[f"said_{key}"], table[f"true_{key}"] = map(float, band.mean(axis=0))
            errors.append(abs(float(band[:, 0].mean() - band[:, 1].mean())))
    table["calibration_error"] = max(errors, default=float("nan"))
    table["sure_and_wrong"] = 1.0 - table.get(f"true_{BANDS[-1][0]:g}_to_1", float("nan"))
    scores = np.array([brier(row) for row in done])
    table["brier"], table["brier_winner"] = map(float, scores.mean(axis=0))
    table["brier_ratio"] = table["brier"] / table["brier_winner"]
    table["log_score"] = float(np.mean([log_score(row) for row in done]))
    strange = [row["outside"] > 0.5 for row in done if row["what"] == OUTSIDE]
    table["outside_called_outside"] = float(np.mean(strange)) if strange else float("nan")
    table["structure_seconds"] = float(np.mean([row["seconds"] for row in done]))
    return table


def store(rows: Sequence[Mapping[str, Any]], campaigns: int) -> None:
    """Write the compact table: a campaign a line."""
    kept = sorted((row for row in rows if "failed" not in row), key=lambda row: row["number"])
    head = {
        "command": f"python {Path(__file__).name} FILE --campaigns {campaigns} --store",
        "version": version("bayesoleo"),
        "failed": len(rows) - len(kept),
    }
    lines = ",\n".join(json.dumps(_brief(row)) for row in kept)
    text = json.dumps(head)[:-1] + f', "rows": [\n{lines}\n]}}\n'
    TABLE.write_text(text, encoding="utf-8")


def _brief(value: Any) -> Any:
    """The same with four digits."""
    if isinstance(value, dict):
        return {key: _brief(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_brief(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a file of results."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def main() -> None:
    """Run what a file of results lacks."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("results", type=Path, help="file of results, one JSON object a line")
    parser.add_argument("--campaigns", type=int, default=1000)
    parser.add_argument("--part", default="1/1", help="which of how many parts, e.g. 2/4")
    parser.add_argument("--store", action="store_true", help="write the table of all rows")
    given = parser.parse_args()
    which, parts = (int(text) for text in given.part.split("/"))
    done = {row["number"] for row in read(given.results)}
    for number in range(which - 1, given.campaigns, parts):
        if number in done:
            continue
        row = run(number)
        with given.results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    found = [row for row in read(given.results) if row["number"] < given.campaigns]
    if given.store:
        store(found, given.campaigns)
    print(json.dumps(figures(found), indent=1))


if __name__ == "__main__":
    main()
