r"""Independent errors whose likelihood is as wide as the spectra of the noise make the estimate.

The estimate that minimises sums of squares is a good one whatever the colour of the noise, and its
covariance about the truth follows from the spectra. The likelihood of independent errors has
another width. Its argument is therefore stretched about the estimate,

.. math:: p(y | \theta) \to p(y | \hat\theta + K (\theta - \hat\theta)),

so that its curvature is that of the covariance, in each direction of the unknowns: one that noise
does not reach stays narrow beside one that it does. Unknowns are in coordinates without bounds.

References
----------
Chandler and Bate (2007), Biometrika 94(1), 167-183, eqs. 6-8.
"""

from __future__ import annotations

from bayesoleo._types import Array
from bayesoleo.error_models._base import Frame
from bayesoleo.error_models._independent import IndependentErrors
from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import InputError


class SpectralErrors(IndependentErrors):
    """Independent errors, their likelihood stretched about the estimate."""

    word = "spectral"

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        if frame.stretch is None:
            raise InputError(
                "the covariance of the estimate by the spectra of the noise is not known",
                key="error_model",
                value=self.word,
                hint='it suits a model of a campaign; else use error_model="power"',
            )
        self.stretch: Stretch = frame.stretch

    def moved(self, theta: Array) -> Array:
        return self.stretch(theta)

    def slope(self, theta: Array) -> Array:
        return self.stretch.slope(theta)
