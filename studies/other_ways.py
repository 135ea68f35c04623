"""Other ways to find what a model lacks, on the same data: what remains on runs not used.

Every way gets the same fitted model, and the residual of the fitted runs with what a rig knows of
each sample: position, velocity and the pressure where it was measured. It learns the residual as a
function of these, and predicts that of the runs held out. What is to be chosen - degree, threshold,
whether the velocity is squeezed about its zero - is chosen on the fitted runs alone: each predicted
from the others, or by marginal likelihood. Where the model gives every run an offset of its own,
that of a run held out is estimated anew on what each way leaves, alike for all.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.polynomial import chebyshev

import bayesoleo
from bayesoleo import _workflow as workflow
from bayesoleo.discovery import State, fit_state
from bayesoleo.effects import called
from bayesoleo.plots import _style as style, format_number

OUTPUT = "force"
#: Degrees of the surface, thresholds of SINDy for columns of unit norm in noise units, points
#: of the Gaussian process.
DEGREES, THRESHOLDS, POINTS = range(1, 10), (1.0, 3.0, 10.0, 30.0, 100.0, 300.0), 900
#: Widths, in parts of the largest velocity, of the smooth signs that SINDy may choose from.
WIDTHS = (0.01, 0.03, 0.1, 0.3)


@dataclass(frozen=True)
class RunResidual:
    """Residual of one run, in units of the noise of a sample; coordinates over their largest."""

    label: str
    residual: np.ndarray
    coordinates: np.ndarray  # (N, 2 or 3): position, velocity, pressure if it was measured
    period: np.ndarray
    offset: bool = False  # estimated in this run alone
    noise: float = 1.0  # of a sample, SI

    def left_by(self, predict: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """What a learned function leaves."""
        rest = self.residual - predict(self.coordinates)
        return rest - rest.mean() if self.offset else rest


@dataclass(frozen=True)
class Found:
    """What a way leaves on runs not used, over the noise, and what it says."""

    way: str
    rms: float
    repeating: float
    seconds: float
    says: str
    newton: float = float("nan")  # the rms in N


Learner = Callable[[Sequence[RunResidual]], Callable[[np.ndarray], np.ndarray]]


def residuals(state: State) -> tuple[list[RunResidual], list[RunResidual]]:
    """Of the fitted runs and of those held out."""
    predictions = [*state.fitted, *state.held_out]
    motions = [_motion(p.record) for p in predictions]
    scale = np.max([np.abs(m).max(axis=0) for m in motions], axis=0)
    found = []
    for prediction, coordinates in zip(predictions, motions, strict=True):
        record, place = prediction.record, prediction.predictor.outputs.index(OUTPUT)
        noise = state.errors.at(OUTPUT, record.label).average.sigma
        residual = (record.samples[OUTPUT] - prediction.y[place]) / noise
        period = np.floor(record.phase + 1e-9).astype(int)
        offset = prediction.re_estimated > 0
        found.append(
            RunResidual(record.label, residual, coordinates / scale, period, offset, noise)
        )
    return found[: len(state.fitted)], found[len(state.fitted) :]


def _motion(record) -> np.ndarray:
    """Position and velocity by the harmonics, without noise; pressure likewise."""
    wanted = [("displacement", 0), ("displacement", 1), ("pressure", 0)]
    columns = [
        record.harmonics[name].evaluate(record.phase, record.frequency, order)
        for name, order in wanted
        if name in record.harmonics
    ]
    return np.stack(columns, axis=1)


def judge(
    way: str, left: Sequence[tuple[RunResidual, np.ndarray]], seconds: float, says: str
) -> Found:
    """Pool over runs what a way leaves: raw, and averaged over periods, each over its noise."""
    from bayesoleo.data import periodic_average

    squares, ratios, newton = [], [], []
    for run, rest in left:
        cycles = run.period.max() + 1
        average = periodic_average(rest, 1.0 / (rest.size / cycles), 1.0)
        squares.append(np.mean(rest**2))
        ratios.append(average.ratio**2)
        newton.append(np.mean((run.noise * rest) ** 2))
    sizes = (float(np.sqrt(np.mean(part))) for part in (squares, ratios, newton))
    rms, repeating, force = sizes
    return Found(way, rms, repeating, seconds, says, force)


def across(runs: Sequence[RunResidual], learn: Learner) -> float:
    """Mean square of each run's residual when learned from the others."""
    errors = []
    for out in runs:
        predict = learn([run for run in runs if run is not out])
        errors.append(np.mean(out.left_by(predict) ** 2))
    return float(np.mean(errors))


