"""How often a probability of a structure is right: simulated campaigns of six kinds of system.

A quarter lacks nothing; the others lack one effect, two, or a law that the catalogue does not have,
at one to ten times the detection limit. Systems, motions and noise are drawn by the benchmarks' own
simulator, which shares no code with the package. Effects are drawn in one of two ways:

``catalogue``
    from the whole catalogue, as often as the default prior says (:mod:`structure_draws`);
``sixteen``
    sixteen usual ones in their places, which the same simulator computes. Of laws that are nearly
    one it has one only; the prior has both, so that statements of the two say less than is true.

An effect is true if it acts, or if its columns are exactly those of one that acts, so that the two
are one effect in the catalogue. Of effects that only resemble each other one is true and the others
are false. Rows go to a file as they come, so that a run that was stopped goes on:

    python studies/structure_probabilities.py rows.jsonl --campaigns 1000 --jobs 2

``--store`` writes the table that the gallery shows; ``--from-stored`` begins with its campaigns,
for as long as what the package says of a campaign is the same.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "benchmarks"))
import structure_draws
import truth_effects as truth
from structure_figures import CATALOGUE, OUTSIDE, SIXTEEN, TABLES, figures
from structure_mix import statements_by_mix
from truth_systems import KINDS, Extra, Made, Noise, Plan, Sizes, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._state import fit_state
from bayesoleo.discovery._structure_search import structure_posterior
from bayesoleo.errors import BayesoleoError

#: What a campaign may lack, in turn.
CLASSES = ("nothing", "one", "one", "two", "outside", "one", "nothing", "outside")
#: Effects of the catalogue that a campaign of a class lacks.
COUNTS = {"one": 1, "two": 2}
#: Sizes in detection limits.
LEAST, MOST = 1.0, 10.0
#: How many times larger than the largest size, or smaller than the least, an effect may come out
#: that is not linear in its amplitude. Beyond, the campaign is left out.
BEYOND = 3.0
#: Two runs are fitted, or three; none is held out.
PLAN = Plan(fitted=2, held_out=0, periods=5, per_period=64.3)
#: Probabilities below this are not kept.
KEPT = 0.01
#: Log evidence of structures that are more probable goes to the rows, so that another prior can be
#: tried without running them again; the stored table is without.
SMALL = 1e-6
SEED = 577215


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


def entered(rng: np.random.Generator) -> float:
    """Relative noise of a measured input, which every other campaign has."""
    return float(10 ** rng.uniform(-3.0, -2.0)) * int(rng.integers(2))


def made_of(what: str, case: truth.Case, number: int, rng: Any) -> tuple[Made, np.ndarray]:
    """The campaign, and the sizes of what it lacks in detection limits.

    No run is held out, for probabilities use the fitted runs only. Every other campaign has a
    measured input with noise of its own.
    """
    seed, noise = 120000 + number, Noise(relative_input=entered(rng))
    if what == "nothing":
        transient, weak = bool(rng.integers(8) == 0), bool(rng.integers(2))
        plan = Plan(fitted=int(rng.integers(2, 4)), held_out=0, transient=transient, weak=weak)
        return make(case.kind, seed, plan=plan, noise=noise), np.zeros(0)
    truth.PLAN, truth.FEWER = replace(PLAN, fitted=3), PLAN
    truth.NOISE = replace(noise, relative=0.005)
    return sized(case, seed, rng)


def sized(case: truth.Case, seed: int, rng: Any) -> tuple[Made, np.ndarray]:
    """A campaign with effects of about the sizes that are drawn, and what they came to.

    An effect is looked at once and taken to be linear in its amplitude. What single effects came
    to is measured on the campaign itself.
    """
    wanted = rng.uniform(LEAST, MOST, len(case.missing))
    probes = truth.PROBE * np.array([rng.choice(item.signs) for item in case.missing])
    drawn = truth.Drawn.of(case, seed)
    base = truth.fitted(drawn.measured(np.zeros(len(wanted)))).base()
    looks = [truth._changes(base, drawn.measured(one)) for one in np.diag(probes)]
    factors = wanted / truth._sizes_of(base, looks)
    made = drawn.measured(probes * factors)
    if len(wanted) == 1:
        return made, truth._sizes_of(base, [truth._changes(base, made)])
    return made, wanted


@dataclass(frozen=True)
class Campaign:
    """One campaign of the study.

    Parameters
    ----------
    made : Made
    names : sequence of str
        Effects that it lacks, with their places.
    sizes : ndarray
        Of what it lacks, in detection limits.
    """

    made: Made
    names: Sequence[str]
    sizes: np.ndarray


def campaign(number: int, draw: str) -> Campaign:
    """Draw and simulate campaign ``number``."""
    what = CLASSES[number % len(CLASSES)]
    if draw == CATALOGUE and what in COUNTS:
        rng = np.random.default_rng([number, SEED, 1])
        truth.PLAN, truth.FEWER = replace(PLAN, fitted=3), PLAN
        wanted = rng.uniform(LEAST, MOST, COUNTS[what])
        noise = Noise(relative=0.005, relative_input=entered(rng))
        kind = str(rng.choice(list(KINDS)))
        return Campaign(*structure_draws.drawn(kind, 150000 + number, wanted, noise, rng))
    rng = np.random.default_rng([number, SEED])
    what, case = case_of(number, rng)
    made, sizes = made_of(what, case, number, rng)
    names = [f"{item.effect} @ {item.target}" for item in case.missing if what != OUTSIDE]
    return Campaign(made, names, sizes)


def run(number: int, draw: str = CATALOGUE) -> dict[str, Any]:
    """Simulate one campaign and compare structures on it."""
    row: dict[str, Any] = {"number": number, "what": CLASSES[number % len(CLASSES)]}
    start = time.process_time()
    try:
        lacks = campaign(number, draw)
    except (BayesoleoError, RuntimeError, np.linalg.LinAlgError) as error:
        return row | {"failed": str(error).splitlines()[0]}
    made, sizes = lacks.made, lacks.sizes
    if np.any(sizes > BEYOND * MOST) or np.any(sizes < LEAST / BEYOND):
        return row | {"failed": "the effect is not nearly linear in its amplitude"}
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
    return row | {
        "kind": made.kind,
        "truth": [twins.get(name, name) for name in lacks.names],
        "sizes": [round(float(size), 2) for size in sizes],
        "nothing": found.nothing,
        "outside": found.outside,
        "only_outside": found.only_outside,
        "effects": {f"{e} @ {t}": p for (e, t), p in found.effects.items() if p > KEPT},
        "best": [
            [[f"{e} @ {t}" for e, t in s.effects], s.outside, s.probability]
            for s in found.structures[:5]
        ],
        "evidence": [
            [s.effects, s.outside, round(s.log_evidence, 2)]
            for s in found.structures
            if s.probability > SMALL
        ],
        "ratio": state.worst_ratio,
        "made_seconds": begin - start,
        "score_seconds": middle - begin,
        "seconds": end - middle,
    }


def store(rows: Sequence[Mapping[str, Any]], campaigns: int, draw: str) -> None:
    """Write the compact table: a campaign a line."""
    kept = sorted((row for row in rows if "failed" not in row), key=lambda row: row["number"])
    options = f"--draw {draw} --campaigns {campaigns} --store"
    head = {
        "command": f"python {Path(__file__).name} FILE {options}",
        "version": version("bayesoleo"),
        "seed": SEED,
        "campaigns": len(kept),
        "failed": len(rows) - len(kept),
    }
    if draw == SIXTEEN:
        kept = [_with_mix(row) for row in kept]
    kept = [{key: value for key, value in row.items() if key != "evidence"} for row in kept]
    lines = ",\n".join(json.dumps(_brief(row)) for row in kept)
    text = json.dumps(head)[:-1] + f', "rows": [\n{lines}\n]}}\n'
    TABLES[draw].write_text(text, encoding="utf-8")


def _with_mix(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """With the statements by the prior of the study, which rows of the stored table have."""
    return {**row, "by_mix": statements_by_mix(row)} if "evidence" in row else row


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
    parser.add_argument("--draw", choices=list(TABLES), default=CATALOGUE, help="what is lacking")
    parser.add_argument("--jobs", type=int, default=1, help="campaigns at a time")
    parser.add_argument("--store", action="store_true", help="write the table of all rows")
    parser.add_argument("--from-stored", action="store_true", help="begin with the stored table")
    given = parser.parse_args()
    if given.from_stored and not given.results.exists():
        stored = json.loads(TABLES[given.draw].read_text(encoding="utf-8"))["rows"]
        given.results.write_text("".join(json.dumps(row) + "\n" for row in stored), "utf-8")
    done = {row["number"] for row in read(given.results)}
    numbers = [number for number in range(given.campaigns) if number not in done]
    with multiprocessing.Pool(given.jobs) as pool:
        for row in pool.imap_unordered(partial(run, draw=given.draw), numbers):
            with given.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    found = [row for row in read(given.results) if row["number"] < given.campaigns]
    if given.store:
        store(found, given.campaigns, given.draw)
    if given.draw == SIXTEEN:
        found = [dict(_with_mix(row)) for row in found]
    print(json.dumps(figures(found), indent=1))


if __name__ == "__main__":
    main()
