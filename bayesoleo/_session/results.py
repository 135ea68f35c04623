"""Results of a session: an estimate, a posterior, and what a model lacks."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from rich.console import Console

from bayesoleo import _schema as schema, plots
from bayesoleo._report.page import write_report
from bayesoleo._report.sentences import certainty
from bayesoleo._report.terminal import print_summary
from bayesoleo._schema import LabelledResult, columns
from bayesoleo._session import display
from bayesoleo._session.campaign import (
    DELAY,
    SAMPLING,
    SEARCHING,
    Campaign,
    CampaignSearch,
    CampaignWork,
    changed,
    status_line,
)
from bayesoleo._session.display import Result, Showing, html, kept, number, result
from bayesoleo._session.function_work import FunctionWork
from bayesoleo._session.terms import TermSearch, search_terms
from bayesoleo._storage.files import write_text_atomic
from bayesoleo._storage.result_files import read_tree, write_tree
from bayesoleo._workflow.predicting import predict
from bayesoleo._workflow.task import reduce
from bayesoleo.assessment._assess import assess
from bayesoleo.errors import InputError, ResultsError, check_path, number_of
from bayesoleo.estimation._baselines import baselines_in, table
from bayesoleo.estimation._indifference_regions import indifference
from bayesoleo.estimation._profile_likelihood import profile
from bayesoleo.estimation._sampling_distribution import sampling_distribution
from bayesoleo.plots._style import format_unit
from bayesoleo.posterior._comparison import compare, comparison_text

Work = CampaignWork | FunctionWork
Pairs = Sequence[tuple[str, str]]
#: Quantiles of a posterior's summary.
LOW, HIGH = 0.025, 0.975
_SHOWN = (schema.START, schema.ESTIMATE, schema.SD)


class Stored(Showing):
    """A result whose numbers are one tree.

    Parameters
    ----------
    tree : DataTree
        Laid out as :mod:`bayesoleo._schema` names it.
    work : CampaignWork or FunctionWork, optional
        What computes; a loaded result has none.
    """

    def __init__(self, tree: xr.DataTree, work: Work | None = None) -> None:
        self.tree, self._work = tree, work

    @property
    def parameters(self) -> pd.DataFrame:
        """Unit, start, estimate and standard deviation of each parameter."""
        point = self.tree[schema.POINT].to_dataset()
        keys = (schema.UNIT, schema.START, schema.ESTIMATE, schema.SD)
        names = pd.Index(point[schema.PARAMETER].values.astype(str), name=schema.PARAMETER)
        return pd.DataFrame({key: point[key].values for key in keys}, index=names)

    @property
    def offsets(self) -> pd.DataFrame:
        """Offsets of outputs that drift, as far as the fitted runs have them in common, SI.

        The mean of such an output is an unknown of each run, so that a prediction of another one
        lacks the offset of its sensor; ``predict(..., common_offset=True)`` adds it. Columns are
        ``offset``, ``sd`` (of it in another run), ``unit`` and the ``runs`` that it follows from.
        """
        return table(baselines_in(self.tree[schema.POINT].to_dataset())).to_dataframe()

    def predict(self, data: Any = None, **options: Any) -> Result:
        """Predict runs, or a function at other inputs, with intervals.

        Parameters
        ----------
        data : Campaign, path-like or table, optional
            Of a campaign: another one; by default the runs of this one, those held out too. Of a
            function: its inputs; by default those of the data.
        **options
            Of a campaign those of ``predict``, as ``runs``, ``level`` and ``common_offset``; of
            a function ``level``, and ``noise=False`` for the interval of the function itself.

        Returns
        -------
        Result
            ``mean``, ``low``, ``high`` and more.

        Examples
        --------
        >>> fit.predict(runs=["fast"]).plot()  # doctest: +SKIP
        """
        if isinstance(data, Campaign):
            data = data.reduced
        if isinstance(self._work, FunctionWork):
            return result(self._work.predict(self.tree, data, **options), "prediction")
        if self._work is not None:
            return result(self._work.predict(self.tree, data, **options), "forecast")
        if data is None:
            raise ResultsError(
                "a loaded result needs the runs that it is to predict", key="data",
                hint='give a campaign: predict(bo.load_campaign("folder"))',
            )  # fmt: skip
        return result(predict(self.tree, reduce(data), **options), "forecast")

    def to_datatree(self) -> xr.DataTree:
        """All numbers as one tree; what was computed from this object meanwhile is in it."""
        found = self.tree.copy()
        for item in self.__dict__.get("_kept", {}).values():
            if isinstance(item, Result) and item.kind in schema.GROUPS:
                found[item.kind] = xr.DataTree(item.data)
        return found

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the tree as netCDF, or as Zarr where the name ends in ``.zarr``.

        Returns
        -------
        Path
            The file; :func:`load_result` reads it.
        """
        check_path(path, "path", hint='write save("results.nc")')
        write_tree(self.to_datatree(), path)
        return Path(path)

    def _computing(self) -> Work:
        if self._work is None:
            raise ResultsError(
                "a loaded result holds numbers only", value=type(self).__name__,
                hint="fit again to compute more: bo.Problem(…).fit()",
            )  # fmt: skip
        return self._work

    def _point_text(self) -> str:
        rows = []
        for name, row in self.parameters.iterrows():
            start, value, sd = (float(row[key]) for key in _SHOWN)
            cells = [f"{start:.6g}", number(value, sd), f"{sd:.2g}"]
            rows.append([str(name), format_unit(str(row[schema.UNIT])) or "1", *cells])
        return columns(["parameter", "unit", "start", "estimate", "sd"], rows)