def learned(
    way: str, fitted, held_out, learn: Learner, says: Callable[[], str], start: float
) -> Found:
    """Learn from all fitted runs, judge on those held out."""
    predict = learn(fitted)
    left = [(run, run.left_by(predict)) for run in held_out]
    return judge(way, left, time.process_time() - start, says())


# -- restoring-force surface -----------------------------------------------------------------------


def places(coordinates: np.ndarray, squeezed: bool) -> np.ndarray:
    """Position and velocity; the latter, if squeezed, with most of its range near zero."""
    x, v = coordinates[:, 0], coordinates[:, 1]
    if squeezed:
        v = np.arcsinh(v / WIDTHS[0]) / np.arcsinh(1 / WIDTHS[0])
    return np.stack([x, v], axis=1)


def surface(degree: int, squeezed: bool) -> Learner:
    """Chebyshev polynomials in position and velocity (Masri and Caughey 1979), least squares."""

    def columns(coordinates: np.ndarray) -> np.ndarray:
        at = places(coordinates, squeezed)
        x, v = (chebyshev.chebvander(at[:, k], degree) for k in (0, 1))
        pairs = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        return np.stack([x[:, i] * v[:, j] for i, j in pairs], axis=1)

    def learn(runs: Sequence[RunResidual]):
        A = np.concatenate([columns(run.coordinates) for run in runs])
        b = np.concatenate([run.residual for run in runs])
        weights = np.linalg.lstsq(A, b, rcond=1e-10)[0]
        return lambda coordinates: columns(coordinates) @ weights

    return learn


def with_surface(fitted, held_out) -> Found:
    """The degree is that which predicts fitted runs best from each other."""
    start = time.process_time()
    scores = {
        (degree, squeezed): across(fitted, surface(degree, squeezed))
        for degree in DEGREES
        for squeezed in (False, True)
    }
    degree, squeezed = min(scores, key=scores.get)
    count, over = (degree + 1) * (degree + 2) // 2, "squeezed velocity" if squeezed else "velocity"
    says = f"{count} coefficients of degree {degree} in position and {over}"
    learn = surface(degree, squeezed)
    return learned("restoring-force surface", fitted, held_out, learn, lambda: says, start)


# -- SINDy -----------------------------------------------------------------------------------------


def sindy(threshold: float, keep: dict) -> Learner:
    """Sequentially thresholded least squares on polynomials and on smooth signs of the velocity."""
    import pysindy

    def library(pressure: bool):
        # pysindy counts a function's arguments, so that a width has to be closed over.
        pairs = [_sign(width, pressure) for width in WIDTHS]
        pairs += [_sign(width, pressure, "p") for width in WIDTHS if pressure]
        pairs.append(_quadratic(pressure))
        functions, names = (list(part) for part in zip(*pairs, strict=True))
        own = pysindy.CustomLibrary(library_functions=functions, function_names=names)
        return pysindy.GeneralizedLibrary([pysindy.PolynomialLibrary(degree=3), own])

    def learn(runs: Sequence[RunResidual]):
        model = pysindy.SINDy(
            optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=True),
            feature_library=library(runs[0].coordinates.shape[1] == 3),
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model.fit(
                [run.coordinates for run in runs],
                t=1.0,
                x_dot=[np.tile(run.residual[:, None], run.coordinates.shape[1]) for run in runs],
                feature_names=["x", "v", "p"][: runs[0].coordinates.shape[1]],
            )
        keep["model"] = model
        return lambda coordinates: np.asarray(model.predict(coordinates))[:, 0]

    return learn


