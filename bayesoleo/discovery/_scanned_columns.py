"""What all candidates change in the outputs at one estimate, kept from a score for what follows it.

The choice of an error model needs the same sensitivities as the last scores of a search: at the
same estimate, samples and shapes, on steps that show no difference. They are handed on rather than
computed again.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

from bayesoleo.discovery._assembly import Assembly, Option
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._score_basis import Block
from bayesoleo.effects._effect import Effect
from bayesoleo.solvers._orbit import Status

#: Bytes of columns from which they are computed anew where they are needed: they are held during
#: all that lies between, and most searches never need them.
MOST_KEPT = 2**28

#: Of one candidate by set of shapes, or why there are none.
Columns = list[Block] | Status


class Scanned:
    """Columns of all candidates beside one estimate; they are handed on once, and not pickled.

    Parameters
    ----------
    fit : ModelFit
        At whose estimate they were computed.
    assembly : Assembly
        What was fitted.
    effects : sequence of Effect or None
        That were looked for; None is the catalogue.
    options : sequence of Option
    columns : sequence of list of Block, or Status
        By option.
    """

    def __init__(
        self,
        fit: ModelFit,
        assembly: Assembly,
        effects: Sequence[Effect] | None,
        options: Sequence[Option],
        columns: Sequence[Columns],
    ):
        self._of = fit.point, assembly, effects
        self._found: tuple[Sequence[Option], Sequence[Columns]] | None = options, columns

    def take(
        self, fit: ModelFit, assembly: Assembly, effects: Sequence[Effect] | None
    ) -> tuple[Sequence[Option], Sequence[Columns]] | None:
        """Options and their columns; None where another estimate's, or taken before."""
        found, self._found = self._found, None
        same_point, same_assembly, same_effects = self._of
        same = same_point is fit.point and same_assembly is assembly
        if found is None or not same or not _equal(same_effects, effects):
            return None
        return found

    def drop(self) -> None:
        """Forget the columns: nothing needs them any more."""
        self._found = None

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        # A search that is resumed computes them anew: they are many times its own size.
        return type(None), ()


def _equal(some: Sequence[Effect] | None, others: Sequence[Effect] | None) -> bool:
    if some is None or others is None:
        return some is others
    return tuple(some) == tuple(others)


def size_of(fit: ModelFit, options: Sequence[Option]) -> int:
    """Bytes of the columns of some options beside a fit."""
    samples = sum(record.time.size for record in fit.records)
    columns = 0
    for option in options:
        # An unknown of one run's own has a column in that run alone.
        unknowns, shapes = len(option.candidate.parameters), option.candidate.shapes
        columns += unknowns * prod(len(values) for values in shapes.values())
    return 8 * columns * samples * len(fit.predictor.outputs)
