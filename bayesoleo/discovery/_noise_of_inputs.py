"""Whether the noise of measured inputs is what a residual shows beyond that of its outputs.

That noise reaches the outputs through the model, coloured by its resonances. No error model of the
outputs alone says how well it lets parameters be known; the covariance of the estimate under the
spectra of both noises does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo.discovery._expected_error import expected_of_fitted
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import ErrorTable, compared, is_at_floor
from bayesoleo.discovery._run_predictions import predict_fitted
from bayesoleo.prediction._run_errors import DRAWS, errors_known

#: Part of the squared noise of an average that comes from inputs, above which it is worth a word.
#: Below it an interval is less than 3 % too narrow without it.
MATTERS = 0.05


@dataclass(frozen=True)
class NoiseOfInputs:
    """What the noise of measured inputs does to an estimate.

    Parameters
    ----------
    alone : bool
        Whether it matters, and no more is left than it and the outputs' noise.
    inflation : float
        Variance of an estimate under the spectra of both noises, over that under white noise of the
        residual's size, the largest of all unknowns; at least one.
    """

    alone: bool
    inflation: float

    @classmethod
    def of(cls, fit: ModelFit) -> NoiseOfInputs:
        """Of the fitted runs."""
        fitted = predict_fitted(fit)
        roles = {one.record.label: "fit" for one in fitted}
        found = [compared(one, roles, policy=fit.policy) for one in fitted]
        entries, known = expected_of_fitted(fit, fitted, found)
        if not known:
            return cls(alone=False, inflation=1.0)
        variance, white = (np.diag(c) for c in (known[""].covariance, fit.point.covariance))
        ratios = variance[white > 0.0] / white[white > 0.0]
        if any(not errors_known(one.predictor.runs[0]) for one in fitted):
            ratios = ratios * DRAWS / (DRAWS - 2.0)  # a variance by so many draws is that uncertain
        matters = any(e.input_noise**2 > MATTERS * e.noise**2 for e in entries)
        alone = matters and is_at_floor(ErrorTable(tuple(entries)), policy=fit.policy)
        return cls(alone, float(np.max(ratios, initial=1.0)))
