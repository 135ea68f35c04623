"""Reach a solution from a static guess by raising the forcing where Newton's method alone fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.periodic.solve import Boundary, Solution, solve_periodic
from bayesoleo.solvers.status import Status

FIRST_STEP = 0.25
SMALLEST_STEP = 1.0 / 512


def solve_from_guess(problem: Boundary, p: Array, start: Array) -> Solution:
    """Solve each lane directly; those that fail by continuation in the amplitude of the inputs,
    then by undamped Newton steps.

    Parameters
    ----------
    problem : Boundary
        Equations, scheme and inputs at full amplitude.
    p : ndarray, shape (L, np)
        Constants.
    start : ndarray, shape (L, n, w)
        Where each lane starts: a guess of the full motion, or a static one.

    Returns
    -------
    Solution
    """
    solution = solve_periodic(problem, p, start)
    x, status, iterations = solution.x.copy(), solution.status.copy(), solution.iterations.copy()
    for lane in np.flatnonzero(status != Status.CONVERGED.value):
        one = slice(lane, lane + 1)
        better = _raise_forcing(problem, p[one], start[one])
        if better is None:
            # Where the branch from rest folds back before full amplitude, wandering steps find the
            # other branch.
            better = solve_periodic(problem, p[one], start[one], max_iterations=200, monotone=False)
        if better.status[0] == Status.CONVERGED.value:
            x[one], status[one] = better.x, better.status
            iterations[one] += better.iterations
    return Solution(x, status, iterations)


def _raise_forcing(problem: Boundary, p: Array, start: Array) -> Solution | None:
    """Continuation of one lane from its time average under constant inputs."""
    static = np.broadcast_to(start.mean(axis=1, keepdims=True), start.shape).copy()
    current = _at(problem, p, static, 0.0)
    if current.status[0] != Status.CONVERGED.value:
        return None
    amount, step, previous = 0.0, FIRST_STEP, None
    while amount < 1.0:
        target = min(1.0, amount + step)
        guess = current.x
        if previous is not None:
            before, x_before = previous
            guess = current.x + (target - amount) / (amount - before) * (current.x - x_before)
        trial = _at(problem, p, guess, target)
        if trial.status[0] != Status.CONVERGED.value:
            step /= 2
            if step < SMALLEST_STEP:
                return None
            continue
        previous, current, amount = (amount, current.x), trial, target
        if trial.iterations[0] <= 4:
            step *= 2
    return current


def _at(problem: Boundary, p: Array, start: Array, amount: float) -> Solution:
    mean = problem.inputs.mean(axis=1, keepdims=True)
    scaled = replace(problem, inputs=mean + amount * (problem.inputs - mean))
    return solve_periodic(scaled, p, start, max_iterations=15)
