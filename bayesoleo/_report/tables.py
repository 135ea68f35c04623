"""Tables of the report: rows of text, in engineering units.

An error is compared with its expectation from the noise and the uncertainty of the parameters; in
results that were stored without it, with the noise.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo.effects._catalogue import called, listed, titles_for, with_titles
from bayesoleo.plots import _reading as reading
from bayesoleo.plots._discovery import chosen, format_p, format_share, title
from bayesoleo.plots._style import Scale, engineering, format_number, format_value
from bayesoleo.solvers._orbit import counted

#: A ratio above which an error counts, where a result does not say its own limit.
FLOOR = 1.15


def ratio(errors: Mapping[str, Any]) -> float | None:
    """Error over what is expected of it; None where nothing repeats."""
    value = errors.get(schema.RATIO_TO_EXPECTED, errors[schema.RATIO_TO_NOISE])
    return None if value is None else float(value)


def too_large(errors: Mapping[str, Any]) -> bool:
    """Whether an error is larger than chance allows."""
    found = ratio(errors)
    return found is not None and found > (errors.get("limit") or FLOOR)


def too_small(errors: Mapping[str, Any]) -> bool:
    """Whether an error is smaller than chance allows, so that its noise was measured too large."""
    found = ratio(errors)
    return found is not None and found < (errors.get("lowest") or 0.0)


def words(summary: Mapping[str, Any]) -> str:
    """What the errors of a summary are multiples of."""
    errors = summary["rounds"][-1].get("error", {}).values()
    entries = [e for tables in (errors, summary["error_after"].values())
               for table in tables for e in table.values()]  # fmt: skip
    known = any(schema.RATIO_TO_EXPECTED in entry for entry in entries)
    return "what is expected" if known else "its standard error"


KNOWN_CONSTANTS = (
    schema.FREQUENCY,
    schema.FREQUENCY_SD,
    schema.PERIODS,
    schema.ROLE,
    schema.RUN_GROUP,
)
DIAGNOSTICS = {
    "acceptance": "acceptance fraction",
    "autocorrelation_time": "integrated autocorrelation time, draws",
    "effective_sample_size": "effective sample size",
    "rhat_nested": "nested R̂ over ensembles",
    "evaluations": "evaluations of the posterior",
    "branch_jumps": "solutions that left the estimate's branch",
    "reached": "effective size asked for reached",
    "divergences": "trajectories that diverged",
}
BY_PARAMETER = {
    "autocorrelation_time": ("autocorrelation time, draws", "{:.1f}"),
    "effective_sample_size": ("effective sample size", "{:.0f}"),
    "rhat_nested": ("nested R̂", "{:.3f}"),
}
LEADING_CANDIDATES = 10
LEADING_PARAMETERS = 20
#: Part of a frequency below which no digits are shown, however well it is known.
FINEST = 1e-4


@dataclass(frozen=True)
class Table:
    """Head and rows of text; ``words`` leading columns hold words, the others numbers.

    Of many rows the first ``lead`` are shown, the rest when asked for; all of them if it is None.
    Columns in ``code`` hold what is typed as it stands.
    """

    head: list[str]
    rows: list[list[str]]
    words: int = 1
    marked: frozenset[int] = frozenset()
    lead: int | None = None
    code: frozenset[int] = frozenset()


def output_units(tree: xr.DataTree, summary: Mapping[str, Any]) -> dict[str, str]:
    """SI unit of each channel."""
    data = reading.group(tree, schema.RECORDS)
    found = {} if data is None else {str(n): reading.unit(v) for n, v in data.data_vars.items()}
    return {**dict(summary.get("units", {})), **found}


def error_scale(unit: str, entries: Iterable[Mapping[str, Any]]) -> Scale:
    """One unit for a table of errors: that of its median."""
    values = [e[key] for e in entries for key in ("rms", "repeating") if e.get(key) is not None]
    return engineering(unit, float(np.median(values)) if values else 0.0)


def noise_of(entry: Mapping[str, Any]) -> float | None:
    """Noise of the averaged residual, from the ratio where it is not said."""
    ratio = entry.get("ratio_to_noise")
    if entry.get("noise") is None and ratio:
        return float(entry["repeating"] / ratio)
    return entry.get("noise")


def arrow(before: float | None, after: float | None, factor: float = 1.0, two: bool = True) -> str:
    """``12.3 → 4.56``; one number where nothing was added."""
    texts = [format_short(None if v is None else factor * v) for v in (before, after)]
    return " → ".join(texts) if two else texts[1]


def format_short(value: float | None) -> str:
    """Three digits: an error is not known better."""
    if value is None or not np.isfinite(value):
        return "–"
    if 999.5 <= abs(value) < 1e5:
        return f"{float(f'{value:.3g}'):.0f}"
    if value == 0.0 or not 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}"
    return f"{value:#.3g}".rstrip(".")


def format_ratio(value: float | None) -> str:
    """A ratio of errors: two decimals, of large ones three digits."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.2f}" if value < 9.995 else format_short(value)


