"""Which named terms a function lacks: a score test of each, and the best one added."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._session.function_work import (
    Call,
    FunctionFit,
    FunctionWork,
    Sum,
    arguments_of,
    call_of,
    function_problem,
    unknowns_of,
)
from bayesoleo._types import Array
from bayesoleo._workflow.settings import Settings
from bayesoleo.assessment._residual_tests import autocorrelation_time
from bayesoleo.discovery._score_basis import coefficients, remains
from bayesoleo.errors import InputError, number_of
from bayesoleo.model._parameters import Parameter
from bayesoleo.model._priors import Normal

#: Probability by chance, corrected for the number of terms, below which a term is added.
SIGNIFICANT = 0.01
_EXAMPLE = 'write candidates={"cubic": lambda x, c: c*x**3}'


@dataclass(frozen=True)
class Term:
    """A term that may be missing.

    Parameters
    ----------
    name : str
    call : Call
    parameters : mapping of str to Parameter
        Its coefficients, by the names they get in the extended function.
    """

    name: str
    call: Call
    parameters: Mapping[str, Parameter]


@dataclass(frozen=True)
class TermScore:
    """The score of a term.

    Parameters
    ----------
    term : Term
    expected : ndarray, shape (k,)
        Coefficients that the score expects.
    gain : float
        Part of the residual's sum of squares that it would explain.
    p_value : float
        By the F distribution, corrected for the number of terms.
    """

    term: Term
    expected: Array
    gain: float
    p_value: float


@dataclass(frozen=True)
class TermSearch:
    """A finished search for missing terms.

    Parameters
    ----------
    work : FunctionWork
        With the function as extended.
    fit : tuple of (FunctionFit, DataTree)
        Its estimate.
    groups : mapping of str to Dataset
        The group ``discovery``.
    attributes : mapping of str to str
        Of the result's tree.
    """

    work: FunctionWork
    fit: tuple[FunctionFit, xr.DataTree]
    groups: Mapping[str, xr.Dataset]
    attributes: Mapping[str, str]

    def tree(self) -> xr.DataTree:
        """The result."""
        fit, _ = self.fit
        found = self.work.tree(fit, self.groups)
        found.attrs.update(self.attributes)
        return found

    def sample(self, settings: Settings, out: Path | None, progress: float) -> xr.DataTree:
        """The result with the posterior of the extended function."""
        fit, _ = self.fit
        work = self.work.with_settings(settings)
        found = work.sample(fit, self.tree(), out, progress)
        found.attrs.update(self.attributes)
        return found


def search_terms(
    work: FunctionWork, fit: FunctionFit, candidates: object, callback: Callable[[str], None]
) -> tuple[TermSearch, xr.DataTree]:
    """Add the most significant term, estimate again, and go on until none is significant.

    Raises
    ------
    InputError
        If there are no candidates, or one is no function that vanishes with its coefficients.
    """
    terms = _terms(work, candidates)
    names = [term.name for term in terms]
    rounds: list[list[TermScore]] = []
    left = terms
    tree = work.tree(fit, {})
    while left:
        callback(f"round {len(rounds) + 1}: score {number_of(len(left), 'term')}")
        scores = sorted(_scores(work, fit, left, len(terms)), key=lambda item: item.p_value)
        rounds.append(scores)
        best = scores[0] if scores else None
        full = len(work.added) >= work.settings.max_effects
        if best is None or best.p_value > SIGNIFICANT or full:
            break
        work = _extended(work, best)
        fit, tree = work.fit("mbe", callback)
        left = [term for term in left if term.name != best.term.name]
    last = rounds[-1] if left else []
    open_ = bool(last) and last[0].p_value <= SIGNIFICANT
    verdict = schema.UNEXPLAINED if open_ else schema.EFFECT_ADDED
    attributes = {
        schema.EFFECTS: json.dumps(list(work.added)),
        schema.VERDICT: verdict if work.added else "no candidate is significant",
    }
    groups = {schema.DISCOVERY: _discovery(rounds, names, work.added)}
    search = TermSearch(work, (fit, tree), groups, attributes)
    return search, search.tree()


def _terms(work: FunctionWork, candidates: object) -> list[Term]:
    if not isinstance(candidates, Mapping) or not candidates:
        raise InputError(
            "a function needs named terms to be tried", key="candidates", value=candidates,
            hint=_EXAMPLE,
        )  # fmt: skip
    return [_term(work, str(name), function) for name, function in candidates.items()]


def _term(work: FunctionWork, name: str, function: Callable[..., Any]) -> Term:
    key = f"candidates[{name!r}]"
    if not callable(function):
        raise InputError("is not a function", key=key, value=function, hint=_EXAMPLE)
    inputs = list(work.inputs)
    own = [arg for arg in arguments_of(function) if arg not in inputs]
    if not own:
        raise InputError("has no coefficient", key=key, hint=_EXAMPLE)
    if own[0] == arguments_of(function)[0] and len(own) > 1 and len(inputs) == 1:
        own = own[1:]  # the first argument is the only input, by another name
    coefficients_ = {arg: Parameter(0.0, sd=1.0) for arg in own}
    call = call_of(function, inputs, coefficients_)
    sizes = [_size(work, call, number, len(own)) for number in range(len(own))]
    zero = np.asarray(call(work.inputs, np.zeros(len(own))))
    if np.any(zero != 0.0):
        raise InputError(
            "does not vanish where its coefficients are zero", key=key,
            value=float(np.max(np.abs(zero))), hint=_EXAMPLE,
        )  # fmt: skip
    # As wide a prior as a term may need that is as large as the whole output.
    parameters = {
        f"{name}_{arg}": Parameter(0.0, prior=Normal(0.0, size))
        for arg, size in zip(own, sizes, strict=True)
    }
    return Term(name, call, parameters)


def _size(work: FunctionWork, call: Call, number: int, count: int) -> float:
    """Coefficient with which a term alone is as large as the measured output."""
    unit = np.zeros(count)
    unit[number] = 1.0
    with np.errstate(all="ignore"):
        shape = float(np.sqrt(np.mean(np.square(np.asarray(call(work.inputs, unit))))))
    output = float(np.sqrt(np.mean(np.square(work.table[work.output]))))
    size = output / shape if shape > 0 else 1.0
    return size if np.isfinite(size) and size > 0 else 1.0


def _scores(work: FunctionWork, fit: FunctionFit, terms: list[Term], tests: int) -> list[TermScore]:
    found = fit.problem.evaluate(fit.point.theta)
    (residual,), (slope,) = found.residual, found.sensitivity
    scores = [_score(work, term, residual, slope, tests) for term in terms]
    return [item for item in scores if item is not None]


def _score(
    work: FunctionWork, term: Term, residual: Array, slope: Array, tests: int
) -> TermScore | None:
    """Rao's score test with an F distribution; None where the function can do the same already."""
    problem = function_problem(
        term.call, work.inputs, np.zeros(residual.size), term.parameters, work.output
    )
    null = problem.evaluate(np.zeros(len(term.parameters)))
    if not null.status.ok:
        return None
    (new,) = null.sensitivity
    gram, cross, own = slope.T @ slope, slope.T @ new, new.T @ new
    project = coefficients(gram, cross)
    information = own - cross.T @ project
    if not remains(gram, project, own, information).all():
        return None
    score = new.T @ residual - project.T @ (slope.T @ residual)
    expected = np.linalg.lstsq(information, score, rcond=1e-12)[0]
    fall, total, size = float(expected @ score), float(residual @ residual), len(score)
    freedom = residual.size - slope.shape[1] - size
    if freedom < 1:
        return None
    # Samples whose errors are correlated count for fewer: the remainder with the term tells by how
    # much. Another term that is missing is smooth as well, so that the test is then conservative.
    left = residual - (new - slope @ project) @ expected
    together = _correlated_samples(left, slope.shape[1] + size)
    ratio = (fall / size) / max((total - fall) / freedom, np.finfo(float).tiny) / together
    freedom = max(freedom / together, 1.0)
    local = float(distributions.f.sf(ratio, size, freedom))
    p_value = float(-np.expm1(tests * np.log1p(-min(local, 1 - 1e-16))))
    return TermScore(term, expected, fall / total, p_value)


