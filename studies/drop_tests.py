"""Drop tests predicted from shaker estimates, shared by the page and the command.

Uncertainty comes as normal draws: of the estimate, of means over runs, and, for constants that were
held, of their tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import bayesoleo
from bayesoleo import Model
from bayesoleo.discovery import ModelFit, Numerics, fit_model
from bayesoleo.estimation import PointEstimate, data_against_prior
from bayesoleo.model import driven_by
from bayesoleo.prediction import Predictor, Record
from bayesoleo.systems import TABLE_6_7, drop_test

Fits = Mapping[str, tuple[ModelFit, Model]]

#: Dropped masses, kg.
MASSES = (350.0, 825.0)
CONDITIONS = {"initial_pressure": 4.9e5, "ambient_temperature": 293.0}
#: True parameters of ``shaker-plain`` that are given; theta_3 from hydraulic areas 2.9 % low.
TRUTH = {
    "piston_area": 3484e-6 * 0.980,
    "solubility": -1.570e-8 * 1.118,
    "heat_conduction": 2.567 * 1.304,
    "orifice_damping": 2897.0 * 0.971**3,
}


@dataclass(frozen=True)
class Drop:
    """A predicted drop.

    Parameters
    ----------
    time : ndarray, shape (N,)
        s.
    centre : mapping of str to ndarray, shape (N,)
        By output, at the estimate, SI.
    draws : mapping of str to ndarray, shape (L, N)
        By output; draws that could not be solved are left out.
    failed : int
        Number of those.
    """

    time: np.ndarray
    centre: Mapping[str, np.ndarray]
    draws: Mapping[str, np.ndarray]
    failed: int

    def interval(self, output: str, level: float = 0.95) -> np.ndarray:
        """Pointwise, shape (2, N)."""
        ends = (0.5 - 0.5 * level, 0.5 + 0.5 * level)
        return np.quantile(self.draws[output], ends, axis=0)


def predict_drop(
    model: Model,
    mass: float,
    values: Mapping[str, float],
    draws: Mapping[str, np.ndarray],
    *,
    span: float = 2.5,
) -> Drop:
    """Predict a drop at parameter values and at draws of some of them."""
    dropped = drop_test(model.with_values(values), mass)
    names = tuple(draws)
    dropped = dropped.fixing(*(n for n in dropped.estimated() if n not in names)).freeing(*names)
    time = np.linspace(0.0, span, 501)
    nothing = {name: np.zeros(time.size) for name in dropped.outputs}
    record = Record(
        "drop", "", "fit", "transient", np.nan, np.nan, 0, time, nothing, {},
        dict.fromkeys(nothing, 0.0), CONDITIONS,
    )  # fmt: skip
    predictor = Predictor(dropped, [record])
    start = predictor.layout.start(dropped)
    predictor.set_anchor(start)
    table = np.column_stack([draws[name] for name in predictor.layout.names])
    centre = predictor.simulate(start[None], 0).y[0]
    found = predictor.simulate(table, 0)
    solved = found.status == 0
    outputs = predictor.outputs
    return Drop(
        time,
        dict(zip(outputs, centre, strict=True)),
        {name: found.y[solved, k] for k, name in enumerate(outputs)},
        int((~solved).sum()),
    )


def from_estimate(
    point: PointEstimate, model: Model, rng: np.random.Generator, count: int = 200
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Values and draws of an estimate; constants held to a tolerance are drawn from it."""
    values = dict(zip(point.names, map(float, point.theta), strict=True))
    table = rng.multivariate_normal(point.theta, point.covariance, count, method="cholesky")
    draws = dict(zip(point.names, table.T, strict=True))
    for name in model.uncertain():
        if name not in draws:
            draws[name] = model.parameters[name].prior.sample(rng, count)
    return values, draws


