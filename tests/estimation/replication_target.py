"""Run by the kill test in a process of its own: replications of a slow line, kept in a folder."""

import sys
import time

import numpy as np

from bayesoleo.estimation import FunctionProblem, sampling_distribution
from bayesoleo.model._priors import Normal

DESIGN = np.linspace(0.0, 1.0, 20)


def run(out: str | None, pause: float = 0.0):
    """Sixty replications in blocks of three; with a pause there is something to interrupt."""

    def line(x, theta):
        time.sleep(pause)
        return theta[0] + theta[1] * x

    problem = FunctionProblem(line, DESIGN, 1 + DESIGN, [Normal(0.0, 9.0)] * 2, ["level", "slope"])
    options = {"variance": [0.1], "replications": 60, "block": 3, "seed": 5, "jobs": 2}
    return sampling_distribution(problem, [1.0, 1.0], out=out, **options)


if __name__ == "__main__":
    run(sys.argv[1], pause=0.002)
