"""Canonical names of stored quantities, results that print as tables, and the summary's check.

One DataTree goes from the closed loop to the disk, the plots and the report. Every writer and
reader takes the names of its groups, dims, variables and root attributes from here, so that a
misspelt one is an ``AttributeError`` at once.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bayesoleo.errors import ResultsError

if TYPE_CHECKING:
    import xarray as xr

FORMAT: Final = 1
"""Version of the layout; a reader refuses a later one."""

# Groups
RECORDS: Final = "records"
OBSERVED_DATA: Final = "observed_data"
CONSTANT_DATA: Final = "constant_data"
NOISE: Final = "noise"
POINT: Final = "point"
PRIOR: Final = "prior"
POSTERIOR: Final = "posterior"
SAMPLE_STATS: Final = "sample_stats"
LOG_LIKELIHOOD: Final = "log_likelihood"
POSTERIOR_PREDICTIVE: Final = "posterior_predictive"
PERIOD_PREDICTIVE: Final = "period_predictive"
RESIDUAL: Final = "residual"
PREDICTION: Final = "prediction"
DISCOVERY: Final = "discovery"
NONPARAMETRIC: Final = "nonparametric"
SAMPLING_DISTRIBUTION: Final = "sampling_distribution"
INDIFFERENCE: Final = "indifference"
PROFILE: Final = "profile"
SENSITIVITY: Final = "sensitivity"
ASSESSMENT: Final = "assessment"
LOG_PRIOR: Final = "log_prior"
ERROR_MODEL: Final = "error_model"
ERROR_MODEL_REASON: Final = "error_model_reason"
"""Attribute of the posterior: why its error model was chosen; absent where the user chose it."""
COMPARISON: Final = "comparison"
PROPOSAL: Final = "proposal"
FREQUENCY_RESPONSE: Final = "frequency_response"
"""Group, and key of the summary; of multisine runs only."""

GROUPS: Final = (
    RECORDS,
    OBSERVED_DATA,
    CONSTANT_DATA,
    NOISE,
    POINT,
    PRIOR,
    POSTERIOR,
    SAMPLE_STATS,
    LOG_LIKELIHOOD,
    POSTERIOR_PREDICTIVE,
    PERIOD_PREDICTIVE,
    RESIDUAL,
    PREDICTION,
    DISCOVERY,
    NONPARAMETRIC,
    SAMPLING_DISTRIBUTION,
    INDIFFERENCE,
    PROFILE,
    SENSITIVITY,
    ASSESSMENT,
    LOG_PRIOR,
    ERROR_MODEL,
    COMPARISON,
    PROPOSAL,
    FREQUENCY_RESPONSE,
)

# Dims; each that is not just a counter has a coordinate of the same name
CHAIN: Final = "chain"
DRAW: Final = "draw"
RUN: Final = "run"
BLOCK: Final = "block"
PERIOD: Final = "period"
SAMPLE: Final = "sample"
PHASE: Final = "phase"
OUTPUT: Final = "output"
PARAMETER: Final = "parameter"
PARAMETER_COLUMN: Final = "parameter_column"
ITERATION: Final = "iteration"
MULTIPLIER: Final = "multiplier"
PART: Final = "part"
ROUND: Final = "round"
EFFECT: Final = "effect"
QUANTITY: Final = "quantity"
MEAN: Final = "mean"
AMPLITUDE: Final = "amplitude"

# Variables and coordinates
TIME: Final = "time"
FREQUENCY: Final = "frequency"
FREQUENCY_SD: Final = "frequency_sd"
PERIODS: Final = "periods"
ROLE: Final = "role"
RUN_GROUP: Final = "group"
START: Final = "start"
MBE: Final = "mbe"
ESTIMATE: Final = "estimate"
SD: Final = "sd"
UNIT: Final = "unit"
COVARIANCE: Final = "covariance"
VARIANCE: Final = "variance"
HISTORY: Final = "history"
OBJECTIVE: Final = "objective"
FLOQUET: Final = "floquet"
STABLE: Final = "stable"
BRANCH_JUMPS: Final = "branch_jumps"
ENSEMBLE: Final = "ensemble"
LP: Final = "lp"
RUNS: Final = "runs"
STROKE: Final = "stroke"
VELOCITY: Final = "velocity"
GAIN: Final = "gain"
P_VALUE: Final = "p_value"
Z: Final = "z"
CANDIDATE_FAMILY: Final = "candidate_family"
EXPECTED: Final = "expected"
INDISTINGUISHABLE: Final = "indistinguishable"
RMS: Final = "rms"
REPEATING: Final = "repeating"
RATIO_TO_NOISE: Final = "ratio_to_noise"
EXPECTED_ERROR: Final = "expected_error"
RATIO_TO_EXPECTED: Final = "ratio_to_expected"
CHANCE: Final = "chance"
ACCEPTED: Final = "accepted"
ACCEPTED_TARGET: Final = "accepted_target"
REASON: Final = "reason"

# Values of ``role``
FIT: Final = "fit"
HOLD_OUT: Final = "hold-out"

# Values of ``verdict``
NOTHING_MISSING: Final = "nothing missing"
EFFECT_ADDED: Final = "effect added"
UNEXPLAINED: Final = "unexplained remainder"
VERDICTS: Final = (NOTHING_MISSING, EFFECT_ADDED, UNEXPLAINED)

# Values of ``certainty``
CERTAIN: Final = "certain"
PROBABLE: Final = "probable"
LIKENESS: Final = "likeness"
NO_CAUSE: Final = "no cause"
CERTAINTIES: Final = (CERTAIN, PROBABLE, LIKENESS, NO_CAUSE)

# Root attributes
FORMAT_ATTRIBUTE: Final = "bayesoleo_format"
VERSION_ATTRIBUTE: Final = "bayesoleo_version"
CREATED: Final = "created"
SEED: Final = "seed"
COMMAND: Final = "command"
CAMPAIGN: Final = "campaign"
CAMPAIGN_DESCRIPTION: Final = "campaign_description"
CAMPAIGN_SHA256: Final = "campaign_sha256"
MODEL: Final = "model"
DRIVE: Final = "drive"
MODEL_DOCUMENT: Final = "model_document"
EQUATIONS: Final = "equations"
EQUATIONS_LATEX: Final = "equations_latex"
EFFECTS: Final = "effects"
VERDICT: Final = "verdict"
SUMMARY: Final = "summary"
UNFINISHED: Final = "unfinished"
BETWEEN_RUNS: Final = "between_runs"

# Attributes of every variable
UNITS: Final = "units"
LONG_NAME: Final = "long_name"


def before(output: str) -> str:
    """Name of what belongs to the model as declared: ``force_before``."""
    return f"{output}_before"


def after(output: str) -> str:
    """Name of what belongs to the model as extended: ``force_after``."""
    return f"{output}_after"


def mean(name: str) -> str:
    """Name of an average over periods: ``force_before_mean``."""
    return f"{name}_mean"


def noise(output: str) -> str:
    """Name of the standard error of a residual averaged over periods: ``force_noise``."""
    return f"{output}_noise"


def expected(output: str) -> str:
    """Name of what a draw predicts without errors: ``force_expected``."""
    return f"{output}_expected"


def at_estimate(output: str) -> str:
    """Name of what the estimate predicts without errors: ``force_at_estimate``."""
    return f"{output}_at_estimate"


def average_sd(output: str) -> str:
    """Name of the standard deviation of errors averaged over periods: ``force_average_sd``."""
    return f"{output}_average_sd"


def log_variance(output: str) -> str:
    """Name of the sampled logarithm of an output's variance."""
    return f"log_variance_{output}"