def _correlated_samples(left: Array, fitted: int) -> float:
    """Samples that count for one: the larger of the measured autocorrelation time and that of a
    first-order autoregression, whose coefficient is corrected for the parameters that were fitted
    (Marriott and Pope 1954, extended from a mean and a trend to ``fitted`` smooth terms)."""
    power = float(left @ left)
    if left.size < 20 or power == 0.0:
        return 1.0
    first = float(left[1:] @ left[:-1]) / power
    if first <= 2.0 / np.sqrt(left.size):  # as white as chance makes it
        return 1.0
    first = min(first + (fitted + (fitted + 2) * first) / left.size, 0.99)
    return max(autocorrelation_time(left), (1.0 + first) / (1.0 - first))


def _extended(work: FunctionWork, best: TermScore) -> FunctionWork:
    """The function with a term, which starts at the coefficients that the score expects."""
    base = work.call
    if not isinstance(base, Sum):
        base = Sum(base, len(unknowns_of(work.parameters)), ())
    added = {
        name: Parameter(float(value), prior=item.prior)
        for (name, item), value in zip(best.term.parameters.items(), best.expected, strict=True)
    }
    call = replace(base, terms=(*base.terms, (best.term.call, len(added))))
    parameters = {**work.parameters, **added}
    return replace(work, call=call, parameters=parameters, added=(*work.added, best.term.name))


def _discovery(
    rounds: list[list[TermScore]], names: list[str], added: tuple[str, ...]
) -> xr.Dataset:
    dims, shape = (schema.ROUND, schema.EFFECT), (len(rounds), len(names))
    gain, p_value = np.full(shape, np.nan), np.full(shape, np.nan)
    expected = np.full(shape, "", dtype=object)
    for row, scores in enumerate(rounds):
        for score in scores:
            column = names.index(score.term.name)
            gain[row, column], p_value[row, column] = score.gain, score.p_value
            values = dict(zip(score.term.parameters, map(float, score.expected), strict=True))
            expected[row, column] = json.dumps(values)
    accepted = [*added, *[""] * len(rounds)][: len(rounds)]
    return xr.Dataset(
        {
            schema.GAIN: (dims, gain, {schema.UNITS: "1"}),
            schema.P_VALUE: (dims, p_value, {schema.UNITS: "1"}),
            schema.EXPECTED: (dims, expected.astype(str)),
            schema.ACCEPTED: (schema.ROUND, np.array(accepted, dtype=str)),
        },
        coords={schema.ROUND: np.arange(1, len(rounds) + 1), schema.EFFECT: names},
    )
