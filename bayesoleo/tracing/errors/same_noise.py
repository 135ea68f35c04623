"""The same noise in all rounds: the least that any model of the search has borne out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bayesoleo.data.local_average import LocalAverage
from bayesoleo.tracing.errors.errors_table import ErrorTable, RunError
from bayesoleo.tracing.fitting.roles import RecordNoise

Noise = Mapping[tuple[str, str], RecordNoise]


def least_noise(one: Noise, other: Noise) -> dict[tuple[str, str], RecordNoise]:
    """By run and output the smaller of two measurements.

    A residual is nowhere smaller than the noise in it, whichever model leaves it: the least that
    was found is nearest. Where a run could not be solved nothing was measured.
    """
    found = {key: noise for key, noise in one.items() if _is_known(noise)}
    for key, noise in other.items():
        if not _is_known(noise):
            continue
        known = found.get(key, noise)
        found[key] = RecordNoise(
            min(known.sigma, noise.sigma), min(known.input_noise, noise.input_noise)
        )
    return found


def _is_known(noise: RecordNoise) -> bool:
    return bool(np.isfinite(noise.sigma) and np.isfinite(noise.input_noise))


def with_same_noise(table: ErrorTable, noise: Noise) -> ErrorTable:
    """Errors held against a noise that was found with another model."""
    return ErrorTable(
        tuple(
            _with_noise(entry, noise[entry.run, entry.output])
            if (entry.run, entry.output) in noise
            else entry
            for entry in table.entries
        )
    )


def _with_noise(entry: RunError, noise: RecordNoise) -> RunError:
    average, factor = entry.average, 1.0
    if isinstance(average, LocalAverage) and 0 < noise.sigma < average.sigma:
        factor = noise.sigma / average.sigma
        average = replace(average, sigma=noise.sigma, noise=factor * average.noise)
    if factor == 1.0 and not noise.input_noise < entry.input_noise:
        return entry
    from_input = min(entry.input_noise, noise.input_noise)
    scale = entry.input_scale * from_input / entry.input_noise if from_input else 0.0
    quiet = replace(entry, average=average, input_noise=from_input, input_scale=scale)
    if entry.expected_error is None:
        return quiet
    # What the parameters' posterior adds stays.
    square = entry.expected_error**2 - entry.noise**2 + quiet.noise**2
    square = max(square, entry.expected_error**2 * 1e-6)
    own = max(entry.own_share * entry.expected_error**2 - entry.noise**2 + quiet.noise**2, 0.0)
    return replace(
        quiet,
        expected_error=float(np.sqrt(square)),
        parameters=entry.parameters * entry.expected_error**2 / square,
        own_share=max(own / square, 1e-6),
    )
