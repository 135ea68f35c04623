"""Simulation-based calibration, and coverage where an effect is not declared.

Each replication depends on the seed and its own number; finished ones are kept in a folder, and the
same command goes on where it was stopped:

    python studies/calibration.py spring --replications 2000 --out FOLDER --store
    python studies/calibration.py oleo --replications 300 --out FOLDER --store
    python studies/calibration.py coverage --replications 300 --out FOLDER --store

``--scheduler local:2`` spreads them over processes. ``--store`` writes the table that the page
``plot_calibration.py`` shows.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import calibration_oleo as campaign
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesoleo.estimation import FunctionProblem
from bayesoleo.machines import connected, each_done
from bayesoleo.model.correlated import sample_of
from bayesoleo.model.priors import Normal
from bayesoleo.posterior import LogDensity, Samples, error_model, laplace_mixture
from bayesoleo.posterior import sample as draw
from bayesoleo.posterior.calibration import rank_of, uniformity
from bayesoleo.storage.slots import Slots

Arrays = dict[str, NDArray]
STORED = Path(__file__).resolve().parent / "tables"
#: Ninety-per-cent intervals.
TAILS = (0.05, 0.95)
COVERAGE_MODELS = ("independent", "correlated", "discrepancy")
POSITION = np.linspace(0.0, 0.9, 100)
SPRING_PRIOR, SPRING_LOG_V = Normal(1.0, 0.1), Normal(2 * np.log(0.0792), 0.5)
#: Spread of the logarithm of a variance about that of the nominal noise.
LOG_V_SD = 0.5


def spring(number: int, seed: int) -> Arrays:
    """Ranks of exponent and log variance of one gas spring drawn from the prior."""
    rng = _generator(seed, number)
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
    rng = _generator(seed, number)
    simulator = campaign.declared()
    priors = {name: Normal(2 * np.log(sd), LOG_V_SD) for name, sd in campaign.NOISE.items()}
    theta, outputs = _drawn(rng, simulator)
    log_v = np.array([priors[name].sample(rng, 1)[0] for name in simulator.problem.outputs])
    sd = dict(zip(simulator.problem.outputs, np.exp(0.5 * log_v), strict=True))
    problem = simulator.problem.with_data(campaign.noisy(outputs, sd, rng))
    problem.freeze(theta)
    errors = error_model("independent", problem, log_variance_prior=priors)
    samples = _posterior(LogDensity(problem, 1, errors=errors), theta, seed, number)
    ranks = rank_of(samples, [*theta, *log_v], rng)
    return {"ranks": ranks, "reached": np.array(samples.reached)}


def coverage(number: int, seed: int) -> Arrays:
    """Whether 90 % intervals cover, and how wide they are, by error model and parameter."""
    rng = _generator(seed, number)
    effects = list(campaign.EFFECTS)
    effect = effects[int(rng.integers(len(effects)))]
    size = float(np.exp(rng.uniform(*np.log(campaign.SIZES))))
    for _ in range(50):
        theta, _ = _drawn(rng, campaign.declared())
        outputs = campaign.with_effect(effect, theta, size, rng)
        if outputs is not None:
            break
    else:
        raise RuntimeError(f"no answer of {effect} in fifty draws")
    base = campaign.declared().problem
    problem = base.with_data(campaign.noisy(outputs, campaign.NOISE, rng))
    problem.freeze(theta)
    low, high, reached = [], [], []
    for word in COVERAGE_MODELS:
        # Ends of intervals need fewer draws than ranks.
        samples = _posterior(LogDensity(problem, 1, errors=word), theta, seed, number, quick=True)
        ends = np.quantile(samples.theta.reshape(-1, theta.size), TAILS, axis=0)
        low.append(ends[0])
        high.append(ends[1])
        reached.append(samples.reached)
    means = np.array([name not in campaign.EFFECTS[effect] for name in base.names])
    return {
        "low": np.array(low), "high": np.array(high), "truth": theta, "keeps_meaning": means,
        "size": np.array(size), "effect": np.array(effects.index(effect)),
        "reached": np.array(reached),
    }  # fmt: skip


STUDIES: dict[str, Callable[[int, int], Arrays]] = {
    "spring": spring,
    "oleo": oleo,
    "coverage": coverage,
}


def _generator(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))


def _drawn(rng: np.random.Generator, simulator: campaign.Simulator):
    """Parameters from their prior that have an answer, and the outputs."""
    problem = simulator.problem
    while True:
        theta = sample_of(problem.priors, rng, 1)[0]
        outputs = simulator.outputs(theta)
        if outputs is not None:
            return theta, outputs


def _posterior(
    density: LogDensity, theta, seed: int, number: int, *, quick: bool = False
) -> Samples:
    """Started at the truth, which no draw that is kept remembers."""
    mixture = laplace_mixture(density, theta[None])
    return draw(
        density, mixture, effective_size=400, seed=seed + number, quick=quick, progress=False
    )


class Task:
    """One replication by its number, for workers."""

    def __init__(self, study: str, seed: int) -> None:
        self.study, self.seed = study, seed

    def __call__(self, number: int) -> Arrays:
        return STUDIES[self.study](number, self.seed)


def replicate(study: str, count: int, seed: int, out: Path, scheduler: str | None) -> list[Arrays]:
    """All replications, those that are missing made anew."""
    slots = Slots(out, f"{study} {seed} {version('bayesoleo')}")
    missing = [number for number in range(count) if slots.read(number) is None]
    with connected(scheduler) as client:
        for index, found in each_done(Task(study, seed), missing, client=client, jobs=1):
            slots.write(missing[index], found)
    return [slots.read(number) or {} for number in range(count)]


def ranks_table(study: str, found: list[Arrays]) -> dict[str, object]:
    """Ranks by quantity, and whether they are uniform."""
    ranks = np.array([item["ranks"] for item in found])
    names = ["exponent", "log_variance"]
    if study == "oleo":
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


def coverage_table(found: list[Arrays]) -> dict[str, object]:
    """Coverage and median width over the prior's sd, each parameter and pooled, by error model."""
    problem = campaign.declared().problem
    keep = np.array([item["keeps_meaning"] for item in found])
    truth = np.array([item["truth"] for item in found])[:, None]
    low, high = (np.array([item[end] for item in found]) for end in ("low", "high"))
    covers = (low <= truth) & (truth <= high)
    sd = np.array([prior.sd for prior in problem.priors])
    table: dict[str, object] = {"names": list(problem.names), "effects": list(campaign.EFFECTS)}
    for k, word in enumerate(COVERAGE_MODELS):
        width = (high - low)[:, k] / sd
        each = [float(covers[keep[:, a], k, a].mean()) for a in range(len(sd))]
        pooled = covers[:, k][keep]
        by_effect = [
            float(covers[rows, k][keep[rows]].mean()) if rows.any() else None
            for e in range(len(campaign.EFFECTS))
            for rows in [np.array([int(item["effect"]) == e for item in found])]
        ]
        # Parameters of one replication share its effect: replications are the independent units.
        shares = np.array([c[m].mean() for c, m in zip(covers[:, k], keep, strict=True)])
        table[word] = {
            "each": [round(value, 4) for value in each],
            "pooled": round(float(pooled.mean()), 4),
            "pooled_standard_error": round(float(shares.std() / np.sqrt(len(shares))), 4),
            "by_effect": by_effect,
            "median_width_over_prior_sd": np.round(np.median(width, axis=0), 4).tolist(),
            "reached": int(sum(bool(item["reached"][k]) for item in found)),
        }
    return table


