"""Identify nonlinear dynamic systems from measured periodic data, and find the effect they lack.

The names below are what most work needs; the rest is in the subpackages. Nothing is imported
before it is used, so that ``import bayesoleo`` costs nothing.

Examples
--------
>>> import bayesoleo
>>> model = bayesoleo.system("duffing")
>>> list(model.inputs), list(model.outputs)
(['force'], ['displacement'])
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bayesoleo._session import (
        Campaign as Campaign,
        Explanation as Explanation,
        Fit as Fit,
        Posterior as Posterior,
        Problem as Problem,
        load_campaign as load_campaign,
        load_result as load_result,
    )
    from bayesoleo._workflow import Settings as Settings, close_each as close_each
    from bayesoleo._workflow.model_files import load_model as load_model
    from bayesoleo.data import write_campaign as write_campaign
    from bayesoleo.model import Model as Model, Output as Output, Parameter as Parameter
    from bayesoleo.systems import system as system

    __version__: str

#: Where each name comes from; a test holds it against the imports above.
_HOMES = {
    "data": ("write_campaign",),
    "model": ("Model", "Output", "Parameter"),
    "_workflow.model_files": ("load_model",),
    "_session": (
        "Campaign",
        "Explanation",
        "Fit",
        "Posterior",
        "Problem",
        "load_campaign",
        "load_result",
    ),
    "systems": ("system",),
    "_workflow": ("Settings", "close_each"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
#: Subpackages that are there without an import of their own, as ``bayesoleo.plots``.
_SUBPACKAGES = (
    "assessment",
    "data",
    "discovery",
    "effects",
    "error_models",
    "errors",
    "estimation",
    "gallery",
    "model",
    "plots",
    "posterior",
    "prediction",
    "results",
    "solvers",
    "systems",
)

__all__ = [*sorted(_HOME), "__version__"]

if not TYPE_CHECKING:  # or a type checker would believe every name to be here

    def __getattr__(name: str) -> object:
        from importlib import import_module

        if name in _HOME:
            value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
        elif name in _SUBPACKAGES:
            return import_module(f"{__name__}.{name}")
        elif name == "__version__":
            from importlib.metadata import PackageNotFoundError, version

            try:
                value = version(__name__)
            except PackageNotFoundError:  # a source tree on the path
                value = "0+unknown"
        else:
            import difflib

            close_by = difflib.get_close_matches(name, [*_HOME, *_SUBPACKAGES], 1)
            hint = f"; did you mean {close_by[0]!r}?" if close_by else ""
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_SUBPACKAGES})
