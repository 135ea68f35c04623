"""A model with its drive and added effects, and the roles of the runs.

An assembled model holds the declared equations, the channel that drives them and the effects added
so far. Physical effects change the model in its own drive, sensor effects the channels of the
driven model. The two are kept apart so that either can be added after the other.

The role of a run says whether it is fitted or held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo.effects._catalogue import candidates, catalogue
from bayesoleo.effects._effect import Candidate, Effect
from bayesoleo.effects._forces import ARCTANGENT, has_corner, with_corner
from bayesoleo.effects._parts import Scales
from bayesoleo.effects._places import PART
from bayesoleo.effects._terms import FAMILY as TERMS, terms_of
from bayesoleo.errors import CampaignError, ModelError, number_of
from bayesoleo.estimation._nuisance import Nuisance
from bayesoleo.model._drive_and_start import driven_by, with_estimated_starts
from bayesoleo.model._expressions import split_derivative
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Parameter
from bayesoleo.prediction._records import Record

#: Half a record needs two periods for an average of its own.
FEWEST_PERIODS_TO_SPLIT = 4
#: What is added to the label of half a run.
FIRST_HALF, SECOND_HALF = "first half", "second half"

#: Added effects by name: (effect, target).
Added = tuple[str, str]


@dataclass(frozen=True)
class RecordNoise:
    """The noise of one output in one run, as the models of a search have shown it so far.

    Parameters
    ----------
    sigma : float
        Of a sample, SI.
    input_noise : float
        Part of the averaged residual's noise that comes from the inputs, SI.
    left : float
        Root mean square of what the model left through which the inputs' noise was carried, SI.
    """

    sigma: float
    input_noise: float
    left: float

    def limits(self, left: float) -> bool:
        """Whether a model that leaves so much has no more noise of its inputs than this.

        That noise comes through the model: a stiff one lets little through. What a model that
        explains less lets through says nothing of one that explains more.
        """
        return self.left <= left


@dataclass(frozen=True)
class Roles:
    """Runs by role.

    Parameters
    ----------
    fitted, held_out : tuple of Record
        In leave-one-run-out both hold every run.
    strategy : {"declared", "leave-one-run-out", "split periods", "none"}
        How runs are held out.
    description : str
        The same as a sentence.
    measured : mapping of (run, output) to RecordNoise
        Noise is a property of the records: once it was measured no later model has more of it. That
        of inputs comes through the model, and holds for those that leave no less.
    """

    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]
    strategy: str
    description: str
    measured: Mapping[tuple[str, str], RecordNoise] = field(default_factory=dict)

    def noise_of(self, output: str, label: str) -> RecordNoise | None:
        """Of a run, or of the run that it is a half of; None where it was not measured yet.

        Where all that there is are two halves of one run, each has been measured by itself.
        """
        whole = label.removesuffix(f" ({FIRST_HALF})").removesuffix(f" ({SECOND_HALF})")
        return self.measured.get((label, output), self.measured.get((whole, output)))


def assign(records: Sequence[Record]) -> Roles:
    """Take the declared roles, or find another way to hold data out.

    Raises
    ------
    CampaignError
        If no run is to be fitted.
    """
    fitted = tuple(record for record in records if record.role == "fit")
    if not fitted:
        raise CampaignError(
            "no run to fit",
            file="campaign.toml",
            key="role",
            hint='give one run or more role = "fit"; only predict does without',
        )
    held_out = tuple(record for record in records if record.role != "fit")
    if held_out:
        return Roles(
            fitted, held_out, "declared", f"{number_of(len(held_out), 'declared hold-out run')}"
        )
    if len(fitted) >= 2:
        text = (
            "no hold-out run is declared: every run is predicted by a fit to the others"
            " (leave-one-run-out)"
        )
        return Roles(fitted, fitted, "leave-one-run-out", text)
    (only,) = fitted
    if only.periods >= FEWEST_PERIODS_TO_SPLIT:
        first, second = halves(only)
        text = (
            "one run and no hold-out: fitted to the first half of its periods, held out the second"
        )
        return Roles((first,), (second,), "split periods", text)
    what = "one run of too few periods" if only.periodic else "one transient run"
    return Roles(fitted, (), "none", f"{what}: nothing could be held out")


def in_halves(roles: Roles) -> Roles | None:
    """The fitted runs' first halves to be fitted, and their second ones held out.

    Returns
    -------
    Roles or None
        None where a run has no halves that repeat, or runs are held out so or in turn already.
    """
    whole = all(r.periodic and r.periods >= FEWEST_PERIODS_TO_SPLIT for r in roles.fitted)
    if roles.strategy != "declared" or not whole:
        return None
    first, second = zip(*(halves(record) for record in roles.fitted), strict=True)
    text = "fitted to the first half of each run's periods, held out the second"
    return Roles(first, second, "split periods", text, roles.measured)


def halves(record: Record) -> tuple[Record, Record]:
    """The first and the second half of a periodic record's periods, as records of their own."""
    half = record.periods // 2
    middle = int(np.searchsorted(record.phase, half - 1e-9))
    if record.phase.size - middle + 1 < _samples(record, record.periods - half):
        # A record may be a sample short of whole periods; so may its first half instead.
        middle -= 1
    return (
        _part(record, slice(0, middle), half, FIRST_HALF, "fit"),
        _part(record, slice(middle, None), record.periods - half, SECOND_HALF, "hold-out"),
    )


