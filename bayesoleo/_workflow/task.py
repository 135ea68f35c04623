"""A campaign and a model, brought together and checked before work begins.

The model is also solved at its nominal values and compared with the measurements: a wrong sign or a
wrong unit shows there.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._units import angle_hint, parse_unit, same_quantity
from bayesoleo._workflow.read_early import read_early
from bayesoleo._workflow.settings import Settings
from bayesoleo.data._campaign import CampaignData, load_campaign
from bayesoleo.data._data_warnings import data_warnings, frequency_warnings
from bayesoleo.data._disturbances import without_disturbances
from bayesoleo.data._frequency_response import (
    A_TRANSIENT,
    EXCITED,
    FEWEST_LINES,
    KIND,
    LEVEL,
    LINE,
    frequency_response,
    has_multisine,
)
from bayesoleo.data._held_inputs import count_steps
from bayesoleo.data._reduction import ReducedCampaign, reduce_campaign
from bayesoleo.discovery._assembly import Assembly, Roles, assign
from bayesoleo.discovery._compile_ahead import begin_compiling
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.effects._catalogue import listed
from bayesoleo.errors import CampaignError, DataWarning, InputError, ModelError
from bayesoleo.estimation._nuisance import declared_nuisance
from bayesoleo.model._derivatives import derive
from bayesoleo.model._dimensions import check_dimensions
from bayesoleo.model._drive_and_start import driven_by, possible_drives
from bayesoleo.model._expressions import symbol
from bayesoleo.model._model import Model
from bayesoleo.prediction._input_bandwidth import Invented, Lost, lost_inputs, without_invented
from bayesoleo.prediction._mesh_steps import first_steps
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import COLLOCATION

#: Correlation, averaged over the runs, below which a sign looks turned. Starts drawn from wide
#: priors about a resonance, which lies on the wrong side of some runs, stay above -0.25.
TURNED = -0.5
#: Ratio of sizes that no start is expected to be off by, in all runs.
LARGE = 100.0
#: A power of ten is looked for where the shapes agree like this, and sizes that well with it.
ALIKE, NEAR = 0.95, 0.05
#: K between a temperature in degC and in K, and how near to it a difference is told.
CELSIUS, NEAR_CELSIUS = 273.15, 40.0
#: Sizes are compared of what stands above the noise by this factor.
ABOVE_NOISE = 3.0
#: Part of the runs in which an input changes in steps, from which one asks whether it is held.
STEPPED = 0.2


@dataclass(frozen=True)
class StartCheck:
    """An output of one run at the nominal values.

    Parameters
    ----------
    run, output : str
    status : str
        Of the solution; the numbers are None where there is none.
    correlation : float or None
        With what was measured, about the means; None where either does not move.
    ratio : float or None
        Standard deviation predicted over that measured.
    below : float or None
        How far the prediction lies below what was measured where it lies lowest, SI; the quantile
        at 95 %.
    """

    run: str
    output: str
    status: str
    correlation: float | None = None
    ratio: float | None = None
    below: float | None = None


def starts_of(
    model: Model,
    records: Sequence[Record],
    steps: int,
    scheme: str,
    jobs: int | None,
    solver: str = COLLOCATION,
) -> list[StartCheck]:
    """Predict runs at a model's nominal values and compare.

    Parameters
    ----------
    model : Model
        Driven.
    records : sequence of Record
    steps : int
        Of the mesh.
    scheme : str
        Discretisation.
    jobs : int or None
        Threads.
    solver : str
        Of periodic runs.
    """
    predictor = Predictor(
        model, records, steps=steps, scheme=scheme, solver=solver, backend="numpy", jobs=jobs
    )
    theta = predictor.layout.start(model)
    statuses = predictor.set_anchor(theta) if model.dofs else [Status.CONVERGED] * len(records)
    found = []
    for r, (record, status) in enumerate(zip(records, statuses, strict=True)):
        samples = predictor.simulate(theta[None], r) if status.ok else None
        for b, output in enumerate(predictor.outputs):
            if samples is None or samples.status[0] != Status.CONVERGED:
                said = status if samples is None else Status(int(samples.status[0]))
                found.append(StartCheck(record.label, output, said.message))
            else:
                found.append(_compared(record, output, samples.y[0, b]))
    return found


def _compared(record: Record, output: str, predicted: np.ndarray) -> StartCheck:
    kept = slice(None) if record.kept is None else record.kept
    measured = record.samples[output][kept]
    moved, seen = predicted[kept] - predicted[kept].mean(), measured - measured.mean()
    size, noise = float(np.std(seen)), record.signal_noise.get(output, 0.0)
    message, below = Status.CONVERGED.message, float(np.quantile(measured - predicted[kept], 0.95))
    if size <= ABOVE_NOISE * noise or not np.isfinite(moved).all():
        return StartCheck(record.label, output, message, below=below)
    ratio = float(np.std(moved)) / size
    correlation = None
    if ratio > 0:
        correlation = float(moved @ seen / (np.linalg.norm(moved) * np.linalg.norm(seen)))
    return StartCheck(record.label, output, message, correlation, ratio, below)


def about_start(starts: Sequence[StartCheck], model: Model) -> list[str]:
    """Sentences about what looks like a mistake, with its figures.

    Only what the runs show together is told: from a poor start a resonance may lie on the wrong
    side of one.

    Parameters
    ----------
    starts : sequence of StartCheck
    model : Model
    """
    failed = [f"run {item.run} ({item.status})" for item in _by_run(starts) if item.ratio is None]
    failed = [text for text in failed if Status.CONVERGED.message not in text]
    found = []
    if failed:
        found.append(
            f"the model has no solution at its nominal values in {', '.join(failed)}: check signs,"
            " units and nominal values"
        )
    for output, declared in model.outputs.items():
        below = [item.below for item in starts if item.output == output and item.below is not None]
        if declared.unit == "K" and below:
            found += _about_temperature(output, below)
        own = [item for item in starts if item.output == output and item.ratio is not None]
        if own:
            found += _about_output(output, own, bool(model.dofs))
    return found


def _about_temperature(output: str, below: Sequence[float]) -> list[str]:
    """Whether a model computes in degC although it says K: data in degC are converted to K."""
    if any(not abs(value - CELSIUS) < NEAR_CELSIUS for value in below):
        return []
    return [
        f"at the nominal values {output} lies {_range(below)} K below what was measured in every "
        "run, about as far as degC from K: channels in degC are converted to K; write the "
        "temperatures and the nominal values of the model in K"
    ]


def _by_run(starts: Sequence[StartCheck]) -> list[StartCheck]:
    """One entry for each run."""
    return list({item.run: item for item in starts}.values())


def _about_output(output: str, starts: Sequence[StartCheck], resonates: bool) -> list[str]:
    correlations = [item.correlation for item in starts if item.correlation is not None]
    ratios = np.array([item.ratio for item in starts], dtype=float)
    found = []
    if correlations and np.mean(correlations) < TURNED:
        more = ", or a resonance on the wrong side of the runs" if resonates else ""
        found.append(
            f"at the nominal values {output} answers with the opposite sign (correlation with what"
            f" was measured {_range(correlations)}): a channel or a term whose sign is turned looks"
            f" so{more}"
        )
    if (ratios >= LARGE).all() or (ratios <= 1 / LARGE).all():
        found.append(
            f"at the nominal values {output} moves {_range(ratios)} times as much as was measured"
            " in every run: check the units of channels and parameters"
        )
        return found
    power = 10.0 ** np.round(np.log10(np.maximum(ratios, 1e-300)).mean())
    shaped = bool(correlations) and all(abs(value) > ALIKE for value in correlations)
    if shaped and power != 1 and (np.abs(ratios / power - 1) < NEAR).all():
        found.append(
            f"at the nominal values {output} has the shape that was measured and {_range(ratios)}"
            f" times its size in every run, a power of ten: check the units of its channel"
        )
    return found


def _range(values: Sequence[float] | np.ndarray) -> str:
    """The numbers, or from which to which they go."""
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def as_plain(starts: Sequence[StartCheck]) -> list[dict[str, Any]]:
    """The same for programs."""
    return [asdict(item) for item in starts]


Source = str | os.PathLike[str] | CampaignData | ReducedCampaign


def silent(_: str) -> None:
    """Say nothing."""


def reduce(
    campaign: Source, *, jobs: int | None = None, progress: bool | float = False
) -> ReducedCampaign:
    """Load a campaign and reduce its runs to records.

    Parameters
    ----------
    campaign : path-like, CampaignData or ReducedCampaign
        Folder with ``campaign.toml``, or what was loaded from one.
    jobs : int, optional
        Threads.
    progress : bool or float
        Whether to show a bar, at once or after so many seconds.

    Raises
    ------
    CampaignError
        If anything in it cannot be used.

    Warns
    -----
    DataWarning
        If a declared frequency is a part or a multiple of the true one.
    """
    if isinstance(campaign, ReducedCampaign):
        return campaign
    reduced = read_early(campaign)
    if reduced is None:
        loaded = (
            campaign
            if isinstance(campaign, CampaignData)
            else load_campaign(campaign, progress=bool(progress))
        )
        reduced = reduce_campaign(loaded, jobs=jobs, progress=progress)
    for sentence in frequency_warnings(reduced.records):
        warnings.warn(sentence, DataWarning, stacklevel=2)
    return reduced


@dataclass(frozen=True)
class Task:
    """A campaign and a model, ready for work.

    Parameters
    ----------
    reduced : ReducedCampaign
    roles : Roles
    assembly : Assembly
        The declared model with its drive.
    settings : Settings
    known : list of (Assembly, ModelFit)
        Estimates that were made of declared models; all tasks that follow from this one have them.
    """

    reduced: ReducedCampaign
    roles: Roles
    assembly: Assembly
    settings: Settings
    known: list[tuple[Assembly, ModelFit]] = field(default_factory=list, compare=False, repr=False)

    def keep(self, fit: ModelFit) -> None:
        """Keep the estimate of the declared model, for a search that begins with it."""
        self.known[:] = [(self.assembly, fit.apart())]

    @property
    def declared(self) -> ModelFit | None:
        """The estimate of the declared model by these numerics, if it was made before."""
        for assembly, fit in self.known:
            if assembly is self.assembly and fit.numerics == self.settings.numerics:
                return fit.apart()
        return None

    @property
    def campaign(self) -> CampaignData:
        """As loaded."""
        return self.reduced.campaign

    @cached_property
    def data_warnings(self) -> list[str]:
        """What deserves a look in the records; computed once, though each round's result has it."""
        found = data_warnings(self.reduced.records, self.campaign.units)
        return [*found, *self._broadband[1]]

    @property
    def frequency_response(self) -> xr.Dataset | None:
        """What multisine runs show before any model; None without such runs."""
        return self._broadband[0]

    @cached_property
    def _broadband(self) -> tuple[xr.Dataset | None, list[str]]:
        return multisine_response(self.reduced, self.assembly.model())

    def about(self) -> dict[str, Any]:
        """Top-level keys of the summary."""
        left_out = self.settings.left_out
        return {
            "format": schema.FORMAT,
            "campaign": self.campaign.name,
            "model": self.assembly.native.name,
            "drive": self.assembly.drive or ", ".join(self.assembly.native.inputs),
            "seed": self.settings.seed,
            **({"effects_left_out": left_out} if left_out else {}),
        }


