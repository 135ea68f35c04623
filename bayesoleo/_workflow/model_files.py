"""Models in files: objects of a user's file, and models as plain dicts in stored results.

Models and effects of a file are named on the command line as ``file.py:object``.

Nothing is pickled: a stored document holds declarations only, and is parsed like any other
declaration.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import os
import re
import sys
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from bayesoleo import model as declarations
from bayesoleo.data._campaign import CampaignData
from bayesoleo.effects._catalogue import catalogue
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._gas import undeclared
from bayesoleo.effects._places import LOOKED_FOR
from bayesoleo.errors import InputError, ModelError, ModelWarning, check_path, choose
from bayesoleo.model._expressions import as_text
from bayesoleo.model._model import Model, unused
from bayesoleo.model._parameters import Condition, Dof, Output, Parameter
from bayesoleo.model._priors import LogNormal, Normal, Prior, TruncatedNormal, Uniform
from bayesoleo.systems._systems import system

DEFAULT_OBJECT, DEFAULT_EFFECTS = "model", "effects"
_HINT = "write file.py:object"


def load_model(text: str | os.PathLike[str]) -> Model:
    """The model that a text names.

    Parameters
    ----------
    text : str or path-like
        Name of a built-in system, or ``file.py:object``; ``object`` is ``model`` where it is left
        out. A file is code: it is run here, and only when it is named.

    Returns
    -------
    Model

    Raises
    ------
    ModelError
        No such system, file or object; the object is not a model; the file raises something, which
        is told with its line.

    Warns
    -----
    ModelWarning
        If a model from a file declares what nothing in it uses, and no effect looks for by name.

    Examples
    --------
    >>> load_model("gas_spring").name
    'gas_spring'
    """
    check_path(text, "model", hint='write load_model("model.py:model") or load_model("f16n2d2")')
    text = os.fspath(text)
    file, colon, name = text.rpartition(":")
    if text.endswith(".py"):
        file, name = text, DEFAULT_OBJECT
    elif not (colon and file.endswith(".py")):
        return _built_in(text)
    path = Path(file).expanduser()
    found = vars(_run(path))
    name = name or DEFAULT_OBJECT
    if name not in found:
        raise ModelError("no such object", file=path, value=name, hint=_models_in(found, path))
    model = found[name]
    if not isinstance(model, Model):
        problem = f"{name} is not a Model but {type(model).__name__}"
        raise ModelError(problem, file=path, hint=_models_in(found, path))
    for idle, kind in unused(model).items():
        if idle in LOOKED_FOR:
            continue
        warnings.warn(
            f"file {path}: {kind} {idle} of model {model.name!r} stands in no equation and no "
            "output; nothing depends on it unless an effect does",
            ModelWarning,
            stacklevel=2,
        )
    if missing := undeclared(model):
        names = dict.fromkeys(name for lacking in missing.values() for name in lacking)
        warnings.warn(
            f"file {path}: model {model.name!r} has a gas, but {', '.join(missing)} cannot be "
            f"tried because it declares no {', no '.join(names)}; what they stand for is said "
            "under 'Names of a gas spring' in the documentation of effects",
            ModelWarning,
            stacklevel=2,
        )
    return model


def load_effects(text: str) -> tuple[Effect, ...]:
    """The catalogue, and after it the effects that a text names.

    Parameters
    ----------
    text : str
        ``file.py:object`` with an ``Effect`` or several in a list; ``object`` is ``effects`` where
        it is left out. Effects of the catalogue may be among them.

    Returns
    -------
    tuple of Effect

    Raises
    ------
    ModelError
        No such file or object; the object holds something else, or an id that is taken.
    """
    file, _, name = (text, "", "") if text.endswith(".py") else text.rpartition(":")
    if not file.endswith(".py"):
        raise ModelError("names no file of effects", value=text, hint=_HINT)
    path, name = Path(file).expanduser(), name or DEFAULT_EFFECTS
    found = vars(_run(path))
    if name not in found:
        names = [key for key, item in found.items() if isinstance(item, Effect)]
        hint = f"write {' or '.join(f'{path}:{key}' for key in names)}" if names else None
        raise ModelError("no such object", file=path, value=name, hint=hint)
    given = found[name]
    effects = list(catalogue())
    for effect in given if isinstance(given, list | tuple) else [given]:
        if not isinstance(effect, Effect):
            problem = f"{name} holds {type(effect).__name__}, not an Effect"
            raise ModelError(problem, file=path, hint="write an Effect or a list of them")
        if any(effect is known for known in effects):
            continue
        if effect.id in {known.id for known in effects}:
            hint = "choose another id"
            raise ModelError("there is an effect of this id", file=path, value=effect.id, hint=hint)
        effects.append(effect)
    return tuple(effects)


def _built_in(text: str) -> Model:
    try:
        return system(text)
    except InputError as error:
        hint = error.hint
        if Path(text).exists():
            hint = "there is a file of that name, but a model file ends in .py"
        elif any(mark in text for mark in "/\\:"):
            hint = f"{_HINT}, or the name of a built-in system (bayesoleo systems lists them)"
        raise ModelError(error.problem, value=text, hint=hint) from None


def _models_in(found: dict[str, object], path: Path) -> str:
    names = [name for name, item in found.items() if isinstance(item, Model)]
    if not names:
        return f"the file holds no Model; write {DEFAULT_OBJECT} = Model(...)"
    return f"write {' or '.join(f'{path}:{name}' for name in names)}"


def _run(path: Path) -> ModuleType:
    """Run a file as a module of its own that stays out of ``sys.modules``."""
    try:
        source = path.read_bytes()
    except FileNotFoundError:
        raise ModelError("there is no such file", file=path, hint=_HINT) from None
    except OSError as error:
        raise ModelError(f"cannot be read: {error.strerror}", file=path) from error
    # No name that a user's own module could have.
    name = f"_bayesoleo_model_{hashlib.sha256(bytes(path.resolve())).hexdigest()[:16]}"
    module = ModuleType(name)
    module.__file__ = str(path)
    try:
        with _importing_beside(path, module):
            exec(compile(source, str(path), "exec"), module.__dict__)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever the user's code raises, SystemExit too
        raise _told(error, path) from error
    return module


@contextmanager
def _importing_beside(path: Path, module: ModuleType) -> Iterator[None]:
    """While it runs, the file finds what lies beside it, and nothing is written there."""
    folder, wrote = str(path.resolve().parent), sys.dont_write_bytecode
    sys.path.append(folder)  # last, so that it hides no installed package
    sys.modules[module.__name__] = module  # dataclasses look themselves up
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        sys.dont_write_bytecode = wrote
        sys.modules.pop(module.__name__, None)
        if folder in sys.path:
            sys.path.reverse()
            sys.path.remove(folder)  # the one at the end
            sys.path.reverse()


def _told(error: BaseException, path: Path) -> ModelError:
    """What went wrong in the file, with its line, in one line."""
    line = _line(error, path)
    where = f"line {line}: " if line else ""
    if isinstance(error, InputError):
        problem, key, value, hint = error.problem, error.key, error.value, error.hint
        return ModelError(where + problem, file=path, key=key, value=value, hint=hint)
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    problem = f"{where}{type(error).__name__}: {text}".rstrip(": ")
    return ModelError(problem, file=path, hint=_keyword(text) or "correct the file")


def _keyword(text: str) -> str | None:
    """The closest keyword of a declaration, where an error says that it does not know one."""
    found = re.match(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'", text)
    declaration = getattr(declarations, found[1], None) if found else None
    if found is None or not isinstance(declaration, type):
        return None
    keywords = list(inspect.signature(declaration).parameters)
    return choose(found[2], keywords)


def _line(error: BaseException, path: Path) -> int | None:
    """Number of the last line of the file that was being run."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return error.lineno
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path)
    ]
    return lines[-1] if lines else None


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


