"""The verb ``simulate``, and the campaign of the demonstration.

A campaign is simulated with the runs of another one, from a model or from the posterior of a
result. The demonstration is a small shaker campaign of an oleo with one effect more than the model
that is fitted to it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._storage.files import check_writable
from bayesoleo._types import Array
from bayesoleo._workflow.model_files import from_document
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import Source, choose_drive, reduce
from bayesoleo.data._campaign import CampaignData, SimulatedRun, write_campaign
from bayesoleo.data._disturbances import baseline_of
from bayesoleo.effects._catalogue import find_effect
from bayesoleo.effects._parts import Scales
from bayesoleo.errors import InputError, ResultsError
from bayesoleo.estimation._baselines import (
    Baseline,
    added_text,
    baselines_in,
    check_baselines,
    with_common_baselines,
)
from bayesoleo.estimation._nuisance import error_of, uncertain_conditions
from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.model._model import Model
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._simulate import STEPS, RunPlan, Simulation, motion, simulate_run
from bayesoleo.solvers._schemes import COLLOCATION
from bayesoleo.systems._systems import system


def model_of(tree: xr.DataTree) -> Model:
    """The driven model of a result, at its estimate.

    Raises
    ------
    ResultsError
        If the result holds none.
    """
    text = tree.attrs.get(schema.MODEL_DOCUMENT)
    if text is None or schema.POINT not in tree.children:
        raise ResultsError(
            "the result holds no estimated model", hint="run bayesoleo close or estimate again"
        )
    return from_document(json.loads(text))


def parameter_sets(tree: xr.DataTree, draws: int | None, seed: int) -> list[dict[str, float]]:
    """Values of the unknowns: the estimate, or draws from the posterior.

    Parameters
    ----------
    tree : xarray.DataTree
        A result.
    draws : int, optional
        Number of draws; ``None`` takes the point estimate.
    seed : int
        Chooses the draws.
    """
    if draws is None:
        point = tree[schema.POINT].to_dataset()
        labels = [str(name) for name in point[schema.PARAMETER].values]
        return [dict(zip(labels, map(float, point[schema.ESTIMATE].values), strict=True))]
    if schema.POSTERIOR not in tree.children:
        raise ResultsError("the result holds no posterior to draw from", hint="leave --draws out")
    posterior = tree[schema.POSTERIOR].to_dataset()
    scattering = json.loads(posterior.attrs.get(schema.BETWEEN_RUNS, "[]"))
    population = {make(n) for n in scattering for make in (schema.population_mean, schema.spread)}
    names = [
        str(name)
        for name in posterior.data_vars
        if not schema.of_errors(str(name)) and str(name) not in population
    ]
    flat = {name: posterior[name].values.ravel() for name in names}
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(next(iter(flat.values()))), size=draws, replace=False)
    return [{name: float(values[k]) for name, values in flat.items()} for k in chosen]


def simulate_like(
    model: Model,
    campaign: CampaignData,
    records: Sequence[Record],
    sets: Sequence[Mapping[str, float]],
    *,
    out: Path,
    noise: Mapping[str, float] | None,
    seed: int,
    scheme: str,
    steps: int | None,
    solver: str = COLLOCATION,
    about: str = "",
) -> Path:
    """Write a campaign with the runs, inputs and conditions of another.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    campaign : CampaignData
        The one to be like: channels, columns and units.
    records : sequence of Record
        Its reduced runs.
    sets : sequence of mapping
        Parameter values by name, by-run ones as ``name[run]``; each set makes a copy of every run.
    out : Path
        Folder of the new campaign.
    noise : mapping of str to float, optional
        Standard deviation by channel, SI; by default the records' own.
    seed : int
        Of the noise.
    scheme : str
        Discretisation.
    steps : int, optional
        Steps of the mesh.
    solver : str
        See :func:`~bayesoleo.prediction.periodic_orbit`.
    about : str
        What else the description says.

    Returns
    -------
    Path
    """
    streams = np.random.default_rng(seed).spawn(len(records) * len(sets))
    runs, units = [], {name: item.unit for name, item in model.conditions.items()}
    errors = []
    for k, values in enumerate(sets):
        for r, record in enumerate(records):
            label = record.label if len(sets) == 1 else f"{record.label}, draw {k + 1}"
            made = _simulated(
                model, record, values, noise, streams[k * len(records) + r], scheme, steps, solver
            )
            if k == 0:
                errors.append(made.error)
            runs.append(replace(to_simulated_run(made, units), label=label))
    wanted = (*model.inputs, *model.outputs)
    channels = {n: (c.column, c.unit) for n, c in campaign.channels.items() if n in wanted}
    return write_campaign(
        out,
        name=f"{campaign.name} simulated",
        description=f"Simulated with {model.name} like {campaign.name}.{_how_well(errors)}"
        + (f" {_sentence(about)}" if about else ""),
        controlled=campaign.controlled if campaign.controlled in channels else None,
        channels=channels,
        runs=runs,
    )


def _sentence(text: str) -> str:
    """Lines as sentences."""
    return " ".join(f"{line[0].upper()}{line[1:]}." for line in text.splitlines())


def _how_well(errors: Sequence[float]) -> str:
    """The largest error of a motion, in a sentence; none of a model that moves nothing."""
    if not np.isfinite(errors).all():
        return " The error of a motion could not be estimated."
    worst = max(errors, default=0.0)
    return f" Motions err by {worst:.1g} of their swing at most, by estimate." if worst else ""


def _simulated(
    model: Model,
    record: Record,
    values: Mapping[str, float],
    noise: Mapping[str, float] | None,
    rng: np.random.Generator,
    scheme: str,
    steps: int | None,
    solver: str,
) -> Simulation:
    per_period = record.time.size / record.periods
    plan = RunPlan(
        record.label,
        record.frequency,
        {name: record.harmonics[name] for name in model.inputs},
        {name: value for name, value in record.conditions.items() if name in model.conditions},
        periods=record.periods,
        samples_per_period=per_period,
        group=record.group,
        role=record.role,
    )
    step = (record.time[-1] - record.time[0]) / (record.time.size - 1)
    plan = replace(plan, samples_per_period=1.0 / (step * record.frequency))
    channels = (*model.inputs, *model.outputs)
    given = {name: record.signal_noise[name] for name in channels} | dict(noise or {})
    own = {}
    for name, value in values.items():
        shared, _, run = name.partition("[")
        if not run or run == f"{record.label}]":
            own[shared] = value
    return simulate_run(
        model, plan, own, noise=given, rng=rng, scheme=scheme, solver=solver, steps=steps or STEPS
    )


def merged(
    sets: Sequence[Mapping[str, float]], values: Mapping[str, float] | None, model: Model
) -> list[dict[str, float]]:
    """Parameter sets with some values replaced.

    Raises
    ------
    InputError
        If a name is no parameter of the model.
    """
    for name in values or {}:
        if name.partition("[")[0] not in model.parameters:
            known = ", ".join(model.parameters)
            raise InputError("no such parameter", key=name, hint=f"parameters there are: {known}")
    return [{**item, **(values or {})} for item in sets]


def to_simulated_run(
    made: Simulation, units: Mapping[str, str], frequency: float | None = None
) -> SimulatedRun:
    """Arrange a simulation to be written.

    Parameters
    ----------
    made : Simulation
    units : mapping of str to str
        SI unit of each condition.
    frequency : float, optional
        The approximate one to declare, Hz; by default the true one.

    Returns
    -------
    SimulatedRun
    """
    return SimulatedRun(
        made.label,
        made.time,
        made.samples,
        frequency=made.frequency if frequency is None else frequency,
        group=made.group,
        role=made.role,
        conditions={name: (value, units[name]) for name, value in made.conditions.items()},
    )


def simulate(
    source: Model | xr.DataTree,
    campaign: Source,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str],
    values: Mapping[str, float] | None = None,
    draws: int | None = None,
    noise: Mapping[str, float] | None = None,
    common_offset: bool = False,
) -> Path:
    """Simulate a campaign with the runs, inputs and conditions of another.

    Parameters
    ----------
    source : Model or xarray.DataTree
        A model at its nominal values, or a result: its extended model at the estimate.
    campaign : path-like, Campaign or ReducedCampaign
        Gives inputs, sampling, conditions, channels and the noise.
    settings : Settings
        Seed, drive (of a model), scheme and steps.
    out : path-like
        Folder of the new campaign; must not hold files.
    values : mapping of str to float, optional
        Parameters at other values, SI.
    draws : int, optional
        Simulate with so many draws of the result's posterior, each a copy of every run.
    noise : mapping of str to float, optional
        Standard deviations by channel, SI, instead of the measured ones.
    common_offset : bool, optional
        Add to outputs that drift the offset that the runs fitted by the result have in common; a
        fitted run has its own. The description of the new campaign states it. Each draw of the
        posterior has a draw of it. Nothing is added by default.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        If a name is unknown, the model cannot be solved, or no output has a common offset.
    """
    folder = check_writable(out)
    reduced = reduce(campaign, jobs=settings.jobs)
    if isinstance(source, Model):
        drive = choose_drive(source, reduced.campaign, settings.drive)
        model = source if drive is None else driven_by(source, drive)
        sets: list[dict[str, float]] = [{}]
    else:
        model, sets = model_of(source), parameter_sets(source, draws, settings.seed)
    records, added = reduced.records, list[Baseline]()
    if common_offset:
        point = {} if isinstance(source, Model) else source.children
        added = baselines_in(point[schema.POINT].to_dataset()) if point else []
        check_baselines(added, model)
        records = with_common_baselines(
            records, added, partial(same_noise, cast(xr.DataTree, source))
        )
        if draws is not None:
            runs = [record.label for record in records]
            sets = [_with_errors(one, added, runs, settings.seed, k) for k, one in enumerate(sets)]
    return simulate_like(
        model,
        reduced.campaign,
        uncertain_conditions(model).complete(records),
        merged(sets, values, model),
        out=folder,
        noise=noise,
        seed=settings.seed,
        scheme=settings.scheme,
        solver=settings.solver,
        steps=settings.steps,
        about=added_text(added),
    )


def same_samples(tree: xr.DataTree, record: Record, output: str) -> bool:
    """Whether a result knows a run of this label with the very same samples of an output."""
    there, here = _stored(tree, record, output), record.samples[output]
    return there is not None and bool(np.array_equal(there, here))


def same_noise(tree: xr.DataTree, record: Record, output: str) -> bool:
    """The same but for a drift, which is taken off before a run is fitted: two runs differ from
    sample to sample by the noise of both."""
    there, here = _stored(tree, record, output), record.samples[output]
    if there is None:
        return False
    noise = np.fmax(record.signal_noise.get(output, 0.0), 1e-6 * float(np.ptp(here)))
    return bool(np.sqrt(np.mean(np.diff(there - here) ** 2)) < noise)


def _stored(tree: xr.DataTree, record: Record, output: str) -> Array | None:
    """Samples of the run of the same label in a result, if they are as many."""
    if schema.RECORDS not in tree.children:
        return None
    observed = tree[schema.RECORDS].to_dataset()
    if output not in observed or record.label not in observed[schema.RUN].values:
        return None
    there, size = observed[output].sel({schema.RUN: record.label}).values, record.time.size
    whole = there.size >= size and not np.isfinite(there[size:]).any()
    return np.asarray(there[:size]) if whole else None


def _with_errors(
    values: Mapping[str, float],
    added: Sequence[Baseline],
    runs: Sequence[str],
    seed: int,
    draw: int,
) -> dict[str, float]:
    """A draw with an error of the common offset for each run; those that were fitted have one of
    their own."""
    rng = np.random.default_rng([seed, draw])
    errors = {
        f"{error_of(baseline_of(one.output))}[{run}]": float(rng.standard_normal())
        for one in added
        for run in runs
    }
    return {**errors, **values}


#: The model that the demonstration fits, and the effect that it lacks.
DEMO_SYSTEM = "f16n2d2"
DEMO_EFFECT = "stribeck_friction"

#: Every parameter that is not at the model's nominal value, SI; the last two belong to the effect.
DEMO_TRUTH: Mapping[str, float] = MappingProxyType(
    {
        "piston_area": 3484e-6 * 0.990,
        "initial_volume": 9.20e-4 * 1.008,
        "orifice_damping": 2897.0 * 1.10,
        "friction_base": 65.0 * 1.20,
        "friction_per_pressure": 2.0e-5 * 0.80,
        "friction_slope": 3400.0 * 1.20,
        "solubility": -1.570e-8 * 0.85,
        "heat_conduction": 2.567 * 0.75,
        "stribeck_friction": 140.0,
        "stribeck_friction_decay": 0.006,
    }
)

#: Standard deviation of the noise by channel, SI: 0.05 mm, 20 N, 0.05 bar.
NOISE = MappingProxyType({"displacement": 0.05e-3, "force": 20.0, "pressure": 0.05e5})
#: Steps of 16 bits over 0.3 m, 60 kN and 100 bar.
QUANTISATION = MappingProxyType(
    {
        name: full / 2**16
        for name, full in (("displacement", 0.3), ("force", 6e4), ("pressure", 1e7))
    }
)
CHANNELS = MappingProxyType(
    {
        "displacement": ("stroke_mm", "mm"),
        "force": ("force_kN", "kN"),
        "pressure": ("pressure_bar", "bar"),
    }
)
PRESSURE, PRESSURE_SCATTER, TEMPERATURE = 4.9e5, 0.015, 293.0
FREQUENCY_SCATTER = 0.002
#: Second and third harmonic of the displacement over its amplitude.
DISTORTION = (0.008, 0.004)


@dataclass(frozen=True)
class _Test:
    """One row of the thesis's test grid: static position and amplitude in mm, nominal frequency."""

    label: str
    group: str
    role: str
    frequency: float
    position: float
    amplitude: float