def prepare(
    campaign: Source, model: Model, settings: Settings, *, progress: bool | float = False
) -> Task:
    """Bring a campaign and a model together, and find out early what does not fit.

    Raises
    ------
    InputError
        If the campaign lacks a channel or a condition of the model, or the drive has no inverse.
    """
    begin_compiling(settings.jobs)
    model = settings.inference.declare(check_dimensions(model))
    reduced = reduce(campaign, jobs=settings.jobs, progress=progress)
    drive = choose_drive(model, reduced.campaign, settings.drive)
    starts = not all(record.periodic for record in reduced.records)
    assembly = Assembly(model, drive, starts=starts)
    assembly, reduced = _with_nuisance(assembly, reduced, settings.nuisance)
    assembly, reduced = _undisturbed(assembly, reduced, settings.disturbances)
    driven = assembly.model()
    # Building a predictor of one step checks channels, conditions and priors of every run without
    # solving anything.
    predictor = Predictor(driven, reduced.records, steps=8, backend="numpy", jobs=1)
    predictor.layout.priors(driven)
    if not predictor.layout.names:
        raise ModelError(
            f"model {model.name!r} has no parameter to estimate",
            hint="give at least one a prior (sd=…, relative_sd=…, bounds=…) without fixed=True",
        )
    _check_units(driven, reduced.campaign)
    _check_held(driven, reduced)
    reduced = within_bands(reduced, driven)
    for sentence in (
        *drive_not_followed(model, reduced.campaign, settings.drive),
        *stepped_inputs(reduced, driven),
    ):
        warnings.warn(sentence, DataWarning, stacklevel=2)
    return Task(reduced, assign(reduced.records), assembly, settings)


