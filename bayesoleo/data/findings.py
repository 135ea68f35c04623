"""What deserves a look in reduced records, as sentences: drift, and a frequency too low."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesoleo.data.drift import Drift, drifting
from bayesoleo.prediction.records import Record

#: Part of the power that harmonics off the multiples may hold: noise passes for one at times.
STRAY_POWER = 1e-5


def motions_per_period(record: Record) -> int:
    """How often the motion repeats within a declared period: two where the frequency is half.

    Parameters
    ----------
    record : Record

    Returns
    -------
    int
        The greatest common divisor of the harmonics that stand above the noise of any channel; one
        for a transient.
    """
    orders: set[int] = set()
    power: dict[int, float] = {}
    for harmonics in record.harmonics.values():
        share = np.abs(harmonics.coefficients) ** 2
        share = share / max(float(share[harmonics.orders > 0].sum()), np.finfo(float).tiny)
        for order, part in zip(harmonics.orders, share, strict=True):
            if order > 0:
                orders.add(int(order))
                power[int(order)] = max(power.get(int(order), 0.0), float(part))
    strong = [order for order in orders if power[order] > STRAY_POWER]
    return int(np.gcd.reduce(strong)) if strong else 1


def findings(records: Sequence[Record]) -> list[str]:
    """Sentences about records that are usable but deserve a look.

    Parameters
    ----------
    records : sequence of Record
        Reduced runs.

    Returns
    -------
    list of str
        Each names the run, what was found and what to write.
    """
    found = []
    for record in records:
        times = motions_per_period(record)
        if times > 1:
            found.append(
                f"run {record.label}: the motion repeats {times} times in a declared period; "
                f"write frequency = {times * record.frequency:.4g}"
            )
        found += [_sentence(record, item) for item in drifting(record)]
    return found


def _sentence(record: Record, item: Drift) -> str:
    by_mean = abs(item.mean) / item.mean_sd >= abs(item.amplitude) / item.amplitude_sd
    if by_mean:
        size, sd = item.mean, item.mean_sd
        what = f"mean moves by {size:.3g} ± {sd:.1g} (SI)"
    else:
        size, sd = 100 * item.amplitude, 100 * item.amplitude_sd
        what = f"amplitude changes by {size:.3g} ± {sd:.1g} %"
    return (
        f"run {record.label}: {item.channel} drifts, its {what} over the record, "
        f"{item.change:.2g} times the noise of a sample; cut the run with start or stop, "
        "or count the drift as noise"
    )