def ratios(before: Mapping[str, Any], after: Mapping[str, Any], two: bool) -> str:
    """Ratio before and after: ``1.81 → 1.00``; one number where nothing was added."""
    texts = [format_ratio(ratio(errors)) for errors in (before, after)]
    return " → ".join(texts) if two else texts[1]


def error_by_role(
    summary: Mapping[str, Any], units: Mapping[str, str], averaged: str = "repeating"
) -> Table:
    """Error before and after, pooled over the hold-out and over the fitted runs.

    ``averaged`` is what the error of an average is called.
    """
    before, after = summary["error_before"], summary["error_after"]
    two = len(summary["rounds"]) > 1
    known = _expected_known(after)
    rows = []
    for role in (schema.HOLD_OUT, schema.FIT):
        for output, first in before.get(role, {}).items():
            last = after.get(role, {}).get(output, first)
            scale = error_scale(units.get(output, ""), (first, last))
            pairs = [arrow(first[k], last[k], scale.factor, two) for k in ("rms", "repeating")]
            floors = [noise_of(last), *([last.get("expected")] if known else [])]
            shown = [format_short(None if v is None else scale.factor * v) for v in floors]
            times = ratios(first, last, two)
            rows.append([role, output, *pairs, *shown, scale.unit, times])
    head = ["runs", "output", "rms", averaged, "standard error", *_expected_head(known), "unit"]
    head.append(f"{averaged} / {_ratio_head(known)}")
    return Table(head, rows, 2, frozenset(i for i, row in enumerate(rows) if row[0] != schema.FIT))


def error_by_run(
    summary: Mapping[str, Any], units: Mapping[str, str], averaged: str = "repeating"
) -> dict[str, Table]:
    """Error before and after of every run, a table for each output; see :func:`error_by_role`."""
    rounds = summary["rounds"]
    two = len(rounds) > 1
    known = _expected_known(summary["error_after"])
    keys = ["rms", "repeating", "noise", *_expected_head(known)]
    tables = {}
    for output, first in rounds[0]["error"].items():
        last = rounds[-1]["error"].get(output, first)
        scale = error_scale(units.get(output, ""), [*first.values(), *last.values()])
        rows = []
        for run in sorted(first, key=lambda label: first[label]["role"] == schema.HOLD_OUT):
            a, b = first[run], last.get(run, first[run])
            pairs = [arrow(a.get(k), b.get(k), scale.factor, two) for k in keys]
            rows.append([run, a["role"], *pairs, ratios(a, b, two)])
        unit = f" [{scale.unit}]" if scale.unit else ""
        shown = ["rms", averaged, "standard error", *_expected_head(known)]
        head = ["run", "role", *(f"{text}{unit}" for text in shown)]
        head.append(f"{averaged} / {_ratio_head(known)}")
        marked = frozenset(i for i, row in enumerate(rows) if row[1] == schema.HOLD_OUT)
        tables[output] = Table(head, rows, 2, marked)
    return tables


def _expected_known(errors: Mapping[str, Any]) -> bool:
    """Whether a result says what is expected of its errors."""
    return any("expected" in entry for outputs in errors.values() for entry in outputs.values())