def stepped_inputs(reduced: ReducedCampaign, model: Model) -> list[str]:
    """Sentences on inputs of a model that change in steps, where nothing says how they go on from
    one sample to the next.

    Parameters
    ----------
    reduced : ReducedCampaign
    model : Model
        In the drive in which it is solved.
    """
    found = []
    for name, channel in reduced.campaign.channels.items():
        if name not in model.inputs or channel.held:
            continue
        steps = {r.label: count_steps(r.samples[name]) for r in reduced.records}
        runs = [r for r in reduced.records if steps[r.label]]
        # A controller holds in every run; in a quiet one friction alone may look like steps.
        if len(runs) < max(1.0, STEPPED * len(reduced.records)):
            continue
        first = runs[0]
        half = 0.5 * (first.time[-1] - first.time[0]) / (first.time.size - 1)
        others = f" and {len(runs) - 1} more" if len(runs) > 1 else ""
        found.append(
            f"run {first.label}{others}: {name} changes in steps, {steps[first.label]} in"
            f" {first.time.size} samples. If a controller holds it from one sample to the next,"
            f" write held = true under [channels.{name}]: a line between samples leads it by"
            f" {half:.3g} s, half a sample, and a lag of that size would be found"
        )
    return found


def within_bands(reduced: ReducedCampaign, model: Model) -> ReducedCampaign:
    """Cut inputs off where a model makes of them what its outputs do not show.

    Parameters
    ----------
    reduced : ReducedCampaign
    model : Model
        In the drive in which it is solved.

    Warns
    -----
    DataWarning
        For each run in which that is so, with figures.
    """
    channels = reduced.campaign.channels
    given = [name for name, channel in channels.items() if channel.bandwidth is not None]
    records, invented = without_invented(model, reduced.records, given)
    for item in invented:
        warnings.warn(_about(item, reduced.campaign.units), DataWarning, stacklevel=2)
    derived = derive(model)
    missing = lost_inputs(derived.inputs, derived.outputs, records)
    for lost in missing:
        if lost.channel not in given:
            warnings.warn(_about_lost(lost, reduced.campaign.units), DataWarning, stacklevel=2)
    return ReducedCampaign(reduced.campaign, records) if invented else reduced