def write_first_model(campaign: CampaignData, path: Path) -> None:
    """Write a linear model: all other channels from the first one, or a free oscillation.

    Parameters
    ----------
    campaign : CampaignData
        Whose first run gives the values to start from.
    path : Path
        Of the model file.
    """
    units = {name: unit.replace("²", "**2") for name, unit in campaign.units.items()}
    names = list(units)
    text = _relation(campaign, units, names) if len(names) > 1 else _free(campaign, units, names[0])
    path.write_text(text, encoding="utf-8")


_HEAD = '''"""A model to start from: {what}.

Written by bayesoleo init. Replace it by the physics of your system, then try
    bayesoleo check . --model model.py:model
"""

from bayesoleo import Model, Output, Parameter

'''


def _relation(campaign: CampaignData, units: Mapping[str, str], names: Sequence[str]) -> str:
    first, others = names[0], names[1:]
    run = campaign.runs[0]
    x = run.samples[first]
    terms = np.column_stack([x, np.gradient(x, run.time_step), np.ones_like(x)])
    parameters, outputs = [], []
    for name in others:
        y = run.samples[name]
        values = np.linalg.lstsq(terms, y, rcond=None)[0]
        kinds = (
            ("per", f"({units[name]})/({units[first]})"),
            ("rate", f"({units[name]})*s/({units[first]})"),
            ("offset", units[name]),
        )
        for (kind, unit), value, column in zip(kinds, values, terms.T, strict=True):
            width = max(abs(value), float(np.std(y) / max(np.std(column), 1.0)))
            parameters.append(
                f'        "{name}_{kind}": Parameter({value:.3g}, "{unit}", sd={width:.3g}),'
            )
        law = f"{name}_per*{first} + {name}_rate*dot({first}) + {name}_offset"
        outputs.append(f'        "{name}": Output("{law}", "{units[name]}"),')
    what = f"{', '.join(others)} from {first} and its rate, linear"
    return "\n".join(
        [
            _HEAD.format(what=what) + "model = Model(",
            '    "linear start",',
            f'    inputs={{"{first}": "{units[first]}"}},',
            "    parameters={",
            *parameters,
            "    },",
            "    outputs={",
            *outputs,
            "    },",
            ")",
            "",
        ]
    )


def _free(campaign: CampaignData, units: Mapping[str, str], name: str) -> str:
    run = campaign.runs[0]
    crossings = int(
        np.count_nonzero(np.diff(np.sign(run.samples[name] - run.samples[name].mean())))
    )
    span = float(run.time[-1] - run.time[0])
    rate = np.pi * max(crossings, 1) / span
    mean, scale = float(np.mean(run.samples[name])), float(np.std(run.samples[name]))
    return (
        _HEAD.format(what=f"{name} as a free, damped oscillation")
        + f"""model = Model(
    "free oscillation",
    dofs={{"motion": "{units[name]}"}},
    parameters={{
        "frequency": Parameter({rate:.3g}, "rad/s", relative_sd=0.3),
        "damping": Parameter({0.02 * rate:.3g}, "1/s", relative_sd=2.0),
        "rest": Parameter({mean:.3g}, "{units[name]}", sd={scale:.3g}),
    }},
    equations={{
        "motion": "ddot(motion) + damping*dot(motion) + frequency**2*(motion - rest)",
    }},
    outputs={{"{name}": Output("motion", "{units[name]}")}},
)
"""
    )
