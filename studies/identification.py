"""How often the loop names the effect that is missing: campaigns with a known one, without any, and
with one that the catalogue lacks.

Every effect of the catalogue that applies to an oleo is put into six-run campaigns at 1, 3 and 10
times its detection limit and the loop closed on each with a model that lacks it. Rows go to a file
as they come, so that a run that was stopped goes on, and parts can be run side by side:

    python studies/identification.py results.jsonl --part 1/4

takes a quarter of the campaigns; ``--fraction 0.01`` a sample; ``--store`` writes the table that
the page ``plot_identification.py`` shows. Curves without a name are not looked for: they take a
minute a campaign, and come after every named effect has failed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import identification_rows as rows
import numpy as np
from identification_data import DRIVE, RUNS, SYSTEM, simulated
from identification_rows import FACTORS, NONE
from identification_sizes import NUMERICS, effects, limit, signs

import bayesoleo
from bayesoleo.discovery import Assembly, assign, close_loop
from bayesoleo.model import Model, driven_by
from bayesoleo.systems import system

REPLICATIONS, PLAIN = 5, 200
#: Of the campaigns' order; each campaign is seeded by its name.
SEED = 0
FITTED = [k for k, run in enumerate(RUNS) if run[-1] == "fit"]


@dataclass(frozen=True)
class Campaign:
    """One campaign of the study: which effect at which multiple of its detection limit."""

    effect: str
    target: str
    factor: float
    replication: int

    @property
    def key(self) -> str:
        """Its name in the file of results."""
        return f"{self.effect} at {self.target} x{self.factor:g} #{self.replication}"


def planned() -> list[Campaign]:
    """All campaigns of the study, in an order that a part of it samples evenly."""
    found = [Campaign(NONE, "", 0.0, k) for k in range(PLAIN)]
    for effect, target in effects():
        found += [
            Campaign(effect, target, factor, k) for factor in FACTORS for k in range(REPLICATIONS)
        ]
    order = np.random.default_rng(SEED).permutation(len(found))
    return [found[k] for k in order]


def truth(campaign: Campaign, rng: np.random.Generator) -> tuple[Model, dict[str, Any]]:
    """The model that makes a campaign's data, and its values."""
    native = system(SYSTEM)
    if campaign.effect == NONE:
        return driven_by(native, DRIVE), {}
    key = campaign.effect, campaign.target
    score, sign = effects()[key], signs().get(key, 0)
    candidate, model = score.option.candidate, score.option.model
    first = candidate.parameters[0]
    if model.parameters[first].by_run:
        drawn = rng.standard_normal(len(RUNS))
        size = campaign.factor * limit(key, drawn[FITTED])
        return model, {**score.shapes, first: size * drawn}
    if len(candidate.parameters) == 1:
        direction = np.array([sign or rng.choice([-1.0, 1.0])])
    else:
        direction = rng.standard_normal(len(candidate.parameters))
    amplitudes = campaign.factor * limit(key, direction) * direction
    if campaign.effect == "frame_compliance":
        model = driven_by(native, DRIVE)
    return model, {**score.shapes, **dict(zip(candidate.parameters, amplitudes, strict=True))}


# -- what the loop makes of it ----------------------------------------------------------


def run(campaign: Campaign) -> dict[str, Any]:
    """Simulate one campaign, close the loop and say what came out."""
    rng = np.random.default_rng([len(campaign.key), *campaign.key.encode()])
    begin = time.process_time()
    try:
        model, values = truth(campaign, rng)
        # A frame is no part of the strut: it shows in what is measured.
        frame = values.pop("frame_compliance", 0.0)
        reduced = simulated(model, values, int(rng.integers(2**31)), frame)
    except bayesoleo.errors.BayesoleoError as error:
        return asdict(campaign) | {"failed": str(error).splitlines()[0]}
    assembly = Assembly(system(SYSTEM), DRIVE)
    loop = close_loop(
        assembly, assign(reduced.records), NUMERICS, max_effects=2, nonparametric=False
    )
    accepted = [entry.accepted for entry in loop.rounds if entry.accepted]
    ranking = loop.rounds[0].ranking
    own = [k for k, item in enumerate(ranking) if item.effect == campaign.effect]
    return asdict(campaign) | {
        "added": [f"{item.effect} at {item.target}" for item in accepted],
        "same": list(accepted[0].same) if accepted else [],
        "reason": loop.rounds[-1].reason,
        "verdict": loop.verdict,
        "certain": loop.certain,
        "place": own[0] + 1 if own else None,
        "p_value": ranking[own[0]].p_value if own else None,
        "ratio": loop.final.worst_ratio,
        "seconds": time.process_time() - begin,
    }


def main() -> None:
    """Run what a file of results lacks."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("results", type=Path, help="file of results, one JSON object a line")
    parser.add_argument("--fraction", type=float, default=1.0, help="of all campaigns")
    parser.add_argument("--part", default="1/1", help="which of how many parts, e.g. 2/4")
    parser.add_argument("--store", action="store_true", help="write the table of all rows")
    given = parser.parse_args()
    which, parts = (int(text) for text in given.part.split("/"))
    everything = planned()
    chosen = everything[: round(given.fraction * len(everything))][which - 1 :: parts]
    keys = ("effect", "target", "factor", "replication")
    done = {Campaign(*(row[k] for k in keys)).key for row in rows.read(given.results)}
    for campaign in chosen:
        if campaign.key not in done:
            row = run(campaign)
            with given.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            print(campaign.key, row.get("added", row.get("failed")), flush=True)
    found = rows.read(given.results)
    if given.store:
        rows.store(found, len(everything), "python studies/identification.py FILE --store", SEED)
    print(json.dumps(rows.summarise(found), indent=1))


if __name__ == "__main__":
    main()