def _about(item: Invented, units: Mapping[str, str]) -> str:
    """What was cut off, as a sentence."""
    inside, outside = units.get(item.channel, "(SI)"), units.get(item.output, "(SI)")
    return (
        f"run {item.run}: above {item.low:.4g} Hz the model makes {item.predicted:.2g} {outside} "
        f"of {item.output} out of {item.held:.2g} {inside} of {item.channel} by derivative "
        f"{item.derivative}, where {item.measured:.2g} {outside} were measured; as an input "
        f"{item.channel} ends there. To decide otherwise write bandwidth = … in Hz under "
        f"[channels.{item.channel}], inf for all of it"
    )


def _about_lost(item: Lost, units: Mapping[str, str]) -> str:
    """What an input lacks, as a sentence."""
    unit = units.get(item.channel, "(SI)") + (f"/s^{item.derivative}" if item.derivative else "")
    # A masked stretch is held against all of the channel, other losses are no part of what stays.
    whole = item.held if item.why == "masked" else np.hypot(item.held, item.lost)
    share = f"{item.lost:.2g} of {whole:.2g} {unit}"
    run, name = f"run {item.run}", item.channel
    if item.why == "masked":
        return (
            f"{run}: as an input {name} is a straight line where it is masked, for up to "
            f"{item.where:.3g} s; elsewhere such a line misses it by {share}. Cut the run there "
            "with start or stop"
        )
    if item.why == "repeating":
        return (
            f"{run}: {share} of {name} do not repeat and are no input of a periodic run, although "
            "an output answers to them; declare the run as kind = 'transient'"
        )
    what = f"derivative {item.derivative} of {name}" if item.derivative else name
    return (
        f"{run}: of {what}, {share} above {item.where:.4g} Hz are left out of the input, next to "
        "its noise but no flat part of it. To decide otherwise write bandwidth = … in Hz under "
        f"[channels.{name}], inf for all of it"
    )


