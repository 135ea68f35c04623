"""Error models whose outputs are independent of each other, each with its own few quantities."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.error_models.base import ErrorModel, Frame, Quantity, RunSamples, log_mean_squares
from bayesoleo.error_models.fitted_start import climb

#: Coordinates of a share from which the climb to its most likely value starts: a fifth, a half, and
#: nine tenths.
_SHARES = (-0.85, 0.0, 1.3)


class ByOutput(ErrorModel):
    """White noise and a part that is not, for each output: total variance, share, and a length.

    Of output ``b`` three numbers say all: ``ln v_b``, the normal quantile of the share, and the
    logarithm of the length. The first is not a coordinate itself: samples determine far better what
    is new in each of them, given those before, than the total variance of which the part that is
    alike over long stretches is seen a few times only. The coordinate is the logarithm of the
    variance of what is new; the step between the two depends on the other coordinates alone, so
    that densities over both are equal.
    """

    data_points = "one period of one run, given the periods before it"
    #: Rough standard deviations of the logit of a share and of a logarithm of a length.
    _SHARE_SD, _LENGTH_SD = 0.3, 0.3

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        frame.sampled()

    @abstractmethod
    def of_output(self, run: int, residual: Array, eta: Array) -> Array:
        """Log-likelihood, shape (L,), of one output's residuals (L, n).

        ``eta`` (L, 3) holds ``ln v``, the share's quantile and the logarithm of the length.
        """

    @abstractmethod
    def blocks_of_output(
        self, run: int, residual: Array, eta: Array, starts: NDArray[np.int64]
    ) -> Array:
        """Log density of blocks of one output, each given those before it, shape (L, B)."""

    @abstractmethod
    def products_of_output(self, run: int, columns: Array, eta: Array) -> Array:
        """``C V^-1 C'``, shape (k, k), of one output's rows (k, n); eta (3,)."""

    @abstractmethod
    def log_new(self, share: Array, log_length: Array) -> Array:
        """Logarithm of the variance of what is new in a sample over the total, shape (W,)."""

    def _places(self, b: int) -> list[int]:
        s = len(self.frame.outputs)
        return [b, s + b, 2 * s + b]

    def _part(self, eta: Array, b: int) -> Array:
        """``ln v``, quantile of the share and logarithm of the length, (W, 3), from coordinates."""
        part = np.ascontiguousarray(eta[:, self._places(b)])
        part[:, 0] -= self.log_new(
            np.ascontiguousarray(part[:, 1]), np.ascontiguousarray(part[:, 2])
        )
        return part

    def _direct(self, eta: Array, sign: int) -> Array:
        """All of these from all coordinates (sign -1), or back (+1)."""
        out = np.array(eta, dtype=float)
        for b in range(len(self.frame.outputs)):
            first, share, length = (np.ascontiguousarray(out[:, k]) for k in self._places(b))
            out[:, b] = first + sign * self.log_new(share, length)
        return out

    def natural(self, eta: Array) -> Array:
        return super().natural(self._direct(eta, -1))

    def coordinates(self, natural: Array) -> Array:
        return self._direct(super().coordinates(natural), 1)

    def log_prior(self, eta: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return super().log_prior(self._direct(eta, -1))

    def of_run(self, run: int, residual: Array, eta: Array) -> Array:
        total = np.zeros(len(eta))
        for b in range(len(self.frame.outputs)):
            row = np.ascontiguousarray(residual[:, b])
            total += self.of_output(run, row, self._part(eta, b))
        return total

    def blocks_of_run(
        self, run: int, residual: Array, eta: Array, starts: NDArray[np.int64]
    ) -> Array:
        parts = [
            self.blocks_of_output(
                run, np.ascontiguousarray(residual[:, b]), self._part(eta, b), starts
            )
            for b in range(len(self.frame.outputs))
        ]
        return np.stack(parts, axis=1)

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        parts = [
            self.products_of_output(run, np.ascontiguousarray(rows), self._part(eta[None], b)[0])
            for b, rows in enumerate(columns)
        ]
        return np.asarray(sum(parts))

    @abstractmethod
    def draw_coloured(self, length: Array, samples: RunSamples, rng: np.random.Generator) -> Array:
        """The part that is not white, of unit variance, shape (W, n); length (W,)."""

    def draw(
        self, natural: Array, run: str, samples: RunSamples, rng: np.random.Generator
    ) -> Array:
        out = super().draw(natural, run, samples, rng)
        for b, sd in enumerate(np.sqrt(self.variance(natural, run)).T):
            _, share, length = (natural[:, k] for k in self._places(b))
            out[:, b] *= np.sqrt(1 - share)[:, None]
            out[:, b] += (sd * np.sqrt(share))[:, None] * self.draw_coloured(length, samples, rng)
        return out

    def start(self, residuals: Sequence[Array]) -> Array:
        s, sizes = len(self.frame.outputs), log_mean_squares(residuals)
        eta = np.empty(len(self.quantities))
        for b in range(s):
            quantities = [self.quantities[k] for k in self._places(b)]
            prior = quantities[2].prior
            assert prior is not None
            middle = float(np.log(prior.mean))

            def height(trial: Array, b: int = b, quantities: list[Quantity] = quantities) -> Array:
                total = np.zeros(len(trial))
                for k, quantity in enumerate(quantities):
                    total += quantity.log_prior(np.ascontiguousarray(trial[:, k]))
                for run, e in enumerate(residuals):
                    total += self.of_output(run, np.repeat(e[None, b], len(trial), axis=0), trial)
                return total

            guesses = [np.array([sizes[b], share, middle]) for share in _SHARES]
            eta[self._places(b)] = climb(height, guesses)
        return cast(Array, self._direct(eta[None], 1)[0])

    def scales(self) -> Array:
        s, sd = len(self.frame.outputs), super().scales()
        sd[s : 2 * s], sd[2 * s :] = self._SHARE_SD, self._LENGTH_SD
        return sd