class Fit(Stored):
    """An estimate, and the questions about it. Made by :meth:`Problem.fit`.

    Examples
    --------
    >>> from bayesoleo import Parameter, Problem
    >>> x = np.linspace(0.0, 1.0, 50)
    >>> data = {"x": x, "y": 3 * x + 0.1 * np.sin(40 * x)}
    >>> fit = Problem(data, lambda x, a: a * x, parameters={"a": Parameter(1.0, sd=9.0)}).fit()
    >>> fit.profile()
    parameter  estimate  low 95 %     high  linear low  linear high
    a           3.00693   2.97254  3.04131      2.9732      3.04066
    """

    def __init__(self, tree: xr.DataTree, work: Work | None = None, found: Any = None) -> None:
        super().__init__(tree, work)
        self._found = found

    @property
    def residuals(self) -> xr.Dataset:
        """Residual, measurement and prediction of each fitted run, ``(run, sample)``."""
        return display.residuals(self.tree)

    def plot(self, output: str | None = None) -> Figure:
        """Measurement, prediction and residual of each run.

        Parameters
        ----------
        output : str, optional
            Channel; by default all.
        """
        return display.fit_and_residual(self.residuals, output)

    @kept
    def profile(
        self, names: Sequence[str] | None = None, *, progress: bool = True, **options: Any
    ) -> Result:
        """Profile the objective along each parameter, all others re-estimated.

        Parameters
        ----------
        names : sequence of str, optional
            By default all.
        progress : bool
        **options
            Those of :func:`bayesoleo.estimation.profile`, as ``level``.

        Examples
        --------
        >>> fit.profile(["stiffness"]).plot()  # doctest: +SKIP
        """
        problem = self._computing().problem(self._found)
        with status_line(progress) as callback:
            found = profile(problem, self._found.point, names, progress=callback, **options)
        return result(found, schema.PROFILE)

    @kept
    def indifference(
        self, pairs: Pairs | None = None, *, progress: bool = True, **options: Any
    ) -> Result:
        """Contours of pairs of parameters that the data hardly distinguish, and principal axes.

        Parameters
        ----------
        pairs : sequence of (str, str), optional
            By default all.
        progress : bool
        **options
            Those of :func:`bayesoleo.estimation.indifference`.

        Examples
        --------
        >>> fit.indifference([("damping", "stiffness")]).plot()  # doctest: +SKIP
        """
        problem = self._computing().problem(self._found)
        with status_line(progress) as callback:
            found = indifference(problem, self._found.point, pairs, progress=callback, **options)
        return result(found, schema.INDIFFERENCE)

    @kept
    def sampling_distribution(
        self, n: int = 1000, *, progress: bool = True, **options: Any
    ) -> Result:
        """Simulate the experiment ``n`` times, estimate from each, and compare with theory.

        Parameters
        ----------
        n : int
            Number of simulated experiments.
        progress : bool
        **options
            Those of :func:`bayesoleo.estimation.sampling_distribution`, as ``seed``.

        Examples
        --------
        >>> fit.sampling_distribution(1000)["bias"]  # doctest: +SKIP
        """
        work = self._computing()
        given = {"seed": work.settings.seed, "jobs": work.settings.jobs, **options}
        found = sampling_distribution(
            work.problem(self._found),
            self._found.point,
            replications=n,
            progress=_delay(progress),
            **given,
        )
        return result(found, schema.SAMPLING_DISTRIBUTION)

    @kept
    def assess(self) -> Result:
        """Test the residuals: randomness, normality, memory, lack of fit, outliers.

        Examples
        --------
        >>> fit.assess()["rms"]  # doctest: +SKIP
        """
        if self._work is None:
            return result(assess(self.tree), schema.ASSESSMENT)
        found = assess(self._work.problem(self._found), self._found.point)
        return result(found, schema.ASSESSMENT)

    @kept
    def sample(
        self,
        *,
        out: str | os.PathLike[str] | None = None,
        progress: bool = True,
        **settings: Any,
    ) -> Posterior:
        """Sample the posterior from the estimate.

        Parameters
        ----------
        out : path-like, optional
            Folder of checkpoints, from which a run that was stopped goes on; with
            ``sampler="nuts"`` it starts over.
        progress : bool
        **settings
            ``seed``, ``effective_size``, ``sampler``, ``quick``, ``jobs``, ``scheduler``;
            see :class:`Settings`.

        Returns
        -------
        Posterior

        Examples
        --------
        >>> posterior = fit.sample(effective_size=2000, seed=1)  # doctest: +SKIP
        """
        work = self._computing()
        work = work.with_settings(changed(work.settings, settings, SAMPLING))
        tree = work.sample(self._found, self.tree, _folder(out), _delay(progress))
        return Posterior(tree, work)

    @kept
    def explain(
        self,
        candidates: Mapping[str, Any] | None = None,
        *,
        out: str | os.PathLike[str] | None = None,
        progress: bool = True,
        **settings: Any,
    ) -> Explanation:
        """Find what is missing: score effects, add the best, compare, and go on until none helps.

        Parameters
        ----------
        candidates : mapping of str to callable, optional
            Of a function: named terms, ``{"cubic": lambda x, c: c*x**3}``, zero where their
            coefficients are. Each is added while it is significant at 1 %.
        out : path-like, optional
            Of a campaign: folder of the result, in which a search that was stopped goes on.
        progress : bool
        **settings
            ``effects``, ``without``, ``max_effects``, ``seed``, ``jobs``; see :class:`Settings`.

        Returns
        -------
        Explanation

        Examples
        --------
        >>> found = fit.explain(max_effects=2)  # doctest: +SKIP
        """
        work = self._computing()
        if isinstance(work, CampaignWork) and candidates is not None:
            raise InputError(
                "named terms are for functions", key="candidates", value=list(candidates),
                hint="write effects=(bayesoleo.effects.force_effect(…),)",
            )  # fmt: skip
        if isinstance(work, FunctionWork) and out is not None:
            raise InputError("a search of terms keeps nothing", key="out", hint="leave it out")
        work = work.with_settings(changed(work.settings, settings, SEARCHING))
        search: CampaignSearch | TermSearch
        with status_line(progress) as callback:
            if isinstance(work, FunctionWork):
                search, tree = search_terms(work, self._found, candidates, callback)
            else:
                search, tree = work.explain(out, callback)
        return Explanation(tree, search.work, search)

    def _text(self) -> str:
        point = self.tree[schema.POINT].to_dataset()
        lines = [f"fit of {self.tree.attrs.get(schema.MODEL, '')}", self._point_text()]
        for name, variance in zip(
            point[schema.OUTPUT].values, point[schema.VARIANCE].values, strict=True
        ):
            sd = float(np.sqrt(variance))
            more = display.misfit(self.tree, name, sd)
            lines.append(f"{name}: residual standard deviation {sd:.4g}{more}")
        more = "; fit.assess() and fit.explain() test whether the model is complete"
        lines.append(str(point.attrs["status_message"]) + more)
        return "\n".join([*lines, *json.loads(point.attrs.get("notes", "[]"))])