def _with_nuisance(
    assembly: Assembly, reduced: ReducedCampaign, kinds: tuple[str, ...]
) -> tuple[Assembly, ReducedCampaign]:
    """Let what is known to a tolerance only be estimated within it."""
    if not kinds:
        return assembly, reduced
    accuracy = {name: item.accuracy for name, item in reduced.campaign.channels.items()}
    found = declared_nuisance(kinds, assembly.model(), reduced.records, accuracy)
    records = found.complete(reduced.records)
    return replace(assembly, nuisance=found), ReducedCampaign(reduced.campaign, records)


def _undisturbed(
    assembly: Assembly, reduced: ReducedCampaign, kinds: tuple[str, ...]
) -> tuple[Assembly, ReducedCampaign]:
    """Remove from the outputs what is no physics; the mean of one that drifts becomes unknown."""
    model = assembly.model()
    outputs = [name for name in model.outputs if name in reduced.campaign.channels]
    records = without_disturbances(reduced.records, outputs, kinds)
    drifting = tuple(
        name
        for name in outputs
        if any(name in r.disturbances and r.disturbances[name].drift for r in records)
    )
    if drifting:
        assembly = replace(assembly, nuisance=replace(assembly.nuisance, drifting=drifting))
        records = assembly.nuisance.complete(records)
    return assembly, ReducedCampaign(reduced.campaign, records)


def _check_units(model: Model, campaign: CampaignData) -> None:
    """Data come in SI: a model in other units, or of another quantity, is a mistake that no
    estimate survives."""
    declared = dict(model.inputs) | {name: output.unit for name, output in model.outputs.items()}
    for name, unit in declared.items():
        channel, wanted = campaign.channels[name], parse_unit(unit or "1")
        if not unit:
            continue
        if not same_quantity(wanted.si_name, channel.si_unit):
            raise CampaignError(
                f"channel {name!r} is in {channel.unit}, model {model.name!r} expects {unit}",
                file=campaign.path / "campaign.toml",
                key=f"channels.{name}.unit",
                value=channel.unit,
                hint=angle_hint(channel.unit, wanted.name)
                or f"write a unit that converts to {unit}, or declare the model otherwise",
            )


def _check_held(model: Model, reduced: ReducedCampaign) -> None:
    """A dof that nothing holds has no place that a periodic motion returns to."""
    periodic = [record.label for record in reduced.records if record.periodic]
    if not periodic:
        return
    expressions = [*map(model.equation, model.dofs), *map(model.output, model.outputs)]
    for dof in model.dofs:
        if not any(model.expand(one).has(symbol(dof)) for one in expressions):
            unit = model.dofs[dof].unit
            rate = f", in {unit}/s," if unit else ""
            instead = (
                f"declare its rate{rate} as the dof, of first order"
                if model.order(dof) > 1
                else f"leave {dof!r} out and solve its equation for dot({dof}), to write that there"
            )
            raise ModelError(
                f"model {model.name!r}: nothing holds {dof!r}. Only its derivatives are in"
                " equations and outputs, so that its place is unknown in a periodic run such as"
                f" {periodic[0]}",
                key="dofs",
                value=dof,
                hint="declare all runs as transients (kind = 'transient') that begin at"
                f" Dof({unit!r}, initial='0'); or {instead}",
            )


def choose_drive(model: Model, campaign: CampaignData, wanted: str | None) -> str | None:
    """The channel that is to drive a model; ``None`` for its own inputs."""
    if wanted == "model":
        return None
    if wanted is not None:
        driven_by(model, wanted)
        return None if wanted in model.inputs else wanted
    controlled = campaign.controlled
    if controlled is None or controlled in model.inputs or controlled not in possible_drives(model):
        return None
    return controlled


