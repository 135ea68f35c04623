"""Simulate a campaign like another one, with a model or with the model and posterior of a
result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo.data import Campaign, SimulatedRun, write_campaign
from bayesoleo.errors import InputError, ResultsError
from bayesoleo.model import Model
from bayesoleo.model.document import from_document
from bayesoleo.prediction.records import Record
from bayesoleo.prediction.simulate import STEPS, RunPlan, Simulation, simulate_run
from bayesoleo.solvers.schemes.choose import COLLOCATION


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
    campaign: Campaign,
    records: Sequence[Record],
    sets: Sequence[Mapping[str, float]],
    *,
    out: Path,
    noise: Mapping[str, float] | None,
    seed: int,
    scheme: str,
    steps: int | None,
    solver: str = COLLOCATION,
) -> Path:
    """Write a campaign with the runs, inputs and conditions of another.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    campaign : Campaign
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
        See :func:`~bayesoleo.prediction.orbits.periodic_orbit`.

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
        description=f"Simulated with {model.name} like {campaign.name}.{_how_well(errors)}",
        controlled=campaign.controlled if campaign.controlled in channels else None,
        channels=channels,
        runs=runs,
    )


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