def _sign(width: float, pressure: bool, factor: str = ""):
    """A smooth sign of the velocity, times the pressure if asked for, and its name."""
    if factor:
        return (
            lambda x, v, p: p * np.tanh(v / width),
            lambda x, v, p: f"{p} tanh({v}/{width:g})",
        )
    if pressure:
        return lambda x, v, p: np.tanh(v / width), lambda x, v, p: f"tanh({v}/{width:g})"
    return lambda x, v: np.tanh(v / width), lambda x, v: f"tanh({v}/{width:g})"


def _quadratic(pressure: bool):
    """Signed square of the velocity, and its name."""
    if pressure:
        return lambda x, v, p: v * np.abs(v), lambda x, v, p: f"{v}|{v}|"
    return lambda x, v: v * np.abs(v), lambda x, v: f"{v}|{v}|"


def with_sindy(fitted, held_out) -> Found:
    """The threshold is that which predicts fitted runs best from each other."""
    start, keep = time.process_time(), {}
    scores = {value: across(fitted, sindy(value, keep)) for value in THRESHOLDS}
    best = min(scores, key=scores.get)

    def says() -> str:
        model = keep["model"]
        weights = np.asarray(model.coefficients())[0]
        names = np.array(model.get_feature_names())
        order = np.argsort(-np.abs(weights))
        active = int(np.count_nonzero(weights))
        return (
            f"{active} of {weights.size} terms: " + ", ".join(names[order][: min(active, 4)]) + " …"
        )

    return learned("SINDy", fitted, held_out, sindy(best, keep), says, start)


# -- Gaussian process ------------------------------------------------------------------------------


def process(squeezed: bool, keep: dict, seed: int = 0) -> Learner:
    """A Gaussian-process discrepancy over position and velocity, at most some points of all runs.

    Its lengths are the same everywhere, so that the velocity may also be squeezed about its zero.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor, kernels

    def learn(runs: Sequence[RunResidual]):
        rng = np.random.default_rng(seed)
        X = np.concatenate([places(run.coordinates, squeezed) for run in runs])
        y = np.concatenate([run.residual for run in runs])
        chosen = rng.permutation(y.size)[:POINTS]
        kernel = kernels.ConstantKernel(1.0, (1e-3, 1e4)) * kernels.RBF(
            [0.3, 0.3], (1e-3, 1e3)
        ) + kernels.WhiteKernel(1.0, (0.1, 1e3))
        model = GaussianProcessRegressor(kernel, normalize_y=True, random_state=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model.fit(X[chosen], y[chosen])
        keep["model"] = model
        return lambda coordinates: model.predict(places(coordinates, squeezed))

    return learn


def with_process(fitted, held_out) -> Found:
    """The velocity is squeezed if the marginal likelihood is higher so."""
    start, likelihood = time.process_time(), {}
    for squeezed in (False, True):
        keep: dict = {}
        process(squeezed, keep)(fitted)
        likelihood[squeezed] = keep["model"].log_marginal_likelihood_value_
    best, keep = max(likelihood, key=likelihood.get), {}

    def says() -> str:
        lengths = keep["model"].kernel_.k1.k2.length_scale
        over = "squeezed velocity" if best else "velocity"
        scales = f"{lengths[0]:.2g} of the position and {lengths[1]:.2g} of the {over}"
        return f"a surface that varies over {scales}"

    return learned("Gaussian process", fitted, held_out, process(best, keep), says, start)


# -- all of them -----------------------------------------------------------------------------------


def with_close(task, state: State) -> Found:
    """The closed loop, without sampling."""
    from bayesoleo._workflow.closing import run_loop
    from bayesoleo._workflow.output import ResultFolder, Stages

    start = time.process_time()
    stages = Stages()
    loop = run_loop(task, 4, stages, ResultFolder(None))
    assert not stages.failed, stages.failed
    left = [(run, run.residual) for run in residuals(loop.final)[1]]
    fit, texts = loop.final.fit, []
    for step in loop.final.assembly.steps:
        entry = next(r for r in loop.rounds if r.accepted and r.accepted.effect == step.effect.id)
        own = (*entry.accepted.score.names, *entry.accepted.score.shapes)
        values = [_value(fit, name) for name in own if name in fit.values]
        others = ", ".join(called(name, {}) for name in entry.accepted.same)
        same = f" (or {others})" if others else ""
        texts.append(f"{called(step.effect.id, {})}{same}: {', '.join(values[:3])}")
    says = "; ".join(texts) or loop.rounds[-1].reason
    return judge("close", left, time.process_time() - start, says)


def _value(fit, name: str) -> str:
    """A parameter with its standard deviation and unit."""
    sd = float(fit.point.sd[fit.problem.names.index(name)])
    unit = fit.model.parameters[name].unit if name in fit.model.parameters else ""
    return f"{name} = {format_number(fit.values[name], sd)} ± {sd:.2g} {unit}".strip()


def measure(campaign: Path, model: bayesoleo.model.Model | str) -> list[Found]:
    """All ways on one campaign."""
    settings = bayesoleo.Settings(jobs=1)
    model = bayesoleo.system(model) if isinstance(model, str) else model
    task = workflow.prepare(campaign, model, settings)
    state = fit_state(task.assembly, task.roles, settings.numerics)
    fitted, held_out = residuals(state)
    left = [(run, run.residual) for run in held_out]
    found = [judge("the model as declared", left, 0.0, "")]
    for way in (with_surface, with_sindy, with_process):
        with contextlib.suppress(ImportError):
            found.append(way(fitted, held_out))
    return [*found, with_close(task, state)]


def measured_damper() -> tuple[Path, bayesoleo.model.Model]:
    """The measured damper's campaign and its viscous model."""
    folder = Path(__file__).resolve().parent / "measured" / "mr_damper"
    return folder, bayesoleo.load_model(f"{folder / 'model.py'}:model")


