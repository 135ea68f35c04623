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
    from bayesoleo.data import Campaign as Campaign
    from bayesoleo.data import load_campaign as load_campaign
    from bayesoleo.data import write_campaign as write_campaign
    from bayesoleo.effects import Effect as Effect
    from bayesoleo.effects import catalogue as catalogue
    from bayesoleo.effects import find_effect as find_effect
    from bayesoleo.effects import force_effect as force_effect
    from bayesoleo.errors import BayesoleoError as BayesoleoError
    from bayesoleo.errors import InputError as InputError
    from bayesoleo.forecast import predict as predict
    from bayesoleo.model import Condition as Condition
    from bayesoleo.model import Dof as Dof
    from bayesoleo.model import LogNormal as LogNormal
    from bayesoleo.model import Model as Model
    from bayesoleo.model import Normal as Normal
    from bayesoleo.model import Output as Output
    from bayesoleo.model import Parameter as Parameter
    from bayesoleo.model import TruncatedNormal as TruncatedNormal
    from bayesoleo.model import Uniform as Uniform
    from bayesoleo.model import driven_by as driven_by
    from bayesoleo.modelfile import load_model as load_model
    from bayesoleo.report import print_summary as print_summary
    from bayesoleo.report import write_report as write_report
    from bayesoleo.storage import read_tree as read_tree
    from bayesoleo.storage import write_tree as write_tree
    from bayesoleo.systems import system as system
    from bayesoleo.workflow import Settings as Settings
    from bayesoleo.workflow import check as check
    from bayesoleo.workflow import close as close
    from bayesoleo.workflow import estimate as estimate
    from bayesoleo.workflow import estimate_each as estimate_each
    from bayesoleo.workflow import propose as propose
    from bayesoleo.workflow import reduce as reduce
    from bayesoleo.workflow import sample as sample
    from bayesoleo.workflow import simulate as simulate
    from bayesoleo.workflow import trace as trace

    __version__: str

#: Where each name comes from; a test holds it against the imports above.
_HOMES = {
    "data": ("Campaign", "load_campaign", "write_campaign"),
    "effects": ("Effect", "catalogue", "find_effect", "force_effect"),
    "errors": ("BayesoleoError", "InputError"),
    "forecast": ("predict",),
    "model": (
        "Condition",
        "Dof",
        "LogNormal",
        "Model",
        "Normal",
        "Output",
        "Parameter",
        "TruncatedNormal",
        "Uniform",
        "driven_by",
    ),
    "modelfile": ("load_model",),
    "report": ("print_summary", "write_report"),
    "storage": ("read_tree", "write_tree"),
    "systems": ("system",),
    "workflow": (
        "Settings",
        "check",
        "close",
        "estimate",
        "estimate_each",
        "propose",
        "reduce",
        "sample",
        "simulate",
        "trace",
    ),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
#: Subpackages that are there without an import of their own, as ``bayesoleo.plots``.
_SUBPACKAGES = (
    "assessment",
    "data",
    "effects",
    "errors",
    "estimation",
    "model",
    "plots",
    "posterior",
    "report",
    "schema",
    "solvers",
    "storage",
    "systems",
    "tracing",
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
