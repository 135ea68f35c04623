"""Types of arrays that all modules share."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool as Bool
from jaxtyping import Complex as Complex
from jaxtyping import Float as Float
from jaxtyping import Int as Int
from numpy.typing import NDArray

#: Real numbers in double precision; docstrings give the shape and the unit.
Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
#: Indices and counts.
Integers = NDArray[np.int64]
#: What holds and what does not.
Flags = NDArray[np.bool_]
