"""Settings: everything that a result depends on besides data and model.

A new setting is one field. Its metadata hold the option of the command line; fields without
metadata are set from Python only. This file imports no numerics, so that ``--help`` comes at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from importlib.util import find_spec
from numbers import Integral
from typing import TYPE_CHECKING, Any, cast

from bayesoleo.errors import InputError, MissingExtraError, choose

if TYPE_CHECKING:
    from bayesoleo.discovery._inference import Inference
    from bayesoleo.discovery._numerics import Numerics
    from bayesoleo.discovery._policy import SearchPolicy
    from bayesoleo.discovery._structures import StructurePrior
    from bayesoleo.effects._effect import Effect

RUNNING, SOLVING = "How it is run", "How the model is solved"
ERRORS, MISSING = "What is assumed about errors", "What may be missing"
SCHEMES = ("radau2", "radau3", "gauss2", "gauss3", "thesis")
DISTURBANCES = ("drift", "tone", "tails")
SOLVERS = ("collocation", "adaptive", "shooting", "hybrid", "library")
#: Key of a field's metadata under which its option is.
OPTION = "option"


@dataclass(frozen=True)
class SettingOption:
    """The option of a setting.

    Parameters
    ----------
    kind : type
        Type of one value, as the command line reads it.
    help : str
        Text of ``--help``.
    panel : str
        Heading in ``--help``.
    default : object
        Value where the option is not given.
    read : callable or None
        Makes the setting from the value; called only where it is not None.
    shown : mapping of str to object
        Further keywords of ``typer.Option``, such as ``metavar`` and ``min``.
    """

    kind: Any
    help: str
    panel: str
    default: Any
    read: Callable[[Any], Any] | None
    shown: dict[str, Any]


def _setting(
    default: Any,
    kind: Any,
    panel: str,
    text: str,
    *,
    read: Callable[..., Any] | None = None,
    **shown: Any,
) -> Any:
    """A field with an option; a tuple is written with commas on the command line."""
    value = ",".join(default) if isinstance(default, tuple) else default
    option = SettingOption(kind, text, panel, value, read, shown)
    return field(default=default, metadata={OPTION: option})


def words(text: str) -> tuple[str, ...]:
    """Words separated by commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


#: What a setting may be, what it is called, and an example, by the start of its annotation.
_KINDS: dict[str, tuple[Any, str, str]] = {
    "int": (Integral, "a whole number", "{least}"),
    "bool": (bool, "True or False", "True"),
    "str": (str, "text", '"…"'),
    "tuple[str": (tuple, "a sequence of names", '("{word}",)'),
    "tuple[Effect": (
        tuple, "a sequence of effects", '(bayesoleo.effects.find_effect("{word}"),)',
    ),
    "SearchPolicy": (object, "a SearchPolicy", ""),
    "StructurePrior": (object, "a StructurePrior", ""),
}  # fmt: skip


def _check_kind(item: Field[Any], value: Any) -> None:
    """Refuse a value that is no whole number, text, … where the setting is one."""
    start = next(start for start in _KINDS if str(item.type).startswith(start))
    kind, called, example = _KINDS[start]
    if value is None and "None" in str(item.type):
        return
    right = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    if right and kind is tuple:
        right = all(isinstance(one, str) == (start == "tuple[str") for one in value)
    option = item.metadata.get(OPTION)
    least = None if option is None else option.shown.get("min")
    if not right:
        value = getattr(value, "id", value)  # of a single effect
        words_ = [value, *value] if isinstance(value, tuple | str) else []
        word = next((one for one in words_ if isinstance(one, str)), "…")
        hint = f"write {item.name}={example.format(word=word, least=least)}"
        raise InputError(f"is not {called}", key=item.name, value=value, hint=hint)
    if least is not None and value < least:
        hint = f"write {item.name}={least} or more"
        raise InputError("is too small", key=item.name, value=value, hint=hint)


def _disturbances(text: str) -> tuple[str, ...]:
    """Kinds of disturbances; ``none`` stands for none of them."""
    return () if text.strip() == "none" else words(text)


def _effects(text: str) -> tuple[Effect, ...]:
    """Load the effects of a file, after those of the catalogue."""
    from bayesoleo._workflow.model_files import load_effects

    return load_effects(text)


def _search_policy() -> SearchPolicy:
    from bayesoleo.discovery._policy import SearchPolicy

    return SearchPolicy()


def _structure_prior() -> StructurePrior:
    from bayesoleo.discovery._structures import StructurePrior

    return StructurePrior()


#: Parts of the prior of structures that an option gives; they share one.
PRIOR_PARTS = ("nothing", "catalogue", "outside")
_PRIOR_FLAG, _PRIOR_EXAMPLE = "--structure-prior", "write nothing=0.45,catalogue=0.35,outside=0.2"