class Posterior(Stored):
    """Draws of the posterior. Made by ``sample``; ArviZ reads :attr:`tree`.

    Examples
    --------
    >>> posterior = fit.sample()  # doctest: +SKIP
    >>> arviz.summary(posterior.tree)  # doctest: +SKIP
    """

    @kept
    def summary(self) -> Result:
        """Mean, standard deviation, quantiles and effective size of each quantity."""
        drawn = _single(self.tree[schema.POSTERIOR].to_dataset())
        about = self.tree[schema.SAMPLE_STATS].attrs
        names, draws = list(drawn), [item.values for item in drawn.values()]
        quantiles = np.array([np.quantile(values, [LOW, HIGH]) for values in draws])
        numbers = {
            "mean": [values.mean() for values in draws],
            schema.SD: [values.std() for values in draws],
            "low": quantiles[:, 0],
            "high": quantiles[:, 1],
        }
        for key in ("effective_sample_size", "rhat_nested"):
            each = json.loads(str(about.get(key, "{}")))
            each = each if isinstance(each, dict) else dict.fromkeys(names, each)
            numbers[key] = [float(each.get(name, np.nan)) for name in names]
        data = xr.Dataset(
            {key: (schema.PARAMETER, values) for key, values in numbers.items()},
            coords={schema.PARAMETER: names},
        )
        units = [str(item.attrs.get(schema.UNITS, "")) for item in drawn.values()]
        data[schema.UNIT] = (schema.PARAMETER, units)
        data.attrs["warning"] = str(about.get("warning", ""))
        shown = LabelledResult(data, _summary_text(data))
        return replace(result(shown, "point_against_posterior"), source=self.tree)

    def plot(self, parameters: list[str] | None = None) -> Figure:
        """Densities of parameters, one by one and pair by pair."""
        return plots.corner(self.tree, parameters)

    def trace(self) -> Figure:
        """The chains of the sampler."""
        return plots.trace(self.tree)

    def _repr_html_(self) -> str:
        # Pairs of ten parameters take seconds to draw.
        return html(self._text(), lambda: plots.point_against_posterior(self.tree))

    def compare(self, *others: Result) -> Result:
        """Compare the posterior with the normal approximation at the estimate.

        Parameters
        ----------
        *others : Result
            Of :meth:`Fit.sampling_distribution` and :meth:`Fit.indifference`, to be compared with
            as well.

        Examples
        --------
        >>> posterior.compare(fit.indifference())  # doctest: +SKIP
        """
        groups = {name: self.tree[name].to_dataset() for name in self.tree.children}
        data = compare({**groups, **{item.kind: item.data for item in others}})
        shown = LabelledResult(data, comparison_text(data))
        return replace(result(shown, "point_against_posterior"), source=self.tree)

    def _text(self) -> str:
        posterior = self.tree[schema.POSTERIOR]
        chains = number_of(posterior.sizes[schema.CHAIN], "chain")
        size = f"{chains} of {number_of(posterior.sizes[schema.DRAW], 'draw')}"
        found = self.summary()
        warning = f"\nwarning: {found.data.attrs['warning']}" if found.data.attrs["warning"] else ""
        return f"posterior of {self.tree.attrs.get(schema.MODEL, '')}: {size}\n{found}{warning}"