def spread(name: str) -> str:
    """Name of a scatter between runs: ``spread_gas_exponent``."""
    return f"spread_{name}"


def population_mean(name: str) -> str:
    """Name of what a parameter that varies by run varies about: ``mean_gas_exponent``."""
    return f"mean_{name}"


def correlation(first: str, second: str) -> str:
    """Name of the correlation of two outputs' errors."""
    return f"correlation_{first}_{second}"


def correlated_share(output: str) -> str:
    """Name of the share of an output's error variance that is correlated in time."""
    return f"correlated_share_{output}"


def correlation_time(output: str) -> str:
    """Name of the time over which an output's error is correlated."""
    return f"correlation_time_{output}"


def discrepancy_share(output: str) -> str:
    """Name of the share of an output's error variance that repeats itself every period."""
    return f"discrepancy_share_{output}"


def discrepancy_length(output: str) -> str:
    """Name of the length in cycles over which an output's discrepancy is alike."""
    return f"discrepancy_length_{output}"


def discrepancy_common(output: str) -> str:
    """Name of the part of an output's discrepancy that all runs share."""
    return f"discrepancy_common_{output}"


#: Size of the effects that a model might lack, and of the remainder that no effect describes.
CATALOGUE_SIZE: Final = "catalogue_size"
REMAINDER_SIZE: Final = "remainder_size"

_ERROR_QUANTITIES: Final = (
    CATALOGUE_SIZE,
    REMAINDER_SIZE,
    log_variance(""),
    spread(log_variance("")),
    "correlation_",
    correlated_share(""),
    discrepancy_share(""),
    discrepancy_length(""),
    discrepancy_common(""),
)