def _read_prior(text: str) -> StructurePrior:
    """The prior of structures from ``nothing=0.8,outside=0.1``; parts that are left out share the
    rest in the proportion of their defaults."""
    default = _structure_prior()
    given: dict[str, float] = {}
    for item in words(text):
        name, _, number = item.partition("=")
        name = name.strip()
        if name not in PRIOR_PARTS:
            hint = f"use {', '.join(PRIOR_PARTS)}; {_PRIOR_EXAMPLE}"
            raise InputError("no part of this prior", key=_PRIOR_FLAG, value=item, hint=hint)
        try:
            given[name] = float(number)
        except ValueError:
            hint = _PRIOR_EXAMPLE
            raise InputError("no number", key=_PRIOR_FLAG, value=item, hint=hint) from None
    left = {name: getattr(default, name) for name in PRIOR_PARTS if name not in given}
    rest = 1.0 - sum(given.values())
    if left and not rest > 0:
        raise InputError(
            "leaves no probability for the other parts", key=_PRIOR_FLAG, value=text,
            hint=f"parts must add up to less than one, or give all: {_PRIOR_EXAMPLE}",
        )  # fmt: skip
    given |= {name: rest * weight / sum(left.values()) for name, weight in left.items()}
    found = replace(default, **cast(dict[str, Any], given))
    _check_prior(found, {}, _PRIOR_FLAG)
    return found


def _check_prior(prior: StructurePrior, known: Mapping[str, Collection[str]], key: str) -> None:
    """Refuse a prior of structures that allows no logarithm, or names no family or effect."""
    parts: dict[str, Any] = {name: getattr(prior, name) for name in PRIOR_PARTS}
    parts |= {f"numbers[{k}]": number for k, number in enumerate(prior.numbers)}
    for kind in ("families", "effects"):
        weights = getattr(prior, kind)
        parts |= {f"{kind}[{name!r}]": weight for name, weight in weights.items()}
    for name, value in parts.items():
        if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
            raise InputError(
                "must be a finite number above zero", key=f"{key}.{name}", value=value,
                hint="write a small number, such as 1e-6, for what is nearly impossible",
            )  # fmt: skip
    if not prior.numbers:
        hint = "write (0.75, 0.2, 0.04, 0.01) for one, two, three and four effects"
        raise InputError("is empty", key=f"{key}.numbers", value=prior.numbers, hint=hint)
    for kind, names in known.items():
        for name in getattr(prior, kind).keys() - names:
            hint = choose(name, sorted(names), len(names) if kind == "families" else 3)
            one = {"families": "family", "effects": "effect"}[kind]
            raise InputError(f"unknown {one}", key=f"{key}.{kind}", value=name, hint=hint)


#: The setting is made where it is needed, so that ``--help`` needs no numerics.
_PRIOR_OPTION = SettingOption(
    str | None,
    "Prior probabilities that nothing is missing, that effects of the catalogue are, and that only"
    " something outside of it is. Parts that are left out share the rest.",
    MISSING,
    None,
    _read_prior,
    {
        "metavar": "PART=P,…",
        "show_default": "nothing=0.45,catalogue=0.35,outside=0.2",
    },
)


