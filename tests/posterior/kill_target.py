"""Run by the kill tests in a process of its own: a slow Gaussian, sampled into a folder."""

import sys
import time
from pathlib import Path

import numpy as np
from posterior_targets import Gaussian

from bayesoleo.posterior import Mixture, sample


class Slow(Gaussian):
    """Takes a moment, so that there is something to interrupt."""

    def __call__(self, phi):
        time.sleep(0.002)
        return super().__call__(phi)


def run(target, out: Path | None, climbs: int | None = None):
    """Sample with many small segments."""
    mixture = Mixture(np.zeros((1, 2)), np.eye(2)[None], np.zeros(1))
    return sample(
        target, mixture, seed=11, out=out, quick=True, segment=3, fingerprint="x", progress=False,
        climbs=climbs,
    )  # fmt: skip


if __name__ == "__main__":
    run(Slow(np.ones(2)), Path(sys.argv[1]))