def print_table(name: str, found: Sequence[Found]) -> None:
    """One line each, what it says below."""
    print(f"{name}: {OUTPUT} on runs not used, in N and over the noise")
    print(f"{'':26}{'rms in N':>9}{'rms':>8}{'repeating':>11}{'CPU s':>8}")
    for one in found:
        sizes = f"{one.newton:9.2f}{one.rms:8.3f}{one.repeating:11.2f}"
        print(f"{one.way:26}{sizes}{one.seconds:8.1f}")
    print()
    for one in found:
        if one.says:
            print(f"{one.way} says: {one.says}")
    print()


def draw(results: dict[str, Sequence[Found]]) -> Figure:
    """What each way leaves that repeats, over the noise, one panel for each campaign."""
    figure = style.blank(style.WIDTH, 2.6)
    for k, (name, found) in enumerate(results.items()):
        width = 0.76 / len(results)
        axes = figure.add_axes((0.21 + (width + 0.015) * k, 0.22, width - 0.03, 0.62))
        style.dress(axes)
        colours = [style.BEFORE, *[style.NEUTRAL] * (len(found) - 2), style.AFTER]
        axes.barh(range(len(found)), [one.repeating for one in found], 0.7, color=colours)
        axes.axvline(1.0, color=style.INK, lw=1)
        axes.set_yticks(range(len(found)), [one.way for one in found] if k == 0 else [])
        axes.invert_yaxis()
        axes.set_title(name, loc="left", fontsize=style.TEXT, fontweight="bold")
    figure.text(
        0.58, 0.03, "what repeats on runs not used, over its noise", fontsize=style.TEXT,
        ha="center", color=style.INK,
    )  # fmt: skip
    return figure


def main() -> None:
    """Measure, and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "campaigns", nargs="*", default=["shaker-breakaway", "shaker-wall", "mr_damper"]
    )
    options = parser.parse_args()
    root, flat = Path(os.environ["BAYESOLEO_DATA"]) / "campaigns", {}
    for name in options.campaigns:
        with contextlib.redirect_stdout(io.StringIO()):
            measured = name == "mr_damper"
            found = measure(*(measured_damper() if measured else (root / name, "f16n2d2")))
        for one in found:
            key = f"{name}_{one.way}".replace(" ", "_").replace("-", "_").lower()
            flat |= {
                f"{key}_rms": one.rms,
                f"{key}_rms_n": one.newton,
                f"{key}_repeating": one.repeating,
                f"{key}_cpu_s": one.seconds,
            }
        if not options.json:
            print_table(name, found)
    if options.json:
        print(json.dumps(flat, indent=1))


if __name__ == "__main__":
    main()
