"""A model in the making: the declared equations, the channel that drives them, and the effects
added so far.

Effects of physics change the model in its own drive, sensor effects the channels of the driven one;
both are kept apart so that either can be added after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from bayesoleo.effects import Candidate, Effect, Scales, candidates, catalogue
from bayesoleo.errors import ModelError
from bayesoleo.estimation.runs.nuisance import Nuisance
from bayesoleo.model import Model, Parameter, driven_by
from bayesoleo.model.expressions import split_derivative
from bayesoleo.model.initial import with_estimated_starts

#: Added effects by name: (effect, target).
Added = tuple[str, str]


@dataclass(frozen=True)
class Option:
    """A candidate together with the assembly that it would make.

    Parameters
    ----------
    candidate : Candidate
        The effect at its place.
    assembly : Assembly
        With the effect in it, at the null.
    model : Model
        That assembly's model, driven and ready to be solved.
    """

    candidate: Candidate
    assembly: Assembly
    model: Model

    @property
    def key(self) -> Added:
        """Effect and target."""
        return self.candidate.effect, self.candidate.target


@dataclass(frozen=True)
class AddedEffect:
    """One effect that was added.

    Parameters
    ----------
    effect : Effect
    target : str
        Where it sits.
    scales : Scales
        For which its constants were computed.
    amplitudes : tuple of str
        Its new parameters, at their null where the effect is absent.
    """

    effect: Effect
    target: str
    scales: Scales
    amplitudes: tuple[str, ...]


@dataclass(frozen=True)
class Assembly:
    """A declared model with a drive and added effects.

    Parameters
    ----------
    native : Model
        In its own drive, effects of physics included.
    drive : str or None
        Channel that drives it; ``None`` keeps the model's own inputs.
    sensors : tuple of (Effect, str)
        Effects on channels of the driven model, with their targets.
    parameters : mapping of str to Parameter
        Parameters of the sensor effects, which the native model does not have.
    steps : tuple of AddedEffect
        How it was assembled, in order.
    declared : Model or None
        The model before any effect; ``None`` stands for ``native``.
    nuisance : Nuisance
        Conditions and channels that are known to a tolerance only.
    starts : bool
        Whether starts that the model does not declare are estimated: there are transient runs.
    """

    native: Model
    drive: str | None = None
    sensors: tuple[tuple[Effect, str, Scales], ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    steps: tuple[AddedEffect, ...] = ()
    declared: Model | None = None
    nuisance: Nuisance = field(default_factory=Nuisance)
    starts: bool = False

    @property
    def added(self) -> tuple[Added, ...]:
        """All effects with their targets, in the order in which they were added."""
        return tuple((step.effect.id, step.target) for step in self.steps)

    def model(self) -> Model:
        """The driven model with everything in it."""
        model = self.native if self.drive is None else driven_by(self.native, self.drive)
        for effect, target, scales in self.sensors:
            model = effect.extend(model, target, scales).model
        model = self.nuisance.extend(model)
        model = with_estimated_starts(model) if self.starts else model
        return model.with_parameters(**self.parameters)

    def with_parameters(self, changed: Mapping[str, Parameter]) -> Assembly:
        """Replace parameters wherever they live."""
        native = {name: item for name, item in changed.items() if name in self.native.parameters}
        sensor = {name: item for name, item in changed.items() if name not in native}
        return replace(
            self,
            native=self.native.with_parameters(**native) if native else self.native,
            parameters={**self.parameters, **sensor},
        )

    def with_values(self, values: Mapping[str, float]) -> Assembly:
        """Set nominal values, the starts of later estimates."""
        present = self.model().parameters
        return self.with_parameters(
            {name: replace(present[name], value=value) for name, value in values.items()}
        )

    def without(self, step: AddedEffect) -> Assembly:
        """The same assembly with one effect left out, and those that act on what it brought.

        An effect acts on what another brought if it sits there, as a parameter that varies by run
        does, or follows it, as a curve follows the memory of a friction law.
        """
        declared = self.declared or self.native
        base = Assembly(declared, self.drive, nuisance=self.nuisance, starts=self.starts)
        everywhere = _undeclared(self.model())
        for other in self.steps:
            if other is step or other.target not in other.effect.places(base._base(other.effect)):
                continue
            option = base.option(other.effect, other.target, other.scales)
            if _undeclared(option.model) <= everywhere:
                base = option.assembly
        present = self.model().parameters
        kept = {name: item for name, item in present.items() if name in base.model().parameters}
        return base.with_parameters(kept)

    def options(self, scales: Scales, effects: Sequence[Effect] | None = None) -> list[Option]:
        """Every effect at every place where it applies, ready to be scored.

        An effect that leaves no unique inverse for the drive is left out: it cannot be solved for.
        """
        found, driven = [], self.model()
        for effect in catalogue() if effects is None else effects:
            base = driven if effect.on_channels else self.native  # made once for all channels
            for candidate in candidates(base, scales, (effect,)):
                try:
                    assembly = self._with_candidate(effect, candidate, scales, base)
                    found.append(Option(candidate, assembly, assembly.model()))
                except ModelError:
                    continue
        return found

    def option(self, effect: Effect, target: str, scales: Scales) -> Option:
        """One effect at one place, ready to be scored or estimated.

        Raises
        ------
        ModelError
            If it does not apply there, or leaves no unique inverse for the drive.
        """
        base = self._base(effect)
        candidate = effect.extend(base, target, scales)
        assembly = self._with_candidate(effect, candidate, scales, base)
        return Option(candidate, assembly, assembly.model())

    def _base(self, effect: Effect) -> Model:
        """The driven model if an effect sits on channels, else the equations."""
        return self.model() if effect.on_channels else self.native

    def _with_candidate(
        self, effect: Effect, candidate: Candidate, scales: Scales, base: Model
    ) -> Assembly:
        """Add an effect, given what it makes of the model that it is added to."""
        step = AddedEffect(effect, candidate.target, scales, candidate.parameters)
        grown = replace(self, steps=(*self.steps, step), declared=self.declared or self.native)
        if not effect.on_channels:
            return replace(grown, native=candidate.model)
        new = {
            name: item
            for name, item in candidate.model.parameters.items()
            if name not in base.parameters
        }
        sensors = (*self.sensors, (effect, candidate.target, scales))
        return replace(grown, sensors=sensors, parameters={**self.parameters, **new})


def _undeclared(model: Model) -> set[str]:
    """Names in a model's expressions that nothing in it declares, such as the time's."""
    expressions = [*model.definitions.values(), *model.admissible]
    expressions += [term for terms in model.equations.values() for term in terms.values()]
    expressions += [term for name in model.outputs for term in model.output_terms(name).values()]
    used = {split_derivative(item)[0] for e in expressions for item in e.free_symbols}
    known = {*model.inputs, *model.dofs, *model.parameters, *model.conditions, *model.definitions}
    return used - known
