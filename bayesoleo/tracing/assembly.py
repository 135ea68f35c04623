"""A model in the making: the declared equations, the channel that drives them, and the effects added so far.

Effects of physics change the model in its own drive, sensor effects the channels of the driven one; both are kept apart so that
either can be added after the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bayesoleo.effects import Candidate, Effect, Scales, candidates, catalogue
from bayesoleo.errors import ModelError
from bayesoleo.model import Model, Parameter, driven_by

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
    added : tuple of (str, str)
        All effects in the order in which they were added.
    """

    native: Model
    drive: str | None = None
    sensors: tuple[tuple[Effect, str, Scales], ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    added: tuple[Added, ...] = ()

    def model(self) -> Model:
        """The driven model with everything in it."""
        model = self.native if self.drive is None else driven_by(self.native, self.drive)
        for effect, target, scales in self.sensors:
            model = effect.extend(model, target, scales).model
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
        return self.with_parameters({name: replace(present[name], value=value) for name, value in values.items()})

    def options(self, scales: Scales, effects: tuple[Effect, ...] | None = None) -> list[Option]:
        """Every effect at every place where it applies, ready to be scored.

        An effect that leaves no unique inverse for the drive is left out: it cannot be solved for.
        """
        chosen = catalogue() if effects is None else effects
        physics = tuple(effect for effect in chosen if effect.family != "sensor")
        channels = tuple(effect for effect in chosen if effect.family == "sensor")
        found = []
        for candidate in candidates(self.native, scales, physics):
            found += _attempt(candidate, replace(self, native=candidate.model, added=(*self.added, _key(candidate))))
        driven = self.model()
        by_id = {effect.id: effect for effect in channels}
        for candidate in candidates(driven, scales, channels):
            effect = by_id[candidate.effect]
            new = {name: candidate.model.parameters[name] for name in _new_names(driven, candidate.model)}
            found += _attempt(
                candidate,
                replace(
                    self,
                    sensors=(*self.sensors, (effect, candidate.target, scales)),
                    parameters={**self.parameters, **new},
                    added=(*self.added, _key(candidate)),
                ),
            )
        return found


def _key(candidate: Candidate) -> Added:
    return candidate.effect, candidate.target


def _new_names(old: Model, new: Model) -> list[str]:
    return [name for name in new.parameters if name not in old.parameters]


def _attempt(candidate: Candidate, assembly: Assembly) -> list[Option]:
    try:
        return [Option(candidate, assembly, assembly.model())]
    except ModelError:
        return []
