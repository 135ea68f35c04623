"""A model as plain dicts of text and numbers, and back, for stored results.

Nothing is pickled: a document holds declarations only, and is parsed like any other declaration.
"""

from __future__ import annotations

import dataclasses
from dataclasses import asdict
from typing import Any

from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import as_text
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Condition, Dof, Output, Parameter
from bayesoleo.model._priors import LogNormal, Normal, Prior, TruncatedNormal, Uniform

_PRIORS: dict[str, type[Any]] = {
    kind.__name__: kind for kind in (Normal, Uniform, LogNormal, TruncatedNormal)
}


def to_document(model: Model) -> dict[str, Any]:
    """Describe a model in JSON's terms; numbers that JSON lacks (infinite bounds) become text."""
    return {
        "name": model.name,
        "description": model.description,
        "inputs": dict(model.inputs),
        "conditions": {name: asdict(item) for name, item in model.conditions.items()},
        "dofs": {
            name: {
                "unit": d.unit,
                "guess": _text(d.guess),
                "description": d.description,
                "initial": _text(d.initial),
                "initial_rate": _text(d.initial_rate),
            }
            for name, d in model.dofs.items()
        },
        "parameters": {name: _parameter(item) for name, item in model.parameters.items()},
        "definitions": {name: _text(body) for name, body in model.definitions.items()},
        "equations": {
            name: {term: _text(body) for term, body in terms.items()}
            for name, terms in model.equations.items()
        },
        "outputs": {
            name: {
                "terms": {term: _text(body) for term, body in model.output_terms(name).items()},
                "unit": output.unit,
                "description": output.description,
            }
            for name, output in model.outputs.items()
        },
        "admissible": [_text(body) for body in model.admissible],
    }


def from_document(document: dict[str, Any]) -> Model:
    """The model that a document describes.

    Raises
    ------
    ModelError
        If it describes none.
    """
    try:
        return Model(
            name=document["name"],
            description=document["description"],
            inputs=document["inputs"],
            conditions={name: Condition(**item) for name, item in document["conditions"].items()},
            dofs={name: Dof(**item) for name, item in document["dofs"].items()},
            parameters={name: _declared(item) for name, item in document["parameters"].items()},
            definitions=document["definitions"],
            equations=document["equations"],
            outputs={name: Output(**item) for name, item in document["outputs"].items()},
            admissible=document["admissible"],
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ModelError("not the description of a model", value=str(error)) from error


def _text(body: Any) -> Any:
    return body if body is None or isinstance(body, str | int | float) else as_text(body)


def _parameter(item: Parameter) -> dict[str, Any]:
    prior = None
    if item.prior is not None:
        fields = dataclasses.fields(item.prior)  # type: ignore[arg-type]
        stated = [(field.name, getattr(item.prior, field.name)) for field in fields]
        values = {key: repr(float(value)) for key, value in stated}
        prior = {"kind": type(item.prior).__name__, **values}
    return {
        "value": item.value,
        "unit": item.unit,
        "prior": prior,
        "fixed": item.fixed,
        "by_run": item.by_run,
        "description": item.description,
        "latex": item.latex,
        "nuisance": item.nuisance,
    }


def _declared(item: dict[str, Any]) -> Parameter:
    prior: Prior | None = None
    if item["prior"] is not None:
        kind, *rest = item["prior"].items()
        prior = _PRIORS[kind[1]](**{key: float(value) for key, value in rest})
    return Parameter(**{**item, "prior": prior})
