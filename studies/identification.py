"""How often the loop names the effect that is missing: campaigns with a known one, without any, and
with one that the catalogue lacks.

Every effect of the catalogue that applies to an oleo is put into six-run campaigns at 1, 3 and 10
times its detection limit - the size that a score finds significant in half of the campaigns, from
the noise - and the loop closed on each with a model that lacks it. Rows go to a file as they come,
so that a run that was stopped goes on, and parts can be run side by side:

    python studies/identification.py results.jsonl --part 1/4

takes a quarter of the campaigns; ``--fraction 0.01`` a sample; ``--store`` writes the table that
the page ``plot_identification.py`` shows. Curves without a name are not looked for: they take a
minute a campaign, and come after every named effect has failed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import identification_rows as rows
import numpy as np
from identification_rows import FACTORS, NONE
from scipy import optimize, stats

import bayesoleo
from bayesoleo.data import ReducedCampaign, load_campaign, reduce_campaign, write_campaign
from bayesoleo.effects import Effect, find_effect, force_effect
from bayesoleo.model import Model, driven_by
from bayesoleo.prediction.simulate import RunPlan, motion, simulate_run
from bayesoleo.simulation import to_simulated_run
from bayesoleo.systems import system
from bayesoleo.tracing.deciding.loop import close_loop
from bayesoleo.tracing.deciding.rounds import LEVEL
from bayesoleo.tracing.deciding.state import State, fit_state
from bayesoleo.tracing.fitting.assembly import Assembly, Option
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import assign
from bayesoleo.tracing.scoring.scales import scales_of
from bayesoleo.tracing.scoring.score import score_all
from bayesoleo.tracing.scoring.significance import effective_tests

SYSTEM, DRIVE = "f16n2d2", "displacement"
REPLICATIONS, PLAIN = 5, 200
#: Of the campaigns' order and of the motion that limits come from; each campaign is seeded by name.
SEED = 0
NOISE = {"displacement": 5e-5, "force": 20.0, "pressure": 5e3}
CHANNELS = {"displacement": ("x_mm", "mm"), "force": ("F_kN", "kN"), "pressure": ("p_bar", "bar")}
#: Label, frequency in Hz, mean and amplitude of the stroke in m, role.
RUNS = (
    ("a", 0.1, 0.10, 0.050, "fit"),
    ("b", 0.5, 0.13, 0.035, "fit"),
    ("c", 1.0, 0.08, 0.025, "fit"),
    ("d", 2.0, 0.12, 0.020, "fit"),
    ("e", 0.2, 0.12, 0.040, "hold-out"),
    ("f", 1.5, 0.10, 0.025, "hold-out"),
)
UNITS = {"initial_pressure": "Pa", "ambient_temperature": "K"}
PERIODS, PER_PERIOD = 4.3, 250.4
NUMERICS = Numerics(jobs=1, backend="numpy")

#: What the catalogue has no name for.
STRANGERS = (
    force_effect("ripple", "unnamed", "ripple*sin(900*position)", {"ripple": "force"}),
    force_effect(
        "late_drag", "unnamed", "late_drag*velocity**3/(1 + (40*velocity)**4)",
        {"late_drag": "force/(position/s)**3"},
    ),
    force_effect(
        "inner_wall", "unnamed", "inner_wall*exp(-((position - 0.11)/0.006)**2)",
        {"inner_wall": "force"},
    ),
)  # fmt: skip


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
    for option in [*options(), *strangers()]:
        effect, target = option.key
        if option.key not in limits():
            continue  # the model can already do what it would: no data can show it
        found += [
            Campaign(effect, target, factor, k) for factor in FACTORS for k in range(REPLICATIONS)
        ]
    order = np.random.default_rng(SEED).permutation(len(found))
    return [found[k] for k in order]


# -- what is simulated -----------------------------------------------------------------


def simulated(model: Model, values: dict[str, Any], seed: int) -> ReducedCampaign:
    """Six runs of a model driven by displacement, as a rig records them."""
    rng, runs = np.random.default_rng([seed, 1993]), []
    for k, (label, frequency, mean, amplitude, role) in enumerate(RUNS):
        stroke = motion(
            mean, [amplitude, 0.01 * amplitude, 0.005 * amplitude], rng.uniform(0, 6, 3)
        )
        pressure = 4.9e5 * (1 + 0.015 * rng.standard_normal())
        plan = RunPlan(
            label,
            frequency * (1 + 0.002 * rng.standard_normal()),
            {DRIVE: stroke},
            {"initial_pressure": pressure, "ambient_temperature": 293.0},
            periods=PERIODS,
            samples_per_period=PER_PERIOD,
            role=role,
        )
        own = {n: float(v[k]) if np.ndim(v) else float(v) for n, v in values.items()}
        run = simulate_run(model, plan, own, noise=NOISE, rng=rng, steps=512)
        runs.append(to_simulated_run(run, UNITS))
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(
            folder, name="study", channels=CHANNELS, runs=runs, controlled=DRIVE, overwrite=True
        )
        return reduce_campaign(load_campaign(folder), jobs=1)


@cache
def base() -> State:
    """The model fitted to a plain campaign: motion and noise that limits are computed from."""
    plain = simulated(driven_by(system(SYSTEM), DRIVE), {}, SEED)
    return fit_state(Assembly(system(SYSTEM), DRIVE), assign(plain.records), NUMERICS)


@cache
def freed() -> State:
    """The same with every constant estimated that is known to a tolerance."""
    assembly, roles = base().assembly, assign(base().fit.records)
    declared = assembly.model()
    loose = {n: replace(declared.parameters[n], fixed=False) for n in declared.uncertain()}
    return fit_state(assembly.with_parameters(loose), roles, NUMERICS)


@cache
def options() -> tuple[Option, ...]:
    """Every effect where it applies, each shape in the middle of its grid, of either sign."""
    return tuple(_middle(option) for option in _of(None))


@cache
def strangers() -> tuple[Option, ...]:
    """The same of what the catalogue lacks."""
    return tuple(_middle(option) for option in _of(STRANGERS))


def _of(effects: Sequence[Effect] | None) -> list[Option]:
    state = base()
    scales = scales_of(state.fit, DRIVE, tuple(state.assembly.native.dofs))
    return state.assembly.options(scales, effects)


def _middle(option: Option) -> Option:
    shapes = {n: (grid[len(grid) // 2],) for n, grid in option.candidate.shapes.items()}
    return replace(option, candidate=replace(option.candidate, shapes=shapes, sign={}))


@cache
def limits() -> dict[tuple[str, str], float]:
    """Detection limit of each effect's amplitude, SI, by effect and target.

    Without what a constant does that is known to a tolerance only: a loop that finds it far off
    frees it first, and is right to.
    """
    wanted = [*options(), *strangers()]
    seen = {score.option.key for score in score_all(freed().base(), wanted, jobs=1)[0]}
    scores = score_all(base().base(), [o for o in wanted if o.key in seen], jobs=1)[0]
    tests = effective_tests(score_all(base().base(), _of(None), jobs=1)[0], 0)
    local = -np.expm1(np.log1p(-LEVEL) / tests)
    found = {}
    for score in scores:
        needed = stats.chi2.isf(local, score.rank)
        # The median of a non-central variate is where its power is one half.
        away = optimize.brentq(
            lambda x, n=needed, k=score.rank: stats.ncx2.sf(n, k, x) - 0.5, 1e-6, 400.0
        )
        variance = float(np.median(score.expected**2))
        if len(score.names) == 1:
            information = score.fall / variance
        else:
            # Of several runs with unit scores: the median of chi-square is 0.455.
            information = 0.455 * len(score.names) / variance
        found[score.option.key] = float(np.sqrt(away / information))
    return found


def truth(campaign: Campaign, rng: np.random.Generator) -> tuple[Model, dict[str, Any]]:
    """The model that makes a campaign's data, and its values."""
    native = system(SYSTEM)
    if campaign.effect == NONE:
        return driven_by(native, DRIVE), {}
    known = {option.key: option for option in [*options(), *strangers()]}
    key = campaign.effect, campaign.target
    option, size = known[key], campaign.factor * limits()[key]
    candidate, model = option.candidate, option.model
    if campaign.effect == "frame_compliance":
        # The data show what the frame gives by the force itself, not by the one measured.
        effect = find_effect("frame_compliance")
        candidate = effect.extend(native, effect.places(native)[0], _any_scales())
        model = driven_by(candidate.model, DRIVE)
    values: dict[str, Any] = {name: grid[0] for name, grid in option.candidate.shapes.items()}
    (sign,) = _signs().get(key) or {0}
    for name in candidate.parameters:
        by_run = model.parameters[name].by_run
        drawn = rng.standard_normal(len(RUNS)) if by_run else (sign or rng.choice([-1.0, 1.0]))
        values[name] = size * drawn
    return model, values