def stored(study: str) -> dict | None:
    """The table of the last run; None if there is none."""
    path = STORED / f"calibration-{study}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def ranks_figure(study: str) -> Figure | None:
    """Distribution functions of the ranks, less the uniform one, with their band."""
    table = stored(study)
    if table is None:
        return None
    columns = min(len(table["names"]), 3)
    rows = -(-len(table["names"]) // columns)
    figure = Figure(figsize=(9, 0.4 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, name, ranks in zip(panels, table["names"], table["ranks"], strict=False):
        test = uniformity(ranks)
        axes.fill_between(test.places, test.low, test.high, color="0.88", lw=0)
        axes.plot(test.places, test.difference, color="#0072b2", lw=1.4)
        axes.set_title(f"{name}, p = {test.p_value:.2g}", fontsize=9)
        axes.axhline(0, color="0.6", lw=0.6)
    for axes in panels[len(table["names"]) :]:
        axes.set_axis_off()
    figure.supxlabel("rank of the truth", fontsize=9)
    figure.supylabel("part of the ranks − uniform", fontsize=9)
    return figure


def print_coverage() -> None:
    """Coverage of 90 % intervals and their widths, by error model and parameter."""
    table = stored("coverage")
    if table is None:
        return
    print(f"{'':22}" + "".join(f"{word:>16}" for word in COVERAGE_MODELS))
    for a, name in enumerate(table["names"]):
        cells = [
            f"{table[word]['each'][a]:8.0%} {table[word]['median_width_over_prior_sd'][a]:6.2g}"
            for word in COVERAGE_MODELS
        ]
        print(f"{name:22}" + "".join(f"{cell:>16}" for cell in cells))
    pooled = [table[word]["pooled"] for word in COVERAGE_MODELS]
    print(f"{'pooled':22}" + "".join(f"{value:8.1%}        " for value in pooled))
    print("Each: coverage, and the median width over the prior's standard deviation.")


def coverage_figure() -> Figure | None:
    """Coverage by parameter and by effect."""
    table = stored("coverage")
    if table is None:
        return None
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    rows = ((table["names"], "each"), (table["effects"], "by_effect"))
    colours = ("#d55e00", "#e69f00", "#0072b2")
    for axes, (names, key) in zip(panels, rows, strict=True):
        for k, (word, colour) in enumerate(zip(COVERAGE_MODELS, colours, strict=True)):
            place = np.arange(len(names)) + 0.22 * (k - 1)
            axes.plot(table[word][key], place, "o", color=colour, label=word)
        axes.axvline(0.9, color="0.6", lw=0.8)
        axes.set_yticks(range(len(names)), [n.replace("_", " ") for n in names], fontsize=8)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlabel("coverage of 90 % intervals", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False, fontsize=8)
    return figure


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
    found = replicate(chosen.study, chosen.replications, chosen.seed, chosen.out, chosen.scheduler)
    covered = chosen.study == "coverage"
    table = coverage_table(found) if covered else ranks_table(chosen.study, found)
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