class Explanation(Stored):
    """What a model lacks, found and added. Made by :meth:`Fit.explain`.

    Examples
    --------
    >>> found = fit.explain()  # doctest: +SKIP
    >>> found.effects, found.verdict  # doctest: +SKIP
    """

    def __init__(
        self,
        tree: xr.DataTree,
        work: Work | None = None,
        search: CampaignSearch | TermSearch | None = None,
    ) -> None:
        super().__init__(tree, work)
        self._search = search

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects or terms that were added, in this order."""
        return tuple(json.loads(self.tree.attrs[schema.EFFECTS]))

    @property
    def verdict(self) -> str:
        """``nothing missing``, ``effect added`` or ``unexplained remainder``; for a function
        without a significant term, a sentence that says so.

        It says whether the error was explained, :attr:`certainty` how sure the name is: most of an
        error may be explained by an effect that only resembles the true one.
        """
        return str(self.tree.attrs[schema.VERDICT])

    @property
    def certainty(self) -> str | None:
        """How sure the names of the added effects are: ``certain``, ``probable``, ``likeness`` or
        ``no cause``; None where none was added, and for a function."""
        summary = json.loads(self.tree.attrs.get(schema.SUMMARY, '{"effects": []}'))
        return certainty(summary)

    @property
    def structures(self) -> Result:
        """Probabilities of what may be missing: nothing, each effect, something outside the
        catalogue, and the leading structures.

        Raises
        ------
        ResultsError
            Of a function, whose terms are tested one by one, and of a search that was stopped early
            or could score no candidate.

        Examples
        --------
        >>> found.structures["probability"]  # doctest: +SKIP
        """
        if schema.SUMMARY not in self.tree.attrs:
            raise ResultsError(
                "terms of a function are tested one by one and have no probabilities of structures",
                key="structures", hint="see the p-values that this result shows",
            )  # fmt: skip
        summary = json.loads(self.tree.attrs[schema.SUMMARY])
        if not summary.get("structures"):
            raise ResultsError(
                "this result holds no probabilities of structures", key="structures",
                hint="the search was stopped early, scored no candidate, or is of an older version:"
                " explain() once more",
            )  # fmt: skip
        shown = LabelledResult(display.structures_data(summary), display.structures_text(summary))
        return replace(result(shown, "structures"), source=self.tree)

    @property
    def fit(self) -> Fit:
        """The estimate of the extended model."""
        return self._extended()

    @kept
    def _extended(self) -> Fit:
        work = self._computing()
        assert self._search is not None
        found, tree = self._search.fit
        return Fit(tree, work, found)

    def plot(self) -> Figure:
        """Error of each run before and after; of a function, the fit with the added terms."""
        if schema.SUMMARY in self.tree.attrs:
            return plots.error(self.tree)
        return display.fit_and_residual(display.residuals(self.tree))

    @kept
    def sample(
        self,
        *,
        out: str | os.PathLike[str] | None = None,
        progress: bool = True,
        **settings: Any,
    ) -> Posterior:
        """Sample the posterior of the extended model; the report shows it from then on.

        Parameters
        ----------
        out, progress, **settings
            As of :meth:`Fit.sample`.

        Returns
        -------
        Posterior
        """
        work = self._computing()
        assert self._search is not None
        chosen = changed(work.settings, settings, SAMPLING)
        self.tree = self._search.sample(chosen, _folder(out), _delay(progress))
        return Posterior(self.tree, work)

    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write a self-contained HTML page.

        Returns
        -------
        Path
            The file.
        """
        if schema.SUMMARY in self.tree.attrs:
            write_report(self.tree, path)
        else:
            title = escape(str(self.tree.attrs.get(schema.MODEL, "")))
            head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
            head += f"<title>{title}</title>"
            body = f"<h1>{title}</h1>{html(self._text(), self.plot)}"
            page = f'<main style="max-width:900px;margin:auto;font-family:sans-serif">{body}</main>'
            write_text_atomic(path, f'<!doctype html><html lang="en">{head}{page}</html>')
        return Path(path)

    def _text(self) -> str:
        if schema.SUMMARY in self.tree.attrs:
            page = io.StringIO()
            summary = json.loads(self.tree.attrs[schema.SUMMARY])
            print_summary({**summary, "files": {}}, Console(file=page, width=110))
            return page.getvalue().strip("\n")
        added = ", ".join(self.effects) or "none"
        lines = [f"{self.verdict}; added: {added}", _terms_text(self.tree), self._point_text()]
        return "\n\n".join(lines)


