"""Simulation-based calibration, and coverage where an effect is not declared.

Each replication depends on the seed and its own number; finished ones are kept in a folder, and the
same command goes on where it was stopped:

    python studies/calibration.py spring --replications 2000 --out FOLDER --store
    python studies/calibration.py oleo --replications 600 --out FOLDER --store
    python studies/calibration.py oleo-weighted --replications 1000 --out FOLDER --store
    python studies/calibration.py coverage --replications 300 --out FOLDER --store

``--scheduler local:2`` spreads them over processes. ``--store`` writes the table that the page
``plot_calibration.py`` shows.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

import calibration_coverage as coverage
import calibration_oleo as campaign
import numpy as np
from calibration_figures import MODELS, STORED
from numpy.typing import NDArray

from bayesoleo._parallel import connected, each_done
from bayesoleo._storage.resume import Slots
from bayesoleo.error_models import error_model
from bayesoleo.estimation import FunctionProblem
from bayesoleo.model import Normal
from bayesoleo.posterior import (
    DRAWS,
    LogDensity,
    Samples,
    importance_sample,
    laplace_mixture,
    rank_of,
    sample as draw,
    uniformity,
)

Array = NDArray[np.float64]
Arrays = dict[str, NDArray]
POSITION = np.linspace(0.0, 0.9, 100)
SPRING_PRIOR, SPRING_LOG_V = Normal(1.0, 0.1), Normal(2 * np.log(0.0792), 0.5)
#: Spread of the logarithm of a variance about that of the nominal noise.
LOG_V_SD = 0.5


def spring(number: int, seed: int) -> Arrays:
    """Ranks of exponent and log variance of one gas spring drawn from the prior."""
    rng = campaign.generator(seed, number)
    theta, log_v = SPRING_PRIOR.sample(rng, 1)[0], SPRING_LOG_V.sample(rng, 1)[0]
    clean = (1 - POSITION) ** -theta
    y = clean + np.exp(0.5 * log_v) * rng.standard_normal(POSITION.size)
    log_ratio = -np.log1p(-POSITION)
    problem = FunctionProblem(
        lambda x, p: np.exp(p[0] * log_ratio),
        POSITION,
        y,
        [SPRING_PRIOR],
        ["exponent"],
        jacobian=lambda x, p: (np.exp(p[0] * log_ratio) * log_ratio)[:, None],
    )
    errors = error_model("independent", problem, log_variance_prior={"y": SPRING_LOG_V})
    samples = _posterior(LogDensity(problem, 1, errors=errors), np.array([theta]), seed, number)
    return {"ranks": rank_of(samples, [theta, log_v], rng), "reached": np.array(samples.reached)}


def oleo(number: int, seed: int) -> Arrays:
    """Ranks of seven parameters and two log variances of one oleo drawn from the prior."""
    density, truth, rng = _oleo(number, seed)
    samples = _posterior(density, truth[: campaign.PARAMETERS], seed, number)
    return {"ranks": rank_of(samples, truth, rng), "reached": np.array(samples.reached)}


def oleo_weighted(number: int, seed: int) -> Arrays:
    """The same by weighted draws: a test of the density at a tenth of the cost."""
    density, truth, rng = _oleo(number, seed)
    mixture = laplace_mixture(density, truth[None, : campaign.PARAMETERS])
    found = importance_sample(density, mixture, seed=seed + number, effective_size=400, draws=600)
    picks = rng.choice(len(found.draws), DRAWS, p=found.weights)
    ranks = np.sum(found.draws[picks] < truth, axis=0)
    return {"ranks": ranks, "reached": np.array(found.reached)}


def _oleo(number: int, seed: int) -> tuple[LogDensity, Array, np.random.Generator]:
    """Log density of an oleo's posterior, the truth (parameters, log variances), the generator."""
    rng = campaign.generator(seed, number)
    problem = campaign.declared().problem
    priors = {name: Normal(2 * np.log(sd), LOG_V_SD) for name, sd in campaign.NOISE.items()}
    theta, outputs = campaign.drawn(rng)
    log_v = np.array([priors[name].sample(rng, 1)[0] for name in problem.outputs])
    sd = dict(zip(problem.outputs, np.exp(0.5 * log_v), strict=True))
    problem = problem.with_data(campaign.noisy(outputs, sd, rng))
    problem.freeze(theta)
    errors = error_model("independent", problem, log_variance_prior=priors)
    return LogDensity(problem, 1, errors=errors), np.array([*theta, *log_v]), rng


