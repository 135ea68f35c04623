"""Names that a model declares and nothing in it uses: most are slips of the pen."""

from __future__ import annotations

import re

from bayesoleo.model.expressions import split_derivative
from bayesoleo.model.model import Model


def unused(model: Model) -> dict[str, str]:
    """What a model declares and nothing else in it contains.

    A definition counts as a use even where no equation needs it: it is a quantity that effects may
    act on.

    Parameters
    ----------
    model : Model
        As declared.

    Returns
    -------
    dict of str to str
        Kind of each such name: ``input``, ``parameter`` or ``condition``.

    Examples
    --------
    >>> from bayesoleo.model import Output, Parameter
    >>> spring = Model(
    ...     "spring",
    ...     inputs={"stroke": "m"},
    ...     parameters={"k": Parameter(1.0, sd=0.1), "mass": Parameter(2.0, "kg", fixed=True)},
    ...     outputs={"force": Output("k*stroke", "N")},
    ... )
    >>> unused(spring)
    {'mass': 'parameter'}
    """
    kinds = {
        "input": model.inputs,
        "parameter": model.parameters,
        "condition": model.conditions,
    }
    words = _words(model)
    return {name: kind for kind, names in kinds.items() for name in names if name not in words}


def _words(model: Model) -> set[str]:
    """Every name in an equation, output, definition, bound, guess or start."""
    expressions = [*model.definitions.values(), *model.admissible]
    for terms in model.equations.values():
        expressions += terms.values()
    for output in model.outputs:
        expressions += model.output_terms(output).values()
    found = {
        split_derivative(item)[0] for expression in expressions for item in expression.free_symbols
    }
    for dof in model.dofs.values():
        text = f"{dof.guess} {dof.initial} {dof.initial_rate}"
        found |= set(re.findall(r"[^\W\d]\w*", text))
    return found