def load_result(path: str | os.PathLike[str]) -> Fit | Posterior | Explanation:
    """Load what ``save``, or a command, has written.

    Parameters
    ----------
    path : path-like
        A file ``results.nc``.

    Returns
    -------
    Fit, Posterior or Explanation
        An explanation where effects were looked for, else a posterior where one was sampled. It
        shows itself and predicts runs; to compute anything else, fit again.

    Raises
    ------
    ResultsError
        If it is missing, damaged, or no result.

    Examples
    --------
    >>> load_result("results/results.nc").verdict  # doctest: +SKIP
    """
    check_path(path, "path", hint='write load_result("results/results.nc")')
    tree = read_tree(path)
    if schema.DISCOVERY in tree.children:
        return Explanation(tree)
    if schema.POSTERIOR in tree.children:
        return Posterior(tree)
    if schema.POINT in tree.children:
        return Fit(tree)
    raise ResultsError(
        "holds no estimate", file=path, value=list(tree.children),
        hint="give the results.nc of a fit, a posterior or a search",
    )  # fmt: skip


def _delay(progress: bool) -> float:
    return DELAY if progress else 0.0


def _folder(out: str | os.PathLike[str] | None) -> Path | None:
    return None if out is None else Path(out)


def _single(posterior: xr.Dataset) -> dict[str, xr.DataArray]:
    """Quantities ``(chain, draw)`` by name; those along a dimension as ``name[label]``."""
    found = {}
    for name, item in posterior.data_vars.items():
        own = [dim for dim in item.dims if dim not in (schema.CHAIN, schema.DRAW)]
        if not own:
            found[str(name)] = item
            continue
        for place in np.ndindex(*(item.sizes[dim] for dim in own)):
            one = item.isel(dict(zip(own, place, strict=True)))
            numbered = zip(own, place, strict=True)
            labels = [str(one.coords[d].values if d in one.coords else k) for d, k in numbered]
            found[f"{name}[{', '.join(labels)}]"] = one
    return found


