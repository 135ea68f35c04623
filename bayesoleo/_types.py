"""Array types that all modules share, and the notation of their shapes.

``Float[Array, "runs outputs"]`` is an array of real numbers with two dimensions; for one dimension
the text begins with a space. Within a class or a function, dimensions of one name have one size;
those whose names begin with an underscore may differ. Type checkers see the array only; tests check
results against the shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool as Bool, Complex as Complex, Float as Float, Int as Int

if TYPE_CHECKING:
    from numpy.typing import NDArray

    #: Real numbers in double precision.
    Array = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]
    #: Indices and counts.
    Integers = NDArray[np.int64]
    #: What holds and what does not.
    Flags = NDArray[np.bool_]
else:  # shapes are checked of classes, which aliases with a dtype are not
    Array = ComplexArray = Integers = Flags = np.ndarray

#: Called with a sentence on what is being done.
ProgressCallback = Callable[[str], None]
