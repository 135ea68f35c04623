"""What every discretisation can do."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.unrolled.program import Program

Lanes = NDArray[np.int64]


class Scheme(Protocol):
    """A discretisation of a period as linear maps (see ``solvers.schemes.collocation``)."""

    @property
    def orders(self) -> tuple[int, ...]: ...
    @property
    def state_size(self) -> int: ...
    @property
    def width(self) -> int: ...
    @property
    def program(self) -> Program | None: ...
    def lengths(self, n: int, step: float) -> Array: ...
    def phases(self, n: int) -> Array: ...
    def from_motion(self, rows_at_nodes: Array, rows_at_points: Array) -> Array: ...
    def rows(self, x: Array, lanes: Lanes, step: float, z: Array) -> None: ...
    def plan(self, phase: Array, n: int) -> Any: ...
    def sample(self, x: Array, plan: Any, step: float) -> Array: ...
    def linear(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: Lanes,
        step: float,
        *,
        initial: bool = False,
    ) -> tuple[Array, Array, NDArray[np.bool_]]: ...
