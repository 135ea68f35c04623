"""Identifiability: directions that the data determine, posterior against prior, distinct modes.

The Hessian of the objective, with each unknown in units of its own scale, has principal axes. The
data determine the combination of parameters along a stiff axis, and do not along a sloppy one
(Verbeek 1993, eqs. 2.44 and 2.45; the axes after Gutenkunst et al. 2007).

A narrow interval may come from the prior alone. The ratio of posterior to prior standard deviation
shows this parameter by parameter: near one, the data added no information.

Estimates from several starts show whether the data determine more than one mode.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bayesoleo import _schema as schema
from bayesoleo._parallel import thread_map
from bayesoleo._schema import LabelledResult, columns, variable
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._estimate import Method, estimate, polish
from bayesoleo.estimation._objectives import curvature
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._correlated_priors import sample_of
from bayesoleo.model._model import Model
from bayesoleo.model._priors import Prior
from bayesoleo.solvers._orbit import count, counted

Scale = Literal["prior", "value"]
# Components below this part of the largest do not help a reader.
_WORTH_SAYING = 0.1
# Information below that of the prior: the data have not moved the unknown.
_UNDETERMINED = 1.0
#: Ratio above which the data count as silent: the posterior is within 5 % as wide as the prior.
SILENT = 0.95


def principal_axes(
    problem: EstimationProblem, point: PointEstimate, *, scale: Scale = "prior", exact: bool = False
) -> LabelledResult:
    """Principal axes of the likelihood at an estimate, the sloppiest first.

    Parameters
    ----------
    problem : EstimationProblem
    point : PointEstimate
    scale : {"prior", "value"}, optional
        In units of the prior's standard deviation the information of an axis is that of the data
        over that of the prior: below one the data have said nothing. Relative to the value, an axis
        is a product of powers, and its standard deviation is relative.
    exact : bool, optional
        With second derivatives of the residual.

    Returns
    -------
    LabelledResult
        ``information(axis)``, ``sd(axis)``, ``direction(axis, parameter)``, ``words(axis)``,
        ``scale(parameter)``.

    Raises
    ------
    InputError
        If ``scale`` is ``"value"`` and an estimate is zero.
    """
    unit = _unit(problem, point, scale)
    whole = curvature(problem, point.theta, point.variance, prior=False, exact=exact)
    scaled = over_variances(whole, len(unit)) * np.outer(unit, unit)
    information, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(axis=0), range(len(unit))])
    say = in_words if scale == "prior" else as_product
    names = [str(name) for name in point.names]
    with np.errstate(divide="ignore", invalid="ignore"):
        sd = np.where(information > 0, 1 / np.sqrt(np.abs(information)), np.inf)
    one = {"prior": "prior standard deviations", "value": "part of the value"}[scale]
    data = xr.Dataset(
        {
            "information": variable(("axis",), information, "information of the data", "1"),
            schema.SD: variable(("axis",), sd, "standard deviation along the axis", one),
            "direction": variable(
                ("axis", schema.PARAMETER), vectors.T, "direction in scaled parameters", "1"
            ),
            "words": variable(
                ("axis",), np.array([say(v, names) for v in vectors.T], object), "axis", ""
            ),
            "scale": variable((schema.PARAMETER,), unit, "scale", "unit of each parameter"),
        },
        coords={schema.PARAMETER: names},
    )
    data.attrs = {"scaled_by": scale}
    return LabelledResult(data, axes_text(data))


def over_variances(whole: Array, unknowns: int) -> Array:
    """Curvature in the parameters, shape (l, l), with the variances following them.

    The Schur complement of the block of the variances.
    """
    cross = whole[:unknowns, unknowns:]
    return whole[:unknowns, :unknowns] - cross @ np.linalg.solve(
        whole[unknowns:, unknowns:], cross.T
    )


def in_words(vector: Array, names: Sequence[str]) -> str:
    """A direction as a sum: ``0.92 piston_area − 0.39 initial_volume``."""
    text = ""
    for k in _worth_saying(vector):
        sign = "−" if vector[k] < 0 else "+"
        text += f" {sign} {abs(vector[k]):.2g} {names[k]}"
    return text.removeprefix(" + ").removeprefix(" ")


def as_product(vector: Array, names: Sequence[str]) -> str:
    """A direction of logarithms as a product of powers: ``piston_area^0.92 · volume^−0.39``."""
    parts = [f"{names[k]}^{vector[k]:.2g}".replace("-", "−") for k in _worth_saying(vector)]
    return " · ".join(parts)


def _worth_saying(vector: Array) -> list[int]:
    order = np.argsort(-np.abs(vector))
    return [int(k) for k in order if abs(vector[k]) >= _WORTH_SAYING * abs(vector[order[0]])]


def _unit(problem: EstimationProblem, point: PointEstimate, scale: Scale) -> Array:
    if scale == "prior":
        return np.array([prior.sd for prior in problem.priors])
    if scale != "value":
        raise InputError("unknown scale", key="scale", value=scale, hint="use 'prior' or 'value'")
    if (point.theta == 0).any():
        raise InputError(
            "a value of zero has no logarithm",
            key=point.names[int(np.argmin(np.abs(point.theta)))],
            hint="use scale='prior'",
        )
    return np.abs(point.theta)


def axes_text(data: xr.Dataset) -> str:
    """One line an axis, the sloppiest first."""
    by_prior = data.attrs["scaled_by"] == "prior"
    head = ["axis", "sd [prior sd]" if by_prior else "sd", "information", ""]
    rows = []
    for k in range(data.sizes["axis"]):
        sd, information = float(data[schema.SD][k]), float(data["information"][k])
        text = str(data["words"].values[k])
        if by_prior and information < _UNDETERMINED:
            text += "  (not determined by the data)"
        shown = f"{sd:.3g}" if by_prior else f"{100 * sd:.3g} %"
        rows.append([str(k + 1), shown, f"{information:.3g}", text])
    width = max(len(row[3]) for row in rows)
    return columns(head, [[*row[:3], row[3].ljust(width)] for row in rows])


def data_against_prior(
    sd: Mapping[str, float] | PointEstimate,
    priors: Mapping[str, Prior] | Sequence[Prior],
    *,
    model: Model | None = None,
    silent: float = SILENT,
) -> xr.Dataset:
    """How much narrower the data made what was known of each parameter.

    Parameters
    ----------
    sd : mapping of str to float, or PointEstimate
        Posterior standard deviations by name, from an estimate or from draws.
    priors : mapping of str to Prior, or sequence of Prior
        Of the same parameters; a sequence in the estimate's order.
    model : Model, optional
        Its constants that are known to a tolerance and were not estimated are listed too: they were
        not asked.
    silent : float, optional
        Ratio from which on the data are said to add nothing.

    Returns
    -------
    xarray.Dataset
        ``prior_sd``, ``posterior_sd``, ``ratio``, ``said_nothing`` (parameter); the attribute
        ``statement`` says it in a sentence.

    Raises
    ------
    InputError
        If a parameter has no prior here.
    """
    found = dict(zip(sd.names, sd.sd, strict=True)) if isinstance(sd, PointEstimate) else dict(sd)
    known = priors if isinstance(priors, Mapping) else dict(zip(found, priors, strict=True))
    for name in found:
        if name not in known:
            raise InputError("no prior is given for this parameter", key=name)
    prior_sd = {name: known[name].sd for name in found}
    parameters = {} if model is None else {n: model.parameters[n] for n in model.uncertain()}
    absent = [name for name in parameters if name not in found]
    held = [*(sd.known if isinstance(sd, PointEstimate) else ()), *absent]
    for name in absent:
        prior = parameters[name].prior
        assert prior is not None
        found[name] = prior_sd[name] = prior.sd
    width = np.array([prior_sd[name] for name in found])
    ratio = np.array(list(found.values())) / width
    quiet = ratio >= silent
    return xr.Dataset(
        {
            "prior_sd": (schema.PARAMETER, width),
            "posterior_sd": (schema.PARAMETER, list(found.values())),
            "ratio": (schema.PARAMETER, ratio),
            "said_nothing": (schema.PARAMETER, quiet),
        },
        coords={schema.PARAMETER: list(found)},
        attrs={"statement": _statement(found, quiet, held)},
    )


def _statement(names: Mapping[str, float], quiet: np.ndarray, held: Sequence[str]) -> str:
    silent = [n for n, flag in zip(names, quiet, strict=True) if flag and n not in held]
    parts = []
    if silent:
        parts.append(f"the data add nothing to the prior of {', '.join(silent)}")
    if held:
        parts.append(f"{', '.join(held)} was held, known to its tolerance only")
    return "; ".join(parts) if parts else "the data add to the prior of every parameter"


@dataclass(frozen=True, eq=False, repr=False)
class Modes:
    """Distinct modes of the posterior, the highest first.

    Parameters
    ----------
    modes : tuple of PointEstimate
        Each the best of the estimates that ended there.
    hits : tuple of int
        Number of estimates that ended in each.
    status : dict of str to int
        How all estimates ended, by name.
    """

    modes: tuple[PointEstimate, ...]
    hits: tuple[int, ...]
    status: dict[str, int]

    def __len__(self) -> int:
        return len(self.modes)

    def __iter__(self) -> Iterator[PointEstimate]:
        return iter(self.modes)

    def __getitem__(self, index: int) -> PointEstimate:
        return self.modes[index]

    def to_dataset(self) -> xr.Dataset:
        """``estimate`` and ``sd`` (mode, parameter), ``objective`` and ``hits`` (mode)."""
        names = self.modes[0].names if self.modes else ()
        shape, both = (len(self), len(names)), ("mode", schema.PARAMETER)
        theta = np.array([mode.theta for mode in self]).reshape(shape)
        sd = np.array([mode.sd for mode in self]).reshape(shape)
        unit = {"units": "unit of each parameter"}
        height = np.array([mode.objective for mode in self])
        return xr.Dataset(
            {
                schema.ESTIMATE: (both, theta, {"long_name": "mode of the posterior", **unit}),
                schema.SD: (both, sd, {"long_name": "linearised standard deviation", **unit}),
                schema.OBJECTIVE: ("mode", height, {"long_name": "log posterior"}),
                "hits": (
                    "mode",
                    np.array(self.hits, dtype=np.int64),
                    {"long_name": "estimates that ended there"},
                ),
            },
            coords={schema.PARAMETER: list(names)},
            attrs={"status": json.dumps(self.status)},
        )

    def __str__(self) -> str:
        if not self.modes:
            return f"no mode was found: {counted(self.status)}"
        head = ["mode", *self.modes[0].names, "log posterior", "hits"]
        rows = [
            [str(number), *(f"{v:.6g}" for v in mode.theta), f"{mode.objective:.2f}", str(hits)]
            for number, (mode, hits) in enumerate(zip(self, self.hits, strict=True), start=1)
        ]
        return columns(head, rows)

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>{self.to_dataset()._repr_html_()}"


def multistart(
    problem: EstimationProblem,
    starts: int | ArrayLike = 8,
    rng: np.random.Generator | None = None,
    *,
    distance: float = 0.1,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    jobs: int | None = 1,
    progress: Callable[[int, PointEstimate], None] | None = None,
) -> Modes:
    """Find the posterior's modes from several starts.

    From each start two ways are gone: MBE followed by BE, which reaches the mode that the data
    want, and BE alone, which also reaches a mode near the prior's centre.

    Parameters
    ----------
    problem : EstimationProblem
    starts : int or array_like, shape (m, l), optional
        Number of starts drawn from the priors, or the starts. The problem's own comes on top.
    rng : numpy.random.Generator, optional
        Draws the starts; needed if ``starts`` is a number above zero.
    distance : float, optional
        Modes nearer than this, in posterior standard deviations, are one.
    tolerance, max_iterations
        As in :func:`~bayesoleo.estimation.estimate`.
    jobs : int, optional
        Threads over starts; None for all cores. The default leaves the threads to the problem.
    progress : callable, optional
        Called with the index and the result of each start that is done.

    Returns
    -------
    Modes
        Empty of modes if no estimate converged; ``status`` tells why.

    Raises
    ------
    InputError
        If ``rng`` is missing, or a given start does not fit.
    """

    def from_start(start: Array, method: Method) -> PointEstimate:
        return estimate(
            problem, method, start=start, tolerance=tolerance, max_iterations=max_iterations
        )

    def both_ways(item: tuple[int, Array]) -> list[PointEstimate]:
        index, start = item
        found, robust = [from_start(start, "be")], from_start(start, "mbe")
        if np.isfinite(robust.objective):
            polished = polish(problem, robust, tolerance=tolerance, max_iterations=max_iterations)
            found.append(polished)
        if progress is not None:
            progress(index, found[-1])
        return found

    begins = enumerate(_starts(problem, starts, rng))
    points = [point for pair in thread_map(both_ways, begins, jobs) for point in pair]
    modes, hits = _merge([point for point in points if point.status.ok], distance)
    return Modes(modes, hits, count([int(point.status) for point in points]))


def _starts(
    problem: EstimationProblem, starts: int | ArrayLike, rng: np.random.Generator | None
) -> list[Array]:
    own = np.array(problem.start, dtype=float)
    if not isinstance(starts, int):
        given = np.array(starts, dtype=float).reshape(-1, own.size)
        return [own, *given]
    if starts < 0:
        raise InputError("number of starts must not be negative", key="starts", value=starts)
    if starts and rng is None:
        raise InputError(
            "drawing starts needs a generator", key="rng", hint="pass numpy.random.default_rng(1)"
        )
    if not starts or rng is None:
        return [own]
    return [own, *sample_of(problem.priors, rng, starts)]


def _merge(
    points: list[PointEstimate], distance: float
) -> tuple[tuple[PointEstimate, ...], tuple[int, ...]]:
    modes: list[PointEstimate] = []
    hits: list[int] = []
    for point in sorted(points, key=lambda point: -point.objective):
        for index, mode in enumerate(modes):
            if _separation(mode, point) < distance:
                hits[index] += 1
                break
        else:
            modes.append(point)
            hits.append(1)
    return tuple(modes), tuple(hits)


def _separation(mode: PointEstimate, other: PointEstimate) -> float:
    """Mahalanobis distance by the higher mode's covariance."""
    away, sd = (other.theta - mode.theta) / mode.sd, mode.sd
    try:
        factor = cho_factor(mode.covariance / np.outer(sd, sd))
    except LinAlgError:
        return float(np.linalg.norm(away))
    return float(np.sqrt(max(0.0, away @ cho_solve(factor, away))))