def _summary_text(data: xr.Dataset) -> str:
    head = ["parameter", "unit", "mean", "sd", f"{100 * LOW:.3g} %", f"{100 * HIGH:.3g} %"]
    rows = []
    for name in data[schema.PARAMETER].values:
        one = data.sel({schema.PARAMETER: name})
        sd = float(one[schema.SD])
        values = [number(float(one[key]), sd) for key in ("mean", "low", "high")]
        unit = format_unit(str(one[schema.UNIT].values)) or "1"
        rows.append([str(name), unit, values[0], f"{sd:.2g}"])
        rows[-1] += [*values[1:], f"{float(one['effective_sample_size']):.0f}"]
        rows[-1].append(f"{float(one['rhat_nested']):.3f}")
    return columns([*head, "effective size", "nested R-hat"], rows)


def _terms_text(tree: xr.DataTree) -> str:
    found = tree[schema.DISCOVERY].to_dataset()
    rows = []
    for turn in found[schema.ROUND].values:
        one = found.sel({schema.ROUND: turn})
        for name in one.sortby(schema.P_VALUE)[schema.EFFECT].values:
            term = one.sel({schema.EFFECT: name})
            if np.isfinite(float(term[schema.P_VALUE])):
                share = f"{100 * float(term[schema.GAIN]):.1f} %"
                mark = "added" if str(one[schema.ACCEPTED].values) == name else ""
                p_value = f"{float(term[schema.P_VALUE]):.2g}"
                rows.append([str(name), str(turn), share, p_value, mark])
    return columns(["term", "round", "of residual", "p", ""], rows)