def of_errors(name: str) -> bool:
    """Whether a quantity of the posterior belongs to the error model, not to the model."""
    return name.startswith(_ERROR_QUANTITIES)


_RUN_WORDS: Final = (RUN, FREQUENCY, FREQUENCY_SD, PERIODS, ROLE, RUN_GROUP)
_RESERVED: Final = {
    "parameter": frozenset({CHAIN, DRAW, ENSEMBLE}),
    "input": frozenset({RUN, BLOCK, PERIOD, SAMPLE, PHASE, CHAIN, DRAW}),
    "output": frozenset({RUN, BLOCK, PERIOD, SAMPLE, PHASE, CHAIN, DRAW}),
    "condition": frozenset(_RUN_WORDS),
}


def reserved(kind: str, name: str) -> bool:
    """Whether a result calls something else by this name.

    Parameters
    ----------
    kind : {"parameter", "input", "output", "condition"}
        What is to be called so.
    name : str
    """
    if kind == "parameter" and of_errors(name):
        return True
    return name in _RESERVED.get(kind, ())


def by_run(parameter: str, run: str) -> str:
    """Name of a parameter that varies by run: ``offset[run 3]``."""
    return f"{parameter}[{run}]"


def variable_name(name: str) -> str:
    """A name as a variable can carry it: ``/`` separates groups, so it becomes ``∕`` (U+2215).

    Parameters
    ----------
    name : str
        For example the name of a parameter by run, whose label a user chose.
    """
    return name.replace("/", "∕")


def validate_summary(summary: dict[str, Any]) -> None:
    """Check a summary against the JSON Schema that ships with the package.

    Parameters
    ----------
    summary : dict
        What becomes ``summary.json``: plain dicts, lists, strings, numbers and None; SI units.

    Raises
    ------
    ResultsError
        Names the path of the first thing wrong, such as ``rounds[0].error.force.a.rms``.
    """
    for path, value in _numbers(summary, ()):
        if not math.isfinite(value):
            raise ResultsError(
                "a summary holds finite numbers only",
                key=_spell(path),
                value=value,
                hint="write null (None) where there is no value",
            )
    try:
        text = json.dumps(summary, ensure_ascii=False)
    except TypeError:  # what has no place in a file breaks the schema too, which says where
        _check_schema(summary)
    else:
        _check_text(text)


@lru_cache(maxsize=1)
def _check_text(text: str) -> None:
    """Check what stands in a file; one summary is checked where it is made, written and shown."""
    _check_schema(json.loads(text))


def _check_schema(summary: dict[str, Any]) -> None:
    import jsonschema

    validator = jsonschema.Draft202012Validator(summary_schema())
    error = jsonschema.exceptions.best_match(validator.iter_errors(summary))
    if error is not None:
        raise ResultsError(
            f"the summary does not follow its schema: {error.message}",
            key=_spell(error.absolute_path),
        )


def summary_json(summary: dict[str, Any]) -> str:
    """Text of ``summary.json``, checked by :func:`validate_summary` first."""
    validate_summary(summary)
    return json.dumps(summary, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


@cache
def summary_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of the summary; shared, so leave it unchanged."""
    path = Path(__file__).with_name("summary.schema.json")
    schema: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return schema


def _numbers(
    value: Any, path: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], float]]:
    """Every float in a nested summary with the way to it."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _numbers(item, (*path, str(key)))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _numbers(item, (*path, index))
    elif isinstance(value, float):
        yield path, value


def _spell(path: Any) -> str:
    """A path as a person writes it: ``rounds[0].reason``; the top is ``summary``."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    return text.lstrip(".") or "summary"


@dataclass(frozen=True, eq=False, repr=False)
class LabelledResult:
    """Labelled arrays with the words that a person reads first.

    Parameters
    ----------
    data : xarray.Dataset
        Everything; a group of a result.
    text : str
        The table.
    """

    data: xr.Dataset
    text: str

    def __getitem__(self, name: str) -> xr.DataArray:
        """A variable of the data."""
        return self.data[name]

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return self.text

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.text)}</pre>{self.data._repr_html_()}"


def columns(head: list[str], rows: list[list[str]]) -> str:
    """A plain table: the first column on the left, the others on the right."""
    table = [head, *rows]
    width = [max(len(row[k]) for row in table) for k in range(len(head))]
    lines = []
    for row in table:
        cells = [
            row[0].ljust(width[0]),
            *(c.rjust(w) for c, w in zip(row[1:], width[1:], strict=True)),
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def variable(dims: tuple[str, ...], values: Any, name: str, unit: str) -> xr.Variable:
    """A variable with a title for people and its unit."""
    import xarray as xr

    return xr.Variable(dims, values, {LONG_NAME: name, UNITS: unit})
