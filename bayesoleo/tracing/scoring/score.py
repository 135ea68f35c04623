"""Score an effect at its null: how much of the residual it would explain, without estimating
anything anew.

With residual ``e``, sensitivities ``J`` of the present parameters, ``C`` of the candidate's and
weights ``W``, what the candidate adds is
``C_perp = C - J (J' W J)^-1 J' W C``; its score is ``s = C_perp' W e`` with information ``I =
C_perp' W C_perp``. The expected parameter is
``I^-1 s`` and the sum of squares falls by ``s' I^-1 s`` (Rao's score test). Shape parameters that
the null leaves undefined are scanned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from bayesoleo._types import Array
from bayesoleo.parallel import thread_map
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.fitting.assembly import Option
from bayesoleo.tracing.scoring.base import Base, flat
from bayesoleo.tracing.scoring.colour import inflation_of
from bayesoleo.tracing.scoring.projection import coefficients, remains
from bayesoleo.tracing.scoring.sensitivities import Block, sensitivities_of

#: Why an effect has no score.
SPANNED = "the model can already do what it would"
UNRESOLVED = "not visible in these data: no output changes with it"


@dataclass(frozen=True)
class Score:
    """Result of scoring one candidate.

    Parameters
    ----------
    option : Option
        The candidate.
    names : tuple of str
        Its new unknowns, by-run ones expanded.
    expected : ndarray, shape (k,)
        Their expected values, SI.
    shapes : mapping of str to float
        Values of shape parameters at which it scores best.
    fall : float
        Fall of the weighted sum of squares.
    share : float
        Part of the excess explained.
    inflation : float
        Variance of the score by the noise's spectrum and by its scatter between periods, over what
        white noise gives; at least one.
    columns : ndarray, shape (m, n)
        Thinned, weighted, normalised ``C_perp`` of all scanned shapes, for the correction for the
        search.
    contribution : ndarray, shape (n,)
        Thinned, weighted ``C_perp I^-1 s``, for comparing candidates.
    z : float
        Signed root of the statistic for one new unknown, its root for several.
    rank : int
        Directions that the new unknowns can move the outputs in, beside the present ones.
    freedom : int
        Degrees of freedom that the inflation was measured with; zero where none was.
    information : ndarray, shape (k, k)
        ``C_perp' W C_perp`` of the new unknowns, SI, at the shapes that score best.
    """

    option: Option
    names: tuple[str, ...]
    expected: Array
    shapes: Mapping[str, float]
    fall: float
    share: float
    inflation: float
    columns: Array
    contribution: Array
    z: float
    rank: int = 1
    freedom: int = 0
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def size(self) -> int:
        """Number of unknowns that the effect adds, shapes included."""
        return len(self.names) + len(self.shapes)

    @property
    def statistic(self) -> float:
        """Chi-square statistic with ``rank`` degrees of freedom, corrected for coloured noise."""
        return self.fall / self.inflation


def score_all(
    base: Base, options: Sequence[Option], jobs: int | None = None
) -> tuple[list[Score], dict[str, str]]:
    """Score every candidate.

    Returns
    -------
    scores : list of Score
        By falling share.
    failed : dict of str to str
        Reason by effect where the extended model could not be solved.
    """
    results = thread_map(lambda option: _attempt(base, option), list(options), jobs)
    scores = [item for item in results if isinstance(item, Score)]
    failed = {
        f"{o.key[0]} at {o.key[1]}": r.message
        for o, r in zip(options, results, strict=True)
        if isinstance(r, Status)
    }
    failed |= {
        f"{o.key[0]} at {o.key[1]}": r
        for o, r in zip(options, results, strict=True)
        if isinstance(r, str)
    }
    return sorted(scores, key=lambda item: -item.share), failed


def _attempt(base: Base, option: Option) -> Score | Status | str:
    """The score, or why there is none."""
    candidate = option.candidate
    shapes = [
        dict(zip(candidate.shapes, values, strict=True))
        for values in product(*candidate.shapes.values())
    ]
    columns = _columns(base, option, shapes)
    if isinstance(columns, Status):
        return columns
    best, used, thinned = None, columns[0], []
    for values, block in zip(shapes, columns, strict=True):
        score = _evaluate(base, option, values, block)
        if score is None:
            continue
        thinned.append(score.columns)
        if best is None or score.fall > best.fall:
            best, used = score, block
    if best is None:
        seen = any(item.any() for block in columns for item in block.by_run)
        return SPANNED if seen else UNRESOLVED
    inflation, freedom = inflation_of(base, _directions(base, used, best.expected))
    return replace(best, columns=np.concatenate(thinned), inflation=inflation, freedom=freedom)


def _columns(
    base: Base, option: Option, shapes: Sequence[Mapping[str, float]]
) -> list[Block] | Status:
    """Derivatives of the outputs with respect to the new unknowns, for each set of shapes."""
    fixed = [name for name in option.model.estimated() if name not in option.candidate.parameters]
    return sensitivities_of(base.fit, option.model.fixing(*fixed), shapes)


def _evaluate(
    base: Base, option: Option, values: Mapping[str, float], block: Block
) -> Score | None:
    k, size = len(block.names), base.gram.shape[0]
    cross, own, score = np.zeros((size, k)), np.zeros((k, k)), np.zeros(k)
    columns = [flat(item) * run.scale for run, item in zip(base.runs, block.by_run, strict=True)]
    for run, new in zip(base.runs, columns, strict=True):
        parts = run.products(new)
        cross, own, score = cross + parts[0], own + parts[1], score + parts[2]
    project = coefficients(base.gram, cross)
    information = own - cross.T @ project
    score = score - project.T @ base.gradient
    keep = remains(base.gram, project, own, information)
    if not keep.any() or not np.isfinite(information).all():
        return None
    expected = np.zeros(k)
    unit = np.sqrt(np.diag(information)[keep])
    inner = information[np.ix_(keep, keep)] / np.outer(unit, unit)
    solution, _, rank, _ = np.linalg.lstsq(inner, score[keep] / unit, rcond=1e-10)
    expected[keep] = solution / unit
    if not _allowed(option, block.names, expected):
        expected = np.zeros(k)
    fall = float(expected @ score)
    thin = _thinned(base, columns, project)
    norms = np.linalg.norm(thin, axis=1, keepdims=True)
    root = float(np.sqrt(max(fall, 0.0)))
    return Score(
        option=option,
        names=block.names,
        expected=expected,
        shapes=dict(values),
        fall=fall,
        share=fall / base.fall_back,
        inflation=1.0,
        columns=(thin / np.where(norms > 0, norms, 1.0))[keep],
        contribution=expected @ thin,
        z=root * float(np.sign(expected[0])) if k == 1 else root,
        rank=int(rank),
        information=information,
    )


def _allowed(option: Option, names: Sequence[str], expected: Array) -> bool:
    """Whether the expected values lie on the physical side of a one-sided null."""
    for name, value in zip(names, expected, strict=True):
        sign = option.candidate.sign.get(name.split("[")[0], 0)
        if sign * value < 0:
            return False
    return True


def _thinned(base: Base, columns: Sequence[Array], project: Array) -> Array:
    """``C_perp`` in noise units at some samples, shape (k, n)."""
    rows = []
    for run, new in zip(base.runs, columns, strict=True):
        rows.append(new[:, run.chosen] - project.T @ run.sensitivity[:, run.chosen])
    return np.concatenate(rows, axis=1)


def _directions(base: Base, block: Block, expected: Array) -> list[Array]:
    """What the expected parameters add to each run beside the present ones, in noise units."""
    columns = [flat(item) * run.scale for run, item in zip(base.runs, block.by_run, strict=True)]
    cross = np.zeros((base.gram.shape[0], expected.size))
    for run, new in zip(base.runs, columns, strict=True):
        cross += run.products(new)[0]
    project = coefficients(base.gram, cross)
    return [
        expected @ new - (project @ expected) @ run.sensitivity
        for run, new in zip(base.runs, columns, strict=True)
    ]