# Verbeek (1993), tables 5.1 and 5.2; amplitudes trimmed where they would touch a stop.
_TESTS = (
    _Test("b", "middle", "fit", 0.1, 133, 115),
    _Test("k", "low", "fit", 0.2, 79, 74),
    _Test("d", "high", "fit", 0.5, 219, 32),
    _Test("j", "middle", "fit", 2.0, 133, 10),
    _Test("c", "high", "hold-out", 0.2, 179, 73),
    _Test("i", "middle", "hold-out", 1.0, 133, 21),
)


def true_model() -> Model:
    """The model that makes the data, driven by displacement, at :data:`DEMO_TRUTH`."""
    # Scales place the scan grid of the effect's shape, which gets its true value here anyway.
    scales = Scales(
        position={"stroke": (0.0, 0.264)},
        velocity={"stroke": 0.15},
        output={},
        shortest_period=0.5,
        longest_period=10.0,
    )
    candidate = find_effect(DEMO_EFFECT).extend(system(DEMO_SYSTEM), "stroke", scales)
    return driven_by(candidate.model.with_values(DEMO_TRUTH), "displacement")


def demo_campaign(folder: str | os.PathLike[str], seed: int = 0) -> Path:
    """Simulate the demonstration's campaign and write it as a rig would.

    Six runs of about four periods, displacement under control, four to fit and two to hold out.

    Parameters
    ----------
    folder : path-like
        Made if it is not there; must be empty.
    seed : int
        Of noise, starting phases, frequencies and initial pressures. The truth does not change.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignError
        If the folder holds files.

    References
    ----------
    Verbeek (1993), tables 5.1 and 5.2.
    """
    model = true_model()
    streams = np.random.default_rng(seed).spawn(len(_TESTS))
    runs = [_simulate(model, test, rng) for test, rng in zip(_TESTS, streams, strict=True)]
    return write_campaign(
        folder,
        name="demo",
        description="Shaker test of an oleo, simulated for the demonstration.",
        controlled="displacement",
        channels=CHANNELS,
        runs=runs,
    )


def _simulate(model: Model, test: _Test, rng: np.random.Generator) -> SimulatedRun:
    amplitudes = 1e-3 * test.amplitude * np.array([1.0, *DISTORTION])
    # Recorded as a gauge shows it: what is written is what the run had.
    pressure = float(np.round(PRESSURE * (1 + PRESSURE_SCATTER * rng.standard_normal())))
    plan = RunPlan(
        test.label,
        test.frequency * (1 + FREQUENCY_SCATTER * rng.standard_normal()),
        {
            "displacement": motion(
                1e-3 * test.position, amplitudes.tolist(), rng.uniform(0, 2 * np.pi, 3).tolist()
            )
        },
        {"initial_pressure": pressure, "ambient_temperature": TEMPERATURE},
        periods=rng.uniform(4.0, 4.2),
        samples_per_period=rng.uniform(400.0, 500.0),
        group=test.group,
        role=test.role,
    )
    # By the kernels that the search needs next.
    made = simulate_run(
        model, plan, noise=NOISE, quantisation=QUANTISATION, rng=rng, backend="numba"
    )
    units = {name: item.unit for name, item in model.conditions.items()}
    return replace(to_simulated_run(made, units), frequency=test.frequency)
