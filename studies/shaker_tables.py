"""The shaker campaign in the layout of Verbeek (1993), tables 6.2, 6.3 and 6.5 to 6.7.

Shared by the pages ``plot_shaker_tables.py`` and ``plot_friction.py`` and by the command
``tests/benchmarks/tables.py``. All fourteen runs are used, as in the thesis.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

import bayesoleo
import bayesoleo._workflow
from bayesoleo import Model, Parameter
from bayesoleo.data import ReducedCampaign, load_campaign, reduce_campaign
from bayesoleo.discovery import ModelFit, Numerics, fit_model
from bayesoleo.errors import InputError
from bayesoleo.model import driven_by

#: Models by physics and variant; ``thesis`` leaves theta_4 and theta_6 unlinked.
MODELS = {
    ("mechanical", "thesis"): "f16n1d1_thesis",
    ("mechanical", "linked"): "f16n1d1",
    ("thermo-mechanical", "thesis"): "f16n2d1_thesis",
    ("thermo-mechanical", "linked"): "f16n2d1",
}
DAMPING = "orifice_damping"
FRICTION = ("friction_base", "friction_per_pressure", "friction_slope")
#: Heading and factor of each estimated parameter.
COLUMNS = {
    "theta_4": ("θ4 [1e-3 m²]", 1e3),
    "theta_6": ("θ6 [1/m]", 1.0),
    "theta_7": ("θ7", 1.0),
    "theta_16": ("θ16 [W/K]", 1.0),
    "piston_area": ("A_p [1e-3 m²]", 1e3),
    "initial_volume": ("V_0 [1e-3 m³]", 1e3),
    "gas_exponent": ("n", 1.0),
    "solubility": ("dn/dp [1e-8]", 1e8),
    "heat_conduction": ("θ16 [W/K]", 1.0),
}
#: Output of a drive, and the unit that its residuals are printed in.
RESIDUAL = {"force": ("mm", 1e3), "displacement": ("N", 1.0)}


def column(name: str) -> tuple[str, float]:
    """Title of a parameter, and what its SI value is multiplied by; constants known to a tolerance
    have no column in the thesis."""
    return COLUMNS.get(name, (name.replace("_", " "), 1.0))


@dataclass(frozen=True)
class Friction:
    """Friction amplitude of each run, and its line in the pressure.

    Parameters
    ----------
    amplitude, sd, pressure : xarray.DataArray
        By run: N, N, and the mean absolute pressure in Pa.
    line, line_sd : ndarray, shape (2,)
        Base in N and slope in m**2, by weighted least squares through the amplitudes.
    joint, joint_sd : ndarray, shape (2,)
        The same, estimated directly from all runs.
    slope, slope_sd : float
        theta_10 of the direct estimate, s/m.
    """

    amplitude: xr.DataArray
    sd: xr.DataArray
    pressure: xr.DataArray
    line: np.ndarray
    line_sd: np.ndarray
    joint: np.ndarray
    joint_sd: np.ndarray
    slope: float
    slope_sd: float


def friction_of_each_run(model: Model) -> Model:
    """The model with one friction amplitude a run instead of a line in the pressure."""
    amplitude = Parameter(100.0, "N", relative_sd=1.0, by_run=True, description="of the run")
    return (
        model.fixing("friction_base", "friction_per_pressure")
        .with_parameters(friction_of_run=amplitude)
        .with_definition("friction_amplitude", "friction_of_run")
    )


@dataclass(frozen=True)
class Shaker:
    """The campaign with what was found from it so far.

    Parameters
    ----------
    reduced : ReducedCampaign
    jobs : int or None
        Threads.
    """

    reduced: ReducedCampaign
    jobs: int | None = None

    @classmethod
    def load(cls, jobs: int | None = None) -> Shaker:
        """Reduce the campaign below ``BAYESOLEO_DATA``."""
        root = os.environ.get("BAYESOLEO_DATA")
        if root is None:
            raise InputError("BAYESOLEO_DATA is not set", hint="name the folder with campaigns/")
        return cls(
            reduce_campaign(load_campaign(Path(root) / "campaigns" / "shaker-plain"), jobs=jobs),
            jobs,
        )

    @property
    def runs(self) -> list[str]:
        """Labels."""
        return [record.label for record in self.reduced.records]

    @cache  # noqa: B019 - a handful of results that live as long as the page
    def friction(self) -> Friction:
        """Estimate it from force and pressure, driven by displacement."""
        direct = self._fit(bayesoleo.system("f16n2d2"), "displacement").point
        # One amplitude for all of a run is an approximation: its error is not the damping's.
        known = bayesoleo.system("f16n2d2").with_values({DAMPING: direct[DAMPING]}).fixing(DAMPING)
        each = self._fit(friction_of_each_run(known), "displacement").point
        sds = dict(zip(each.names, each.sd, strict=True))
        names = [f"friction_of_run[{run}]" for run in self.runs]
        amplitude, sd = (np.array([table[n] for n in names]) for table in (each, sds))
        pressure = np.array([r.samples["pressure"].mean() + 1e5 for r in self.reduced.records])
        rows = np.column_stack((np.ones_like(pressure), pressure)) / sd[:, None]
        covariance = np.linalg.inv(rows.T @ rows)
        by_run = {"dims": "run", "coords": {"run": self.runs}}
        direct_sd = dict(zip(direct.names, direct.sd, strict=True))
        return Friction(
            xr.DataArray(amplitude, **by_run),
            xr.DataArray(sd, **by_run),
            xr.DataArray(pressure, **by_run),
            covariance @ (rows.T @ (amplitude / sd)),
            np.sqrt(np.diag(covariance)),
            np.array([direct[name] for name in FRICTION[:2]]),
            np.array([direct_sd[name] for name in FRICTION[:2]]),
            direct["friction_slope"],
            direct_sd["friction_slope"],
        )

    def model(self, physics: str, variant: str) -> Model:
        """A model whose friction is what was found, and fixed, as in the thesis."""
        found = dict(zip(FRICTION, self.friction().joint, strict=False))
        return bayesoleo.system(MODELS[physics, variant]).with_values(found).fixing(*FRICTION)

    @cache  # noqa: B019
    def each(self, physics: str, variant: str, drive: str) -> xr.Dataset:
        """Estimates of each run."""
        settings = bayesoleo.Settings(jobs=self.jobs, drive=drive)
        return bayesoleo._workflow.estimate_each(
            self.reduced, self.model(physics, variant), settings
        )

    @cache  # noqa: B019
    def each_at_nominal_friction(self) -> xr.Dataset:
        """Table 6.5 by force with the friction of the thesis's tables C.1 and D.1."""
        settings = bayesoleo.Settings(jobs=self.jobs, drive="force")
        model = bayesoleo.system(MODELS["thermo-mechanical", "thesis"])
        return bayesoleo._workflow.estimate_each(self.reduced, model, settings)

    @cache  # noqa: B019
    def joint(self, physics: str, variant: str, drive: str) -> ModelFit:
        """Estimate from all runs."""
        return self._fit(self.model(physics, variant), drive)

    def residuals(self, physics: str, variant: str, drive: str) -> xr.Dataset:
        """Mean and standard deviation of the joint estimate's residual by run, SI."""
        fit = self.joint(physics, variant, drive)
        each = [
            run.measured[0] - prediction.y[0]
            for run, prediction in zip(fit.predictor.runs, fit.predictions, strict=True)
        ]
        return xr.Dataset(
            {
                "mean": ("run", [e.mean() for e in each]),
                "sd": ("run", [e.std() for e in each]),
                "group": ("run", [record.group for record in fit.records]),
            },
            coords={"run": self.runs},
        )

    def _fit(self, model: Model, drive: str) -> ModelFit:
        driven = model if drive in model.inputs else driven_by(model, drive)
        return fit_model(driven, self.reduced.records, Numerics(jobs=self.jobs))

    def __hash__(self) -> int:
        return id(self)