def drive_not_followed(model: Model, campaign: CampaignData, wanted: str | None) -> list[str]:
    """A sentence on a controlled channel that cannot drive a model; none where nothing is amiss.

    It is no error: a campaign is there for several models.

    Parameters
    ----------
    model : Model
        In its own drive.
    campaign : CampaignData
    wanted : str or None
        The setting ``drive``, which leaves nothing to say.
    """
    controlled, possible = campaign.controlled, possible_drives(model)
    if wanted is not None or controlled is None or controlled in possible:
        return []
    why = (
        f"which is an output of model {model.name!r} that no input can be exchanged for"
        if controlled in model.outputs
        else f"which is neither an input nor an output of model {model.name!r}"
    )
    own = listed(list(model.inputs)) or "no input at all"
    measured = [name for name in possible if name in campaign.channels]
    instead = f"one of: {', '.join(measured)}" if measured else "none of the channels"
    return [
        f"campaign.toml says controlled = {controlled!r}, {why}: the model is driven by {own}."
        f" It can be driven by {instead}. If its own inputs are meant, say so by --drive model or,"
        " in Python, drive='model'"
    ]


def check(campaign: Source, model: Model, settings: Settings = Settings()) -> dict[str, Any]:
    """Say what would be done; write nothing.

    Returns
    -------
    dict
        Campaign, model, drive, runs by role, unknowns, outputs, steps of the mesh, number of
        candidate effects, what the model says at its nominal values by run and output (``start``),
        and what deserves a look in records and start.
    """
    return checked(prepare(campaign, model, settings))


def multisine_response(
    reduced: ReducedCampaign, model: Model
) -> tuple[xr.Dataset | None, list[str]]:
    """Frequency response and distortion of the runs that have a multisine input.

    The input is what the rig controls or, if that is not declared, the first input of the model
    that is a multisine.

    Parameters
    ----------
    reduced : ReducedCampaign
    model : Model
        In the drive in which it is solved.

    Returns
    -------
    data : Dataset or None
        None where no run is a multisine, or none can be divided between its inputs.
    notes : list of str
        Sentences about periodic runs that take no part although there are multisines.
    """
    inputs, channels = list(model.inputs), reduced.campaign.channels
    mine = [name for name in (*inputs, *model.outputs) if name in channels]
    controlled = reduced.campaign.controlled
    drives = [controlled] if controlled in mine else [name for name in inputs if name in mine]
    drive = next((name for name in drives if has_multisine(reduced.records, name)), None)
    if drive is None:
        return None, []
    # What a controlled output drives are answers, whatever the model takes them for.
    others = [name for name in inputs if name != drive and name in mine] * (drive in inputs)
    outputs = [name for name in mine if name != drive and name not in others]
    try:
        found = frequency_response(reduced, drive, outputs, others=others)
    except InputError as error:
        return None, [f"multisine runs were not looked at: {error.problem}"]
    notes = [
        f"run {label} takes no part in the frequency response: {reason}"
        for label, reason in json.loads(found.attrs["left_out"]).items()
        if reason != A_TRANSIENT
    ]
    many = (found[KIND] == EXCITED).sum(LINE).values >= FEWEST_LINES
    return (found.isel({LEVEL: many}), notes) if many.any() else (None, [])


def _response_told(response: xr.Dataset | None) -> list[str]:
    """Sentences about multisine runs; none without such runs."""
    if response is None:
        return []
    # Loads Matplotlib, which checks of other campaigns do without.
    from bayesoleo._report.sentences import response_entries, response_sentence

    return [response_sentence(entry) for entry in response_entries(response)]


def checked(task: Task) -> dict[str, Any]:
    """What :func:`check` says of a campaign and a model that were brought together."""
    settings, driven = task.settings, task.assembly.model()
    told = _response_told(task.frequency_response)
    native = task.assembly.declared or task.assembly.native
    predictor = Predictor(driven, task.roles.fitted, steps=8, backend="numpy", jobs=1)
    steps = settings.steps or first_steps(driven, task.roles.fitted)
    starts = starts_of(
        driven, task.roles.fitted, steps, settings.scheme, settings.jobs, settings.solver
    )
    return {
        **task.about(),
        "inputs": list(driven.inputs),
        "outputs": list(driven.outputs),
        "fit": [record.label for record in task.roles.fitted],
        "hold_out": [record.label for record in task.roles.held_out],
        "strategy": task.roles.description,
        "unknowns": list(predictor.layout.names),
        "possible_drives": list(possible_drives(native)),
        "steps": steps,
        "effects": sum(
            bool(effect.places(driven if effect.family == "sensor" else native))
            for effect in settings.searched
        ),
        "start": as_plain(starts),
        **({schema.FREQUENCY_RESPONSE: told} if told else {}),
        "data_warnings": [*task.data_warnings, *about_start(starts, driven)],
    }