@cache
def _signs() -> dict[tuple[str, str], set[int]]:
    """Sides of the null that are physical, by effect and target."""
    return {option.key: set(option.candidate.sign.values()) for option in _of(None)}


def _any_scales() -> Any:
    return scales_of(base().fit, DRIVE, tuple(base().assembly.native.dofs))


# -- what the loop makes of it ----------------------------------------------------------


def run(campaign: Campaign) -> dict[str, Any]:
    """Simulate one campaign, close the loop and say what came out."""
    rng = np.random.default_rng([len(campaign.key), *campaign.key.encode()])
    begin = time.process_time()
    try:
        model, values = truth(campaign, rng)
        reduced = simulated(model, values, int(rng.integers(2**31)))
    except bayesoleo.BayesoleoError as error:
        return asdict(campaign) | {"failed": str(error).splitlines()[0]}
    assembly = Assembly(system(SYSTEM), DRIVE)
    loop = close_loop(assembly, assign(reduced.records), NUMERICS, max_effects=2, unnamed=False)
    accepted = [entry.accepted for entry in loop.rounds if entry.accepted]
    ranking = loop.rounds[0].ranking
    own = [k for k, item in enumerate(ranking) if item.effect == campaign.effect]
    return asdict(campaign) | {
        "added": [f"{item.effect} at {item.target}" for item in accepted],
        "same": list(accepted[0].same) if accepted else [],
        "reason": loop.rounds[-1].reason,
        "verdict": loop.verdict,
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
