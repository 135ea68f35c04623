"""Iterations of the thesis's estimators on the gas spring, over many seeds.

Run as ``python tests/benchmarks/gas_spring.py [--seeds 200]``. Start at 1.0, relative step
tolerance 1e-4. Verbeek (1993), section 3.4.2, has 4-5 iterations at a prior sd of 0.1, and at 0.01
MVE 12, MMVE 6, MBE 9. Levenberg-Marquardt and Newton's method stand beside them for comparison.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np

from bayesoleo.estimation import FunctionProblem, estimate, multistart
from bayesoleo.model._priors import Normal

POSITION = np.linspace(0.0, 0.9, 100)
NOISE = 0.005 * 10**1.2
METHODS = ("be", "mve", "mmve", "mbe", "levenberg-marquardt", "newton")


def gas_spring(seed: int, sd: float) -> FunctionProblem:
    """One simulated experiment, fitted by a model with an undeclared error of 5 %."""
    noise = np.random.default_rng(seed).normal(0.0, NOISE, POSITION.size)
    force = (1 - POSITION) ** -1.2 + noise
    return FunctionProblem(
        lambda x, t: 0.95 * (1 - x) ** -t[0], POSITION, force, [Normal(1.0, sd)], ["exponent"]
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    seeds = range(parser.parse_args().seeds)
    print(f"{len(seeds)} seeds: iterations (how often), means of the exponent and of log10 v")
    for sd in (0.1, 0.01):
        problems = [gas_spring(seed, sd) for seed in seeds]
        for method in METHODS:
            points = [estimate(problem, method, tolerance=1e-4) for problem in problems]
            counts = Counter(point.iterations for point in points)
            exponent = np.mean([point.theta[0] for point in points])
            log_v = np.mean([np.log10(point.variance[0]) for point in points])
            halvings = sum(point.halvings for point in points)
            print(
                f"sd {sd:<4}  {method:<19}  {exponent:.4f}  {log_v:6.3f}  halvings {halvings:<3} "
                + ", ".join(f"{n} ({times})" for n, times in sorted(counts.items()))
            )
    modes = [multistart(gas_spring(seed, 0.01), 0) for seed in seeds]
    both = sum(len(found) == 2 for found in modes)
    local = sum(found[0].theta[0] < 1.1 for found in modes)
    print(f"sd 0.01: both modes found in {both} seeds, the local one is the higher in {local}")


if __name__ == "__main__":
    main()