def _samples(record: Record, periods: int) -> float:
    """Number of samples that so many periods take."""
    step = (record.time[-1] - record.time[0]) / (record.time.size - 1)
    return float(periods / (step * record.frequency))


def _part(record: Record, samples: slice, periods: int, name: str, role: str) -> Record:
    time = record.time[samples]
    shift = record.frequency * (time[0] - record.time[0])
    harmonics = {
        channel: replace(
            item, coefficients=item.coefficients * np.exp(2j * np.pi * item.orders * shift)
        )
        for channel, item in record.harmonics.items()
    }
    return replace(
        record,
        label=f"{record.label} ({name})",
        role=role,
        periods=periods,
        time=time,
        samples={channel: values[samples] for channel, values in record.samples.items()},
        kept=None if record.kept is None else record.kept[samples],
        harmonics=harmonics,
        # Half a record has half as many lines below a frequency.
        disturbances={
            channel: replace(item, terms=(item.terms + 1) // 2)
            for channel, item in record.disturbances.items()
        },
    )


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
    corner : str
        Corner of dry friction at zero velocity, of all effects that are in it or may be added: a
        body has one.
    """

    native: Model
    drive: str | None = None
    sensors: tuple[tuple[Effect, str, Scales], ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    steps: tuple[AddedEffect, ...] = ()
    declared: Model | None = None
    nuisance: Nuisance = field(default_factory=Nuisance)
    starts: bool = False
    corner: str = ARCTANGENT

    @property
    def added(self) -> tuple[Added, ...]:
        """All effects with their targets, in the order in which they were added."""
        return tuple((step.effect.id, step.target) for step in self.steps)

    def model(self) -> Model:
        """The driven model with everything in it."""
        driven = self.native if self.drive is None else driven_by(self.native, self.drive)
        model = driven
        for effect, target, scales in self.sensors:
            model = effect.extend(model, target, scales).model
        model = self.nuisance.extend(model)
        model = with_estimated_starts(model, driven) if self.starts else model
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
        left = self._anew([other for other in self.steps if other is not step], self.corner)
        # Without the friction that had it nothing speaks for the corner.
        return left if left.has_corner else replace(left, corner=ARCTANGENT)

    @property
    def cornered(self) -> list[str]:
        """Titles of dry friction that was added whose corner the declared model does not state."""
        declared = self.declared or self.native
        return [step.effect.title for step in self.steps if has_corner(step.effect, declared)]

    @property
    def has_corner(self) -> bool:
        """Whether there is such dry friction."""
        return bool(self.cornered)

    def fits(self, corner: str) -> bool:
        """Whether its dry friction, if there is any, has a corner."""
        return self.corner == corner or not self.has_corner

    def with_corner(self, corner: str) -> Assembly:
        """The same effects with another corner of dry friction, and the same parameters."""
        return self._anew(self.steps, corner) if self.steps else replace(self, corner=corner)

    def _anew(self, steps: Sequence[AddedEffect], corner: str) -> Assembly:
        """Assembled again from some of its effects."""
        declared = self.declared or self.native
        base = Assembly(
            declared, self.drive, nuisance=self.nuisance, starts=self.starts, corner=corner
        )
        everywhere = _undeclared(self.model())
        for other in steps:
            if other.target not in other.effect.places(base._base(other.effect)):
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
        So is a change of a term that an effect has added: that term is itself a supposition, and
        two that lean on each other follow whatever a third one would explain.
        """
        found, driven = [], self.model()
        for usual in catalogue() if effects is None else effects:
            effect = with_corner(usual, self.corner)
            base = driven if effect.on_channels else self.native  # made once for all channels
            for candidate in candidates(base, scales, (effect,)):
                if candidate.family == TERMS and not self._declares(candidate.target):
                    continue
                try:
                    assembly = self._with_candidate(effect, candidate, scales, base)
                    found.append(Option(candidate, assembly, assembly.model()))
                except ModelError:
                    continue
        return found

    def _declares(self, target: str) -> bool:
        """Whether the term at a target of the family ``dependence`` is of the declared model."""
        terms = terms_of(self.declared or self.native)
        return target in terms or target.rpartition(PART)[0] in terms

    def option(self, effect: Effect, target: str, scales: Scales) -> Option:
        """One effect at one place, ready to be scored or estimated.

        Raises
        ------
        ModelError
            If it does not apply there, or leaves no unique inverse for the drive.
        """
        effect = with_corner(effect, self.corner)
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