STUDIES = ("spring", "oleo", "oleo-weighted", "coverage")
#: What is repeated, by study; of coverage once for each error model.
REPLICATIONS: dict[str, Callable[[int, int], Arrays]] = {
    "spring": spring,
    "oleo": oleo,
    "oleo-weighted": oleo_weighted,
    **{f"coverage-{word}": partial(coverage.replication, word) for word in MODELS},
}


def _posterior(density: LogDensity, theta, seed: int, number: int) -> Samples:
    """Started at the truth, which no draw that is kept remembers."""
    mixture = laplace_mixture(density, theta[None])
    return draw(density, mixture, effective_size=400, seed=seed + number, progress=False)


class Task:
    """One replication by its number, for workers."""

    def __init__(self, study: str, seed: int) -> None:
        self.study, self.seed = study, seed

    def __call__(self, number: int) -> Arrays:
        return REPLICATIONS[self.study](number, self.seed)


def replicate(study: str, count: int, seed: int, out: Path, scheduler: str | None) -> list[Arrays]:
    """All replications, those that are missing made anew."""
    slots = Slots(out, f"{study} {seed} {version('bayesoleo')}")
    missing = [number for number in range(count) if slots.read(number) is None]
    with connected(scheduler) as client:
        for index, found in each_done(Task(study, seed), missing, client=client, jobs=1):
            slots.write(missing[index], found)
    return [slots.read(number) or {} for number in range(count)]


def coverage_of(count: int, seed: int, out: Path, scheduler: str | None) -> dict[str, object]:
    """Coverage by error model, each with a folder of its own."""
    found = {
        word: replicate(f"coverage-{word}", count, seed, out / word, scheduler) for word in MODELS
    }
    return coverage.table_of(found)


def ranks_of(
    study: str, count: int, seed: int, out: Path, scheduler: str | None
) -> dict[str, object]:
    """Ranks by quantity, and whether they are uniform."""
    found = replicate(study, count, seed, out, scheduler)
    ranks = np.array([item["ranks"] for item in found])
    names = ["exponent", "log_variance"]
    if study.startswith("oleo"):
        problem = campaign.declared().problem
        names = [*problem.names, *(f"log_variance_{name}" for name in problem.outputs)]
    tests = [uniformity(column) for column in ranks.T]
    return {
        "names": names,
        "p_value": [round(test.p_value, 4) for test in tests],
        "inside": [test.inside for test in tests],
        "reached": int(sum(bool(item["reached"]) for item in found)),
        "ranks": ranks.T.tolist(),
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--replications", type=int, default=20)
    parser.add_argument("--seed", type=int, default=20261121)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scheduler")
    parser.add_argument("--store", action="store_true")
    chosen = parser.parse_args()
    begin, cpu = time.perf_counter(), time.process_time()
    given = (chosen.replications, chosen.seed, chosen.out, chosen.scheduler)
    table = coverage_of(*given) if chosen.study == "coverage" else ranks_of(chosen.study, *given)
    table = {
        "command": f"python studies/calibration.py {chosen.study}"
        f" --replications {chosen.replications} --seed {chosen.seed} --out FOLDER",
        "seed": chosen.seed,
        "version": version("bayesoleo"),
        "replications": chosen.replications,
        **table,
    }
    print(json.dumps({k: v for k, v in table.items() if k != "ranks"}, indent=1))
    print(f"{time.perf_counter() - begin:.0f} s, {time.process_time() - cpu:.0f} s of CPU")
    if chosen.store:
        path = STORED / f"calibration-{chosen.study}.json"
        path.write_text(json.dumps(table) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
