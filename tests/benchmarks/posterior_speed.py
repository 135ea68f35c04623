"""Effective draws per second of our sampler and of emcee's own move, on one log density."""

from __future__ import annotations

import time
from collections.abc import Callable

import emcee
import numpy as np
from measuring import cpu
from posterior_cases import Case, gas_spring_case, oleo_case

from bayesoleo._parallel import available_cores
from bayesoleo.posterior import sample
from bayesoleo.posterior._diagnostics import autocorrelation_time, effective_size

#: Effective draws asked for, and steps of emcee's own move: about the same number of evaluations
#: for both, and some ten of its autocorrelation times.
WANTED, STEPS, WALKERS = 4000, 800, 32


def timed(work: Callable[[], object]) -> tuple[object, float, float]:
    """Result, wall time and CPU time, s."""
    wall, used = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - used


def ours(case: Case) -> dict[str, float]:
    """From the Laplace mixture to the last kept draw, warm-up and diagnostics included."""
    found, wall, used = timed(
        lambda: sample(case.density, case.mixture, effective_size=WANTED, seed=1, progress=False)
    )
    size = float(found.effective_size.min())
    return {
        "ess": size,
        "ess_per_s": size / wall,
        "ess_per_s_cpu": size / (used / available_cores()),
        "ess_per_evaluation": size / found.evaluations,
        "tau": float(found.autocorrelation_time.max()),
        "evaluations": found.evaluations,
        "acceptance": found.acceptance["independence"],
        "rhat": float(found.rhat_nested.max()),
        "reached": int(found.reached),
        "failures": sum(found.failures.values()),
    }


def stock(case: Case) -> dict[str, float]:
    """emcee's stretch move from the same mixture's draws; they are almost stationary, so that no
    step is discarded."""
    random = np.random.RandomState(1)
    start = case.mixture.sample(random, WALKERS)
    sampler = emcee.EnsembleSampler(
        WALKERS, case.dimension, lambda phi: case.density(phi)[0], vectorize=True
    )
    sampler.random_state = random.get_state()
    _, wall, used = timed(lambda: sampler.run_mcmc(start, STEPS))
    draws = sampler.get_chain().swapaxes(0, 1)
    size = float(effective_size(draws).min())
    evaluations = WALKERS * (STEPS + 1)
    return {
        "stock_ess": size,
        "stock_ess_per_s": size / wall,
        "stock_ess_per_s_cpu": size / (used / available_cores()),
        "stock_ess_per_evaluation": size / evaluations,
        "stock_tau": float(autocorrelation_time(draws).max()),
    }


def speed_figures() -> dict[str, float]:
    """The campaign of 14 runs, and the gas spring."""
    result: dict[str, float] = {"cores": available_cores()}
    case = oleo_case()
    theta = case.mixture.sample(np.random.default_rng(0), 32)
    wall = min(timed(lambda: case.density(theta))[1] for _ in range(9))
    result["log_density_ms"] = wall / len(theta) * 1e3
    result["log_density_ms_cpu"] = cpu(lambda: case.density(theta)) / len(theta) * 1e3
    mine, theirs = ours(case), stock(case)
    result |= mine | theirs
    for kind, end in (("s", ""), ("s_cpu", "_cpu"), ("evaluation", "_per_evaluation")):
        ratio = mine["ess_per_" + kind] / theirs["stock_ess_per_" + kind]
        result["ess_ratio_stock" + end] = ratio
    spring = ours(gas_spring_case(0.1))
    return result | {"gas_spring_" + key: spring[key] for key in ("ess_per_s", "tau", "acceptance")}
