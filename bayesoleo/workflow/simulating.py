"""Simulate a campaign like a measured one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import xarray as xr

from bayesoleo.estimation.runs.nuisance import uncertain_conditions
from bayesoleo.model import Model, driven_by
from bayesoleo.simulation import merged, model_of, parameter_sets, simulate_like
from bayesoleo.storage import check_writable
from bayesoleo.workflow.settings import Settings
from bayesoleo.workflow.task import Source, choose_drive, reduce


def simulate(
    source: Model | xr.DataTree,
    campaign: Source,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str],
    values: Mapping[str, float] | None = None,
    draws: int | None = None,
    noise: Mapping[str, float] | None = None,
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

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        If a name is unknown, or the model cannot be solved.
    """
    folder = check_writable(out)
    reduced = reduce(campaign, jobs=settings.jobs)
    if isinstance(source, Model):
        drive = choose_drive(source, reduced.campaign, settings.drive)
        model = source if drive is None else driven_by(source, drive)
        sets: list[dict[str, float]] = [{}]
    else:
        model, sets = model_of(source), parameter_sets(source, draws, settings.seed)
    return simulate_like(
        model,
        reduced.campaign,
        uncertain_conditions(model).complete(reduced.records),
        merged(sets, values, model),
        out=folder,
        noise=noise,
        seed=settings.seed,
        scheme=settings.scheme,
        solver=settings.solver,
        steps=settings.steps,
    )