def _expected_head(known: bool) -> list[str]:
    return ["expected"] if known else []


def _ratio_head(known: bool) -> str:
    """What the averaged error is divided by."""
    return "expected" if known else "standard error"


def candidates(entry: Mapping[str, Any], titles: Mapping[str, str] | None = None) -> Table:
    """All candidates of a round, the best first; ids stand beside titles, for options ask for them.

    Parameters
    ----------
    entry : mapping
        A round of the summary.
    titles : mapping of str to str, optional
        Titles of effects by id, besides those of the catalogue.
    """
    titles = titles or {}
    ranked = sorted(entry["candidates"], key=lambda candidate: -candidate["gain"])
    rows = [
        [
            title(candidate),
            candidate["effect"],
            candidate["family"],
            format_share(candidate["gain"]),
            format_p(candidate["p_value"]).removeprefix("p ").removeprefix("= "),
            expected_text(candidate["expected"], candidate.get("expected_units")),
            listed([called(other, titles) for other in candidate["indistinguishable_from"]], ", "),
        ]
        for candidate in ranked
    ]
    head = ["effect", "id", "family", "share", "p", "expected", "not distinguishable from"]
    accepted = chosen(entry)
    marked = frozenset(i for i, c in enumerate(ranked) if c is accepted)
    if not any(row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    return Table(head, rows, 3, marked, LEADING_CANDIDATES, code=frozenset({1}))


def failed(entry: Mapping[str, Any], titles: Mapping[str, str] | None = None) -> Table | None:
    """Candidates of a round that have no score, with the reason; None where all have one."""
    rows = []
    for label, reason in entry.get("failed", {}).items():
        effect, _, place = label.partition(" at ")
        known = titles_for([effect], titles or {})
        which = f"{known.get(effect, effect)} ({place})" if place else known.get(effect, effect)
        rows.append([which, with_titles(reason, known)])
    return Table(["effect", "why it has no score"], sorted(rows), 2) if rows else None


def expected_text(
    expected: Mapping[str, float | None], units: Mapping[str, str] | None = None
) -> str:
    """Expected values with their names and units; those of a parameter of every run as a range.

    Results that were stored without units have SI's, unnamed.
    """
    known = {} if units is None else units
    runs: dict[str, list[float]] = {}
    unit: dict[str, str] = {}
    for label, value in expected.items():
        owner = label.split("[", 1)[0]
        values = runs.setdefault(owner, [])
        unit[owner] = known.get(label, "")
        if value is not None:
            values.append(value)
    return ", ".join(
        f"{_together(f'{label} =')} {_together(_size(values, unit[label]))}"
        for label, values in runs.items()
    )


def _size(values: Sequence[float], unit: str) -> str:
    """One value, or the range of several, with its unit."""
    if not values:
        return format_short(None)
    scale = engineering(unit, max(map(abs, values))) if unit else Scale(1.0, "")
    ends = [
        format_short(scale.factor * end).replace("-", "−") for end in (min(values), max(values))
    ]
    text = f"{' … '.join(ends if len(values) > 1 else ends[:1])} {scale.unit}".rstrip()
    return text + (f" ({len(values)} runs)" if len(values) > 1 else "")


def _together(text: str) -> str:
    """Text that stays on one line."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def parameters(summary: Mapping[str, Any]) -> Table:
    """Estimate and posterior of every parameter, each row in its own unit.

    Beside a constant known to a tolerance stands what was known before the data.
    """
    rows = []
    any_known = any(entry.get("tolerance") for entry in summary["parameters"].values())
    for label, entry in summary["parameters"].items():
        sizes = [abs(entry[k]) for k in ("estimate", "mean", "sd") if entry[k] is not None]
        scale = engineering(entry["unit"], max(sizes, default=0.0))
        sd = None if entry["sd"] is None else scale.factor * entry["sd"]
        values = [_scaled(entry[key], scale, sd) for key in ("estimate", "mean", "sd")]
        interval = entry["interval"]
        text = "–"
        if entry.get("shared_with"):
            text = f"shared with {entry['shared_with']}"
        if interval is not None:
            text = " … ".join(_scaled(bound, scale, sd) for bound in interval)
        known = entry.get("tolerance")
        before = "–"
        if known:
            ends = [
                _scaled(known[key], scale, scale.factor * known["sd"]) for key in ("value", "sd")
            ]
            before = " ± ".join(ends)
        rows.append([label, *values, text, *([before] if any_known else []), scale.unit or "1"])
    head = ["parameter", "estimate", "mean", "sd", "95 % interval"]
    return Table([*head, *(["known before"] if any_known else []), "unit"], rows)


def records(tree: xr.DataTree) -> Table:
    """The runs: role, frequency, periods, conditions, noise of each channel."""
    constant = reading.group(tree, schema.CONSTANT_DATA)
    noise = reading.group(tree, schema.NOISE)
    columns: dict[str, list[str]] = {}
    if constant is not None:
        columns |= _constants(constant)
    if noise is not None:
        for channel, data in noise.data_vars.items():
            scale = engineering(reading.unit(data), _median(data.values))
            unit = f" [{scale.unit}]" if scale.unit else ""
            shown = [format_short(scale.factor * float(v)) for v in data.values]
            columns[f"noise of {channel}{unit}"] = shown
    labels = [run.label for run in reading.runs(tree)]
    roles = [run.role for run in reading.runs(tree)]
    rows = [[label, *(column[i] for column in columns.values())] for i, label in enumerate(labels)]
    marked = frozenset(i for i, role in enumerate(roles) if role == schema.HOLD_OUT)
    words = 1 + sum(column in columns for column in (schema.ROLE, schema.RUN_GROUP))
    return Table(["run", *columns], rows, words, marked)


def diagnostics(tree: xr.DataTree) -> Table | None:
    """How the sampler did; None where nothing was sampled."""
    if schema.SAMPLE_STATS not in tree.children:
        return None
    attributes = tree[schema.SAMPLE_STATS].attrs
    rows = []
    posterior = reading.group(tree, schema.POSTERIOR)
    if posterior is not None:
        sizes = posterior.sizes
        chains = "chains" if attributes.get("sampler") else "walkers"
        rows.append([f"{chains} × draws", f"{sizes[schema.CHAIN]} × {sizes[schema.DRAW]}"])
    for key, value in attributes.items():
        by_parameter = key in BY_PARAMETER and isinstance(_decoded(value), dict)
        if key == "failures" or by_parameter:
            continue
        text = _yes_or_no(value) if key == "reached" else _plain(value)
        rows.append([DIAGNOSTICS.get(str(key), str(key).replace("_", " ")), text])
    rows += _failures(attributes)
    return Table(["sampler", ""], [row for row in rows if row[1]])


def diagnostics_by_parameter(tree: xr.DataTree) -> Table | None:
    """How the sampler did in each parameter; None where that is not stored."""
    if schema.SAMPLE_STATS not in tree.children:
        return None
    attributes = tree[schema.SAMPLE_STATS].attrs
    stored = {key: _decoded(attributes.get(key)) for key in BY_PARAMETER}
    columns = {key: values for key, values in stored.items() if isinstance(values, dict)}
    names = list(dict.fromkeys(label for values in columns.values() for label in values))
    if not names:
        return None
    rows = [
        [
            label,
            *(_fixed(values.get(label), BY_PARAMETER[key][1]) for key, values in columns.items()),
        ]
        for label in names
    ]
    head = ["parameter", *(BY_PARAMETER[key][0] for key in columns)]
    return Table(head, rows, lead=LEADING_PARAMETERS)


def point_status(tree: xr.DataTree) -> Table | None:
    """How the estimate ended; None without one."""
    if schema.POINT not in tree.children or not tree[schema.POINT].attrs:
        return None
    attributes = dict(tree[schema.POINT].attrs)
    if attributes.get("status_message") == attributes.get("status"):
        attributes.pop("status_message", None)
    elsewhere = ("failures", "notes")
    plain = {key: value for key, value in attributes.items() if key not in elsewhere}
    rows = [[str(key).replace("_", " "), _plain(value)] for key, value in plain.items()]
    rows += _failures(attributes)
    return Table(["point estimate", ""], [row for row in rows if row[1]])


def _failures(attributes: Mapping[Any, Any]) -> list[list[str]]:
    """A row with the evaluations that came to nothing, by reason; none where they are not kept."""
    failures = _decoded(attributes.get("failures"))
    return [] if failures is None else [["failed evaluations", counted(failures) or "none"]]


def provenance(tree: xr.DataTree) -> Table:
    """The root attributes that are shown nowhere else."""
    shown = (schema.SUMMARY, schema.EQUATIONS, schema.EQUATIONS_LATEX, schema.CAMPAIGN_DESCRIPTION)
    rows = [
        [str(key).replace("_", " "), _plain(value)]
        for key, value in tree.attrs.items()
        if key not in shown
    ]
    return Table(["", ""], rows)


def _constants(constant: xr.Dataset) -> dict[str, list[str]]:
    """Role, group, frequency, periods and conditions, as columns."""
    columns = {"role": [str(role) for role in constant[schema.ROLE].values]}
    groups = (
        [str(g) for g in constant[schema.RUN_GROUP].values] if schema.RUN_GROUP in constant else []
    )
    if any(groups):
        columns["group"] = groups
    frequencies = constant[schema.FREQUENCY].values
    known = constant.get(schema.FREQUENCY_SD)
    sd = None if known is None else np.maximum(known.values, FINEST * frequencies)
    if np.isfinite(frequencies).any():  # transients have none
        columns["frequency [Hz]"] = [
            format_number(float(f), None if sd is None else float(sd[i]))
            for i, f in enumerate(frequencies)
        ]
    if schema.PERIODS in constant and (constant[schema.PERIODS].values > 0).any():
        periods = constant[schema.PERIODS].values
        columns["periods"] = [f"{int(n)}" if n > 0 else "–" for n in periods]
    for condition, data in constant.data_vars.items():
        if condition not in KNOWN_CONSTANTS and data.dims == (schema.RUN,):
            columns |= _condition(str(condition), data)
    return columns


def _condition(label: str, data: xr.DataArray) -> dict[str, list[str]]:
    """A condition by run: numbers in one unit, or words."""
    if data.dtype.kind not in "fiu":
        return {label.replace("_", " "): [str(value) for value in data.values]}
    scale = engineering(reading.unit(data), _median(data.values))
    unit = f" [{scale.unit}]" if scale.unit else ""
    shown = [format_number(scale.factor * float(value)) for value in data.values]
    return {f"{label.replace('_', ' ')}{unit}": shown}


def _median(values: Any) -> float:
    """Median magnitude, 0 where there is none."""
    finite = np.abs(values[np.isfinite(values)])
    return float(np.median(finite)) if finite.size else 0.0


def _scaled(value: float | None, scale: Scale, sd: float | None) -> str:
    return format_number(None if value is None else scale.factor * value, sd)


def _plain(value: Any) -> str:
    """An attribute as text; a JSON list or object without its brackets."""
    decoded = _decoded(value)
    if isinstance(decoded, dict):
        return ", ".join(f"{key} {_plain(item)}" for key, item in decoded.items()) or "none"
    if isinstance(decoded, list):
        return ", ".join(map(str, decoded)) or "none"
    if isinstance(value, float | np.floating):
        return format_value(float(value))
    return str(value)


def _fixed(value: Any, form: str) -> str:
    """A number in a fixed form, a dash where there is none."""
    known = isinstance(value, int | float) and np.isfinite(value)
    return form.format(value) if known else "–"


def _yes_or_no(value: Any) -> str:
    return "yes" if value else "no"


def _decoded(value: Any) -> Any:
    """What a JSON attribute holds, None if it is not JSON of a list or an object."""
    if not isinstance(value, str) or not value.startswith(("[", "{")):
        return None
    try:
        return json.loads(value)
    except ValueError:
        return None
