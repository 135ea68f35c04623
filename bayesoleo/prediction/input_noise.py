"""How much of a prediction's error comes from the noise of its input.

The input's harmonics are known with a variance each. Drawn anew a few times and sent through the model they show what the input's noise
does to the outputs: it repeats in every period of the prediction, so the scatter between periods does not contain it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Harmonics
from bayesoleo.prediction.run import RunPredictor
from bayesoleo.solvers.status import Status

Array = NDArray[np.float64]


def input_noise(predictor: Predictor, theta: Array, r: int, rng: np.random.Generator, draws: int = 6) -> Array:
    """Root mean square change of each output by the input's noise.

    Parameters
    ----------
    predictor : Predictor
        Anchored near ``theta``.
    theta : ndarray, shape (l,)
        Unknowns.
    r : int
        Number of the run.
    rng : numpy.random.Generator
        Source of the draws.
    draws : int
        Their number; each is an average over thousands of samples already.

    Returns
    -------
    ndarray, shape (ny,)
        In the outputs' SI units; zero if no draw could be solved.
    """
    base = predictor.runs[r]
    p = predictor.constants(theta[None], r)
    nominal = base.predict(p).y[0]
    squares = []
    for _ in range(draws):
        harmonics = {name: _drawn(item, rng) for name, item in base.record.harmonics.items()}
        run = RunPredictor(
            base.model, base.kernels, replace(base.record, harmonics=harmonics), base.steps, predictor.scheme
        )
        run.anchor = base.anchor
        samples = run.predict(p)
        if samples.status[0] == Status.CONVERGED.value:
            squares.append(np.mean((samples.y[0] - nominal) ** 2, axis=1))
    return np.sqrt(np.mean(squares, axis=0)) if squares else np.zeros(nominal.shape[0])


def _drawn(item: Harmonics, rng: np.random.Generator) -> Harmonics:
    sd = np.sqrt(item.variances)
    change = sd * (rng.standard_normal(sd.size) + 1j * rng.standard_normal(sd.size))
    if item.orders.size and item.orders[0] == 0:
        change[0] = change[0].real
    return replace(item, coefficients=item.coefficients + change)
