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
    from bayesoleo.data import write_campaign as write_campaign
    from bayesoleo.model import Model as Model
    from bayesoleo.model import Output as Output
    from bayesoleo.model import Parameter as Parameter
    from bayesoleo.modelfile import load_model as load_model
    from bayesoleo.session import Campaign as Campaign
    from bayesoleo.session import Explanation as Explanation
    from bayesoleo.session import Fit as Fit
    from bayesoleo.session import Posterior as Posterior
    from bayesoleo.session import Problem as Problem
    from bayesoleo.session import load_campaign as load_campaign
    from bayesoleo.session import load_result as load_result
    from bayesoleo.systems import system as system
    from bayesoleo.workflow import Settings as Settings

    __version__: str

#: Where each name comes from; a test holds it against the imports above.
_HOMES = {
    "data": ("write_campaign",),
    "model": ("Model", "Output", "Parameter"),
    "modelfile": ("load_model",),
    "session": (
        "Campaign",
        "Explanation",
        "Fit",
        "Posterior",
        "Problem",
        "load_campaign",
        "load_result",
    ),
    "systems": ("system",),
    "workflow": ("Settings",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
#: Subpackages that are there without an import of their own, as ``bayesoleo.plots``.
_SUBPACKAGES = (
    "assessment",
    "data",
    "effects",
    "errors",
    "estimation",
    "forecast",
    "model",
    "plots",
    "posterior",
    "report",
    "schema",
    "session",
    "solvers",
    "storage",
    "systems",
    "tracing",
    "workflow",
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
