"""Error models whose outputs are independent of each other, each with its own few quantities."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from bayesoleo.posterior.error_models.base import Array, ErrorModel, Frame, log_mean_squares
from bayesoleo.posterior.error_models.fitted_start import climb

#: Coordinate of a share from which the climb to its most likely value starts: a fifth, a half, and
#: nine tenths.
_SHARES = (-1.4, 0.0, 2.2)


class ByOutput(ErrorModel):
    """White noise and a part that is not, for each output: total variance, share, and a length.

    Of output ``b`` the coordinates are ``ln v_b``, ``logit share_b`` and ``ln length_b``; they
    stand at ``b``, ``s + b`` and ``2 s + b``.
    """

    #: Rough standard deviations of the logit of a share and of a logarithm of a length.
    _SHARE_SD, _LENGTH_SD = 0.3, 0.3

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        frame.sampled()

    @abstractmethod
    def of_output(self, run: int, residual: Array, eta: Array) -> Array:
        """Log-likelihood, shape (L,), of one output's residuals (L, n); eta (L, 3)."""

    @abstractmethod
    def products_of_output(self, run: int, columns: Array, eta: Array) -> Array:
        """``C V^-1 C'``, shape (k, k), of one output's rows (k, n); eta (3,)."""

    def _part(self, eta: Array, b: int) -> Array:
        s = len(self.frame.outputs)
        return np.ascontiguousarray(eta[..., [b, s + b, 2 * s + b]])

    def of_run(self, run: int, residual: Array, eta: Array) -> Array:
        total = np.zeros(len(eta))
        for b in range(len(self.frame.outputs)):
            row = np.ascontiguousarray(residual[:, b])
            total += self.of_output(run, row, self._part(eta, b))
        return total

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        parts = [
            self.products_of_output(run, np.ascontiguousarray(rows), self._part(eta, b))
            for b, rows in enumerate(columns)
        ]
        return np.asarray(sum(parts))

    def start(self, residuals: Sequence[Array]) -> Array:
        s, sizes = len(self.frame.outputs), log_mean_squares(residuals)
        eta = np.empty(len(self.quantities))
        for b in range(s):
            quantities = [self.quantities[k] for k in (b, s + b, 2 * s + b)]
            prior = quantities[2].prior
            assert prior is not None
            middle = float(np.log(prior.mean))

            def height(trial: Array, b: int = b, quantities: list = quantities) -> Array:
                total = np.zeros(len(trial))
                for k, quantity in enumerate(quantities):
                    total += quantity.log_prior(np.ascontiguousarray(trial[:, k]))
                for run, e in enumerate(residuals):
                    total += self.of_output(run, np.repeat(e[None, b], len(trial), axis=0), trial)
                return total

            guesses = [np.array([sizes[b], share, middle]) for share in _SHARES]
            eta[[b, s + b, 2 * s + b]] = climb(height, guesses)
        return eta

    def spread(self) -> Array:
        s, sd = len(self.frame.outputs), super().spread()
        sd[s : 2 * s], sd[2 * s :] = self._SHARE_SD, self._LENGTH_SD
        # A variance that is partly not white is known from far fewer independent values.
        sd[:s] = np.maximum(sd[:s], 0.1)
        return sd
