"""Types of arrays that all modules share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Real numbers in double precision; docstrings give the shape and the unit.
Array = NDArray[np.float64]