def _heading(each: xr.Dataset, unit: str) -> str:
    names = [column(str(name))[0] for name in each.parameter.values]
    return "run " + "".join(f"{name:>15}" for name in names) + f"{f'largest e [{unit}]':>18}"


def print_each(shaker: Shaker, physics: str, variant: str, drive: str) -> None:
    """Estimates run by run, tables 6.2 and 6.5, and their mean and spread, table 6.7."""
    each, (unit, factor) = shaker.each(physics, variant, drive), RESIDUAL[drive]
    print(f"{physics}, {variant}, driven by {drive}, each run by itself")
    print(_heading(each, unit))
    scales = [column(str(name))[1] for name in each.parameter.values]
    for run in each.run.values:
        row = each.sel(run=run)
        values = [f"{s * float(v):15.4f}" for s, v in zip(scales, row["estimate"], strict=True)]
        status = "" if row["status"] == "converged" else f"  {row['status'].item()}"
        largest = factor * float(row["largest"].item())
        print(f"{run:3} {''.join(values)}{largest:18.2f}{status}")


def print_scatter(shaker: Shaker, physics: str, variant: str, drive: str) -> None:
    """Mean and standard deviation over runs, table 6.7, and over the runs themselves."""
    each = shaker.each(physics, variant, drive)
    usable = each.where(each["status"] == "converged", drop=True)
    print(f"{physics}, {variant}, driven by {drive}: mean ± standard deviation over runs")
    view = bayesoleo.estimation.between_runs(each)
    for k, name in enumerate(each.parameter.values):
        title, scale = column(str(name))
        over = scale * usable["estimate"][:, k]
        print(
            f"  {title:15} {float(over.mean()):9.4f} ± {float(over.std(ddof=1)):.4f}"
            f"   pooled {scale * view.mean[k]:9.4f} ± {scale * view.mean_sd[k]:.4f},"
            f" spread {scale * view.spread[k]:.4f}"
        )


