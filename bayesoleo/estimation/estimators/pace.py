"""How long a step should be, judged by the one before it.

Linear equations that lack the residual's second derivatives can overshoot or fall short for ever,
each step lowering the merit a little. Two steps on one line tell by how much.

References
----------
Aitken (1926), "On Bernoulli's numerical solution of algebraic equations".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array

# A step that turns back by more than this part of the last one overshoots: linear equations that
# lack the residual's second derivatives can do so for ever, each step lowering the merit a little.
_OVERSHOOT = 0.3
# Among steps below a standard deviation equations are close to linear, so that less tells as much;
# what turns back by less than this gains a digit an iteration as it is.
_OVERSHOOT_NEAR = 0.1
# After so many steps in a row along one line, each longer than that part of the one before, steps
# are lengthened, at most so far: the same equations can also fall short for ever.
_STEADY = 4
_LONGEST = 10.0
# Cosine from which two steps lie on one line; off it nothing is known of the overshoot.
_ON_ONE_LINE = 0.9


@dataclass(frozen=True)
class Pace:
    """How a step compares with the one before it, by which it is shortened or lengthened.

    Near the fixed point the error along one line shrinks from ``e`` to ``(1 - s k) e``, where ``s``
    is the part of the proposed step that was taken and ``k`` how far a whole one goes. Two
    proposals on that line tell ``k``, and the part ``1/k`` goes all the way (Aitken's process,
    1926): at once where steps turn back, with care where they creep.

    Parameters
    ----------
    taken : ndarray, shape (l,)
        The last step, in scaled unknowns.
    part : float
        Of the proposal that was taken.
    idle : int
        Iterations in a row that were slow and gained nothing.
    slow : bool
        The present proposal is not much shorter than the last step.
    steady : int
        Steps in a row that crept along one line.
    wanted : float
        Part of the present proposal to take; one where nothing says otherwise.
    """

    taken: Array | None = None
    part: float = 1.0
    idle: int = 0
    slow: bool = False
    steady: int = 0
    wanted: float = 1.0

    def look(self, proposal: Array, rows: Array) -> Pace:
        """Compare a proposal with the last step in the metric ``rows' rows``."""
        if self.taken is None:
            return self
        new, old = rows @ proposal, rows @ self.taken
        lengths = float(np.linalg.norm(new)), float(np.linalg.norm(old))
        if min(lengths) == 0:
            return replace(self, slow=False, steady=0, wanted=1.0)
        cosine = float(new @ old) / (lengths[0] * lengths[1])
        ratio = lengths[0] / lengths[1]
        reach = 1 / self.part - float(np.sign(cosine)) * ratio
        on_line = abs(cosine) >= _ON_ONE_LINE
        creeps = on_line and 0 < reach < 1 - _OVERSHOOT
        steady = self.steady + 1 if creeps else 0
        wanted = 1.0
        overshoot = _OVERSHOOT_NEAR if max(lengths) < 1 else _OVERSHOOT
        if on_line and reach > 1 + overshoot:
            wanted = 1 / reach
        elif steady >= _STEADY:
            wanted = min(1 / reach, _LONGEST)
        return replace(self, slow=ratio > _OVERSHOOT, steady=steady, wanted=wanted)

    def after(self, taken: Array, part: float, idle: bool) -> Pace:
        """Pace after a step that was a part of its proposal and gained nothing, or something."""
        return Pace(taken, part, self.idle + 1 if idle and self.slow else 0, steady=self.steady)