def from_table_6_7(
    rng: np.random.Generator, count: int = 200
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Means over runs, and draws with their scatter; none of the other sign."""
    values = {name: mean for name, (mean, _) in TABLE_6_7.items()}
    draws = {}
    for name, (mean, sd) in TABLE_6_7.items():
        drawn = rng.normal(mean, sd, 4 * count)
        draws[name] = drawn[drawn * mean > 0][:count]
    return values, draws


def fitted(records: Sequence[Record], jobs: int | None = None) -> Fits:
    """All runs with the orifice damping held and estimated, and the slowest run alone."""
    held = bayesoleo.system("f16n2d2")
    freed = held.freeing("orifice_damping")

    def fit(model: Model, runs: Sequence[Record]) -> tuple[ModelFit, Model]:
        return fit_model(driven_by(model, "displacement"), runs, Numerics(jobs=jobs)), model

    return {
        "all runs, held": fit(held, records),
        "all runs, estimated": fit(freed, records),
        "run a, estimated": fit(freed, records[:1]),
    }


def predictions_of(fits: Fits) -> dict[float, dict[str, Drop]]:
    """By mass and title: the truth, predictions from estimates, and from table 6.7."""
    made: dict[float, dict[str, Drop]] = {}
    physics = bayesoleo.system("f16n2d2")
    truth = {**fits["all runs, estimated"][0].values, **TRUTH}
    for mass in MASSES:
        area = {"piston_area": np.array([truth["piston_area"]])}
        made[mass] = {"truth": predict_drop(physics, mass, truth, area)}
        for title in ("all runs, held", "all runs, estimated"):
            fit, model = fits[title]
            draws = from_estimate(fit.point, model, np.random.default_rng(0))
            made[mass][title] = predict_drop(physics, mass, *draws)
        for name in ("f16n2d2_thesis", "f16n2d2_thesis_printed"):
            draws = from_table_6_7(np.random.default_rng(0))
            made[mass][f"table 6.7, {name}"] = predict_drop(bayesoleo.system(name), mass, *draws)
    return made


def print_damping(fits: Fits) -> None:
    """What each fit says of the orifice damping."""
    for title, (fit, model) in fits.items():
        table = data_against_prior(fit.point, fit.problem.priors, model=model)
        ratio = float(table["ratio"].sel(parameter="orifice_damping"))
        statement = table.attrs["statement"]
        print(f"{title:20} posterior sd / prior sd {ratio:.3f}: {statement}")
    point = fits["all runs, estimated"][0].point
    sd = float(point.sd[point.names.index("orifice_damping")])
    true = TRUTH["orifice_damping"]
    print(f"estimated {point['orifice_damping']:.0f} ± {sd:.0f} kg/m, true {true:.0f}")


def print_drops(made: Mapping[float, Mapping[str, Drop]]) -> None:
    """Peaks of all predictions with their intervals."""
    for mass, predictions in made.items():
        for title, drop in predictions.items():
            if title != "truth":
                known = None if title.startswith("table") else predictions["truth"]
                print_drop(f"{mass:g} kg, {title}", drop, known)


def print_drop(title: str, drop: Drop, truth: Drop | None = None) -> None:
    """Peaks and end values with their intervals, against the truth where it is known."""
    print(f"{title}: {len(drop.draws['force'])} draws, {drop.failed} without a solution")
    for label, output, scale, unit in (
        ("largest displacement", "displacement", 1e3, "mm"),
        ("largest force", "force", 1e-3, "kN"),
        ("largest pressure", "pressure", 1e-5, "bar"),
    ):
        peaks = scale * drop.draws[output].max(axis=1)
        low, high = np.quantile(peaks, (0.025, 0.975))
        line = (
            f"  {label:21} {scale * drop.centre[output].max():8.3f}  [{low:.3f}, {high:.3f}] {unit}"
        )
        if truth is not None:
            line += f"   truth {scale * truth.centre[output].max():.3f}"
        print(line)
    if truth is not None:
        for output in drop.draws:
            low, high = drop.interval(output)
            inside = np.mean((low <= truth.centre[output]) & (truth.centre[output] <= high))
            print(f"  {output:13} truth within the 95 % band {100 * inside:.0f} % of the time")