def print_joint(shaker: Shaker, physics: str, variant: str, drive: str) -> None:
    """Estimate from all runs jointly, and residual means by run and group, tables 6.3 and 6.6."""
    fit, (unit, factor) = shaker.joint(physics, variant, drive), RESIDUAL[drive]
    print(f"{physics}, {variant}, driven by {drive}, all runs jointly")
    for name, start, value in zip(fit.mbe.names, fit.mbe.start, fit.mbe.theta, strict=True):
        title, scale = column(name)
        print(f"  {title:15} {scale * value:9.4f}   start {scale * start:9.4f}")
    table = shaker.residuals(physics, variant, drive)
    print(f"  residual [{unit}]: mean ± standard deviation by run")
    for group, part in table.groupby("group"):
        cells = [
            f"{run} {factor * float(part['mean'].sel(run=run)):+.2f}"
            f" ± {factor * float(part['sd'].sel(run=run)):.2f}"
            for run in part.run.values
        ]
        print(f"  {group:7} {'   '.join(cells)}")
    whole = factor * np.sqrt(float((table["mean"] ** 2 + table["sd"] ** 2).mean()))
    print(f"  root mean square over runs {whole:.3g} {unit}")


def print_findings(shaker: Shaker, variant: str, drive: str) -> None:
    """What the thesis found, as ratios of the mechanical to the thermo-mechanical model."""
    both = ("mechanical", "thermo-mechanical")
    rms = [shaker.residuals(p, variant, drive) for p in both]
    rms = [np.sqrt(t["mean"] ** 2 + t["sd"] ** 2) for t in rms]
    alone = [shaker.each(p, variant, drive)[["rms", "estimate", "status"]] for p in both]
    print(f"{variant}, driven by {drive}: mechanical over thermo-mechanical")
    cells = " ".join(f"{r} {float(rms[0].sel(run=r) / rms[1].sel(run=r)):.1f}" for r in shaker.runs)
    print(f"  residual, jointly       {cells}")
    ratio = (alone[0]["rms"] / alone[1]["rms"]).squeeze("output")
    cells = " ".join(f"{run} {float(ratio.sel(run=run)):.1f}" for run in shaker.runs)
    print(f"  residual, run by run    {cells}")
    geometry = {"thesis": ("theta_4", "theta_6"), "linked": ("piston_area", "initial_volume")}
    for name in geometry[variant]:
        spread = []
        for each in alone:
            usable = each["estimate"].where(each["status"] == "converged").sel(parameter=name)
            spread.append(100 * float(usable.std(ddof=1) / abs(usable.mean())))
        title = column(name)[0].split()[0]
        print(f"  scatter of {title:4} over runs {spread[0]:.2g} % over {spread[1]:.2g} %")


def print_each_at_nominal_friction(shaker: Shaker) -> None:
    """Conduction by run if friction is set beforehand instead of found."""
    print("θ16 [W/K] by run, driven by force, with the friction that was")
    for title, each in (
        ("found", shaker.each("thermo-mechanical", "thesis", "force")),
        ("nominal", shaker.each_at_nominal_friction()),
    ):
        values = each["estimate"].sel(parameter="theta_16")
        cells = [f"{run} {float(values.sel(run=run)):.2f}" for run in shaker.runs]
        print(f"  {title:8} {'  '.join(cells)}")


def print_friction(shaker: Shaker) -> None:
    """Amplitude by run against pressure, and the line through it, figure 6.1."""
    found = shaker.friction()
    print("run  p [bar]   amplitude [N]     line    direct")
    for run in shaker.runs:
        p, a, s = (float(x.sel(run=run)) for x in (found.pressure, found.amplitude, found.sd))
        lines = [c[0] + c[1] * p for c in (found.line, found.joint)]
        print(f"{run:3}{p / 1e5:9.2f}{a:10.2f} ± {s:.2f}{lines[0]:9.2f}{lines[1]:10.2f}")
    for title, value, sd in (
        ("line through the amplitudes", found.line, found.line_sd),
        ("estimated directly", found.joint, found.joint_sd),
    ):
        base, slope = (
            f"{s * v:.3f} ± {s * d:.3f}" for s, v, d in zip((1, 1e5), value, sd, strict=True)
        )
        print(f"{title:28} θ8 = {base} N   θ9 = {slope} e-5 m²")
    print(f"slope θ10 = {found.slope:.0f} ± {found.slope_sd:.0f} s/m")


Print = Callable[[Shaker, str, str], None]

#: What the command prints, by table.
TABLES: dict[str, Print] = {
    "6.2": lambda s, v, d: print_each(s, "mechanical", v, d),
    "6.3": lambda s, v, d: print_joint(s, "mechanical", v, d),
    "6.5": lambda s, v, d: print_each(s, "thermo-mechanical", v, d),
    "6.6": lambda s, v, d: print_joint(s, "thermo-mechanical", v, d),
    "6.7": lambda s, v, d: print_scatter(s, "thermo-mechanical", v, d),
    "findings": print_findings,
    "6.5 at nominal friction": lambda s, _, __: print_each_at_nominal_friction(s),
    "friction": lambda s, _, __: print_friction(s),
}
