"""Records made from arrays, without a campaign folder."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError
from bayesoleo.prediction.band_limited import band_limited_channels, sample_noise
from bayesoleo.prediction.records import TRANSIENT, Record

#: A smoother needs that many samples.
FEWEST_SAMPLES = 8


def transient_record(
    label: str,
    time: Array,
    samples: Mapping[str, Array],
    *,
    conditions: Mapping[str, float] | None = None,
) -> Record:
    """A record of a motion that does not repeat, from arrays.

    Parameters
    ----------
    label : str
        Of the run.
    time : ndarray, shape (N,)
        Equidistant sample times, s.
    samples : mapping of str to ndarray, shape (N,)
        Of each channel, SI.
    conditions : mapping of str to float, optional
        Known constants of the run, SI.

    Returns
    -------
    Record
        With the curve through each channel, and its noise.

    Raises
    ------
    CampaignError
        If times are not equidistant, or samples are missing or not finite.
    """
    time = np.asarray(time, dtype=float)
    gaps = np.diff(time)
    # Times written with seven digits are as equidistant as files have them.
    if not (time.size >= FEWEST_SAMPLES and np.ptp(gaps) <= 1e-6 * time[-1] and gaps.min() > 0):
        raise CampaignError(
            "a transient needs equidistant times",
            run=label,
            value=time[:4].tolist(),
            hint=f"give at least {FEWEST_SAMPLES}",
        )
    columns = {name: np.asarray(values, dtype=float) for name, values in samples.items()}
    for name, values in columns.items():
        if values.shape != time.shape or not np.isfinite(values).all():
            raise CampaignError(
                "a channel needs one finite number for each time", run=label, column=name
            )
    step = float((time[-1] - time[0]) / (time.size - 1))
    smoothed = band_limited_channels(columns, step)
    return Record(
        label=label,
        group="",
        role="fit",
        kind=TRANSIENT,
        frequency=np.nan,
        frequency_sd=np.nan,
        periods=0,
        time=time,
        samples=columns,
        harmonics={},
        signal_noise={name: sample_noise(values, step) for name, values in columns.items()},
        conditions=dict(conditions or {}),
        smoothed=smoothed,
    )