@dataclass(frozen=True)
class Settings:
    """Everything that a result depends on besides data and model.

    Parameters
    ----------
    seed : int
        Everything random follows from it.
    jobs : int, optional
        Threads; by default all cores. Results do not depend on it.
    scheduler : str, optional
        Other processes or machines that take part: ``local:4``, or the address of a Dask scheduler.
        Results do not depend on them either.
    quick : bool
        Draw enough for two-digit intervals only, and end a search early that takes minutes.
    effective_size : int
        Effective draws asked of the sampler.
    sampler : {"ensemble", "nuts"}
        Of the posterior: ensembles of walkers, or the no-U-turn sampler, which follows gradients
        and starts over where it was stopped. It needs nutpie, and draws in threads of this process
        whatever the ``scheduler``.
    scheme : str
        Discretisation: ``radau3`` …, or ``thesis``.
    solver : {"collocation", "adaptive", "shooting", "hybrid", "library"}
        Of periodic runs; see :func:`~bayesoleo.prediction.periodic_orbit`.
    steps : int, optional
        Steps of the mesh in a period; by default refined until the estimate no longer moves.
    max_effects : int
        Effects added at most.
    drive : str, optional
        Channel that drives the model; ``"model"`` keeps the model's own inputs. By default the
        channel that the rig controls, if the model can be driven by it.
    effects : tuple of Effect, optional
        Instead of the catalogue.
    without : tuple of str
        Ids of effects that are left out of the search, at all their places; ``nonparametric``
        leaves out functions without a name.
    command : str
        Kept in the result.
    nuisance : tuple of {"conditions", "offset", "gain"}
        What is estimated within its declared tolerance: conditions by run (``sd``), offset and gain
        of sensors (``accuracy``).
    error_model : {"auto", "independent", "per-run", "full", "correlated", "discrepancy", ...}
        What the errors of the outputs have in common; see
        :mod:`bayesoleo.error_models`. By default the data decide: ``correlated`` where noise is
        coloured, ``spectral`` where that of measured inputs or of transients makes another
        covariance of the estimate, ``catalogue`` where more than noise is left (``power`` where
        that would let the priors decide, or explains nothing), else ``independent``.
    between_runs : tuple of str
        Parameters that scatter between runs about a mean that is estimated
        (:func:`bayesoleo.posterior.hierarchical`).
    disturbances : tuple of {"drift", "tone", "tails"}
        What is looked for in the outputs of periodic runs, and removed before physics is named.
    next_run : str
        What the next run is proposed for: ``"structures"``, which one is true; ``"parameters"``,
        the precision of all parameters; or the name of one parameter.
    policy : SearchPolicy
        The numbers by which the search for missing effects decides.
    structure_prior : StructurePrior
        Prior probabilities that nothing is missing, that effects of the catalogue are, and that
        something outside of it is; see :class:`~bayesoleo.discovery.StructurePrior`.
    """

    seed: int = _setting(
        0, int, RUNNING, "The same seed gives the same result, whatever the number of threads.",
        min=0, metavar="N",
    )  # fmt: skip
    jobs: int | None = _setting(
        None,
        int | None,
        RUNNING,
        "Threads, and processes that share a search.",
        min=1,
        metavar="N",
        show_default="all cores",
    )
    quick: bool = _setting(
        False, bool, RUNNING,
        "Draw enough for intervals of two digits only, and end a long search early.",
    )  # fmt: skip
    effective_size: int = _setting(
        1000, int, RUNNING, "Draw until every parameter has this effective sample size.",
        min=10, metavar="N",
    )  # fmt: skip
    sampler: str = _setting(
        "ensemble", str, RUNNING,
        "Sampler of the posterior: ensemble, or nuts, which follows gradients (in threads of this "
        "process). A run of nuts that is stopped starts over.",
        metavar="ensemble|nuts",
    )  # fmt: skip
    scheme: str = _setting(
        "radau3", str, SOLVING,
        f"Discretisation: {', '.join(SCHEMES)} (second-order backward differences).",
        metavar="NAME",
    )  # fmt: skip
    steps: int | None = _setting(
        None, int | None, SOLVING, "Steps a period.",
        min=8, metavar="N", show_default="refined until the estimate stays",
    )  # fmt: skip
    max_effects: int = _setting(
        6, int, MISSING, "Add at most this many effects.", min=0, metavar="N"
    )
    drive: str | None = _setting(
        None, str | None, SOLVING, "Channel that drives the model; 'model' keeps its own inputs.",
        metavar="CHANNEL|model", show_default="what the campaign says is controlled",
    )  # fmt: skip
    effects: tuple[Effect, ...] | None = _setting(
        None, str | None, MISSING,
        "Effects of your own, one or a list, besides the built-in ones. A file is code.",
        read=_effects, metavar="FILE.py:OBJECT", show_default=False,
    )  # fmt: skip
    command: str = ""
    nuisance: tuple[str, ...] = _setting(
        (), str, ERRORS,
        "Estimate within declared tolerances: conditions (sd), sensors' offset and gain "
        "(accuracy).",
        read=words, metavar="conditions,offset,gain", show_default=False,
    )  # fmt: skip
    error_model: str = _setting(
        "auto", str, ERRORS,
        "What errors have in common: independent (one variance an output), per-run, full "
        "(outputs correlated), correlated (in time), discrepancy (repeats every period), "
        "shared-discrepancy (and is partly alike in all runs), catalogue (all effects that the "
        "model might lack), power (independent, by effective samples), spectral (independent, as "
        "wide as the spectra of the noise make the estimate). The default, auto, chooses among "
        "independent, correlated, catalogue, power and spectral by what the data show, and says "
        "why.",
        metavar="NAME",
    )  # fmt: skip
    between_runs: tuple[str, ...] = _setting(
        (), str, ERRORS,
        "Parameters that scatter between runs: mean and spread are estimated with them.",
        read=words, metavar="NAME,…", show_default=False,
    )  # fmt: skip
    scheduler: str | None = _setting(
        None, str | None, RUNNING,
        "Other machines that take part, by the address of a Dask scheduler, or N processes of "
        "this one. The result is the same.",
        metavar="ADDRESS|local:N", show_default="threads of this process",
    )  # fmt: skip
    without: tuple[str, ...] = _setting(
        (), str, MISSING,
        "Effects to leave out of the search; 'nonparametric' leaves out smooth functions.",
        read=words, metavar="EFFECT,…", show_default=False,
    )  # fmt: skip
    solver: str = _setting(
        "collocation", str, SOLVING, f"Solver of periodic runs: {', '.join(SOLVERS)}.",
        metavar="NAME",
    )  # fmt: skip
    disturbances: tuple[str, ...] = _setting(
        DISTURBANCES, str, ERRORS,
        "What is no physics and is removed from the outputs of periodic runs where it is found: "
        "drift, tone (no harmonic), tails (outliers); 'none' for nothing.",
        read=_disturbances, metavar="drift,tone,tails",
    )  # fmt: skip
    next_run: str = _setting(
        "structures", str, MISSING,
        "What the next run is proposed for: structures (which one is true), parameters (all more "
        "precise), or the name of one parameter.",
        metavar="structures|parameters|NAME",
    )  # fmt: skip
    policy: SearchPolicy = field(default_factory=_search_policy)
    structure_prior: StructurePrior = field(
        default_factory=_structure_prior, metadata={OPTION: _PRIOR_OPTION}
    )

    def __post_init__(self) -> None:
        from bayesoleo.effects._nonparametric import FAMILY
        from bayesoleo.error_models._registry import check_word
        from bayesoleo.prediction._periodic_solver import check_solver

        for item in fields(self):
            value = getattr(self, item.name)
            if item.type.startswith("tuple") and isinstance(value, list | set):  # of notebooks
                object.__setattr__(self, item.name, tuple(value))
            _check_kind(item, getattr(self, item.name))
        if self.scheme not in SCHEMES:
            hint = choose(self.scheme, SCHEMES)
            raise InputError("unknown scheme", key="scheme", value=self.scheme, hint=hint)
        check_solver(self.solver, self.scheme)
        check_word(self.error_model, automatic=True)
        self._check_sampler()
        for kind in self.disturbances:
            if kind not in DISTURBANCES:
                raise InputError(
                    "unknown disturbance", key="disturbances", value=kind,
                    hint=f"some of {', '.join(DISTURBANCES)}, or () for none",
                )  # fmt: skip
        self._check_structure_prior()
        known = [effect.id for effect in self._offered] + [FAMILY]
        for name in self.without:
            if name not in known:
                hint = choose(name, known, 3)
                raise InputError("unknown effect", key="without", value=name, hint=hint)

    def _check_sampler(self) -> None:
        if self.sampler == "ensemble":
            return
        from bayesoleo.posterior._sampler import check_sampler

        check_sampler(self.sampler)
        if find_spec("nutpie") is None:
            # Before a search of hours, not after it.
            raise MissingExtraError("nutpie", "nuts")

    def _check_structure_prior(self) -> None:
        from bayesoleo.discovery._structures import StructurePrior
        from bayesoleo.effects._catalogue import catalogue

        if not isinstance(self.structure_prior, StructurePrior):
            raise InputError(
                "no prior of structures", key="structure_prior", value=self.structure_prior,
                hint="write bayesoleo.discovery.StructurePrior(nothing=0.8)",
            )  # fmt: skip
        every = (*self._offered, *catalogue())
        known = {"families": {e.family for e in every}, "effects": {e.id for e in every}}
        _check_prior(self.structure_prior, known, "structure_prior")

    @property
    def _offered(self) -> tuple[Effect, ...]:
        from bayesoleo.effects._catalogue import catalogue

        return catalogue() if self.effects is None else self.effects

    @property
    def left_out(self) -> int:
        """Number of effects of the catalogue that are not looked for."""
        from bayesoleo.effects._catalogue import catalogue

        searched = {effect.id for effect in self.searched}
        return sum(effect.id not in searched for effect in catalogue())

    @property
    def searched(self) -> tuple[Effect, ...]:
        """The effects that are looked for."""
        return tuple(effect for effect in self._offered if effect.id not in self.without)

    @property
    def nonparametric(self) -> bool:
        """Whether a function without a name may be added."""
        from bayesoleo.effects._nonparametric import FAMILY

        return FAMILY not in self.without

    @property
    def inference(self) -> Inference:
        """Assumptions about errors and about runs."""
        from bayesoleo.discovery._inference import Inference

        return Inference(self.error_model, self.between_runs)

    @property
    def numerics(self) -> Numerics:
        """How models are solved."""
        from bayesoleo.discovery._numerics import Numerics

        return Numerics(
            self.scheme,
            self.steps,
            self.jobs,
            scheduler=self.scheduler,
            solver=self.solver,
            policy=self.policy,
        )
