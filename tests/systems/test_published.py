"""Published tables: complete, consistent with what else is known of them."""

from __future__ import annotations

import numpy as np

from bayesoleo.systems._oleo import SHAKER_RUNS, TABLE_6_2, TABLE_6_5, TABLE_6_7


def test_every_run_has_its_rows():
    labels = [run.label for run in SHAKER_RUNS]
    assert labels == list("abcdefghijklmn")
    assert set(TABLE_6_5) == set(labels)
    assert set(labels) - set(TABLE_6_2) == {"j", "n"}
    for run in SHAKER_RUNS:
        # off both stops; the stroke is 264 mm
        assert run.position - run.amplitude >= 0
        assert run.position + run.amplitude < 0.264


def test_table_6_7_is_rebuilt_from_table_6_5():
    """To the digits that are given."""
    table = np.array(list(TABLE_6_5.values()))
    for column, (name, (mean, sd)) in enumerate(TABLE_6_7.items()):
        values = table[np.isfinite(table[:, column]), column]
        digits = {"theta_4": 6, "theta_6": 3, "theta_16": 2}[name]
        assert round(values.mean(), digits) == mean
        assert round(values.std(ddof=1), digits) == sd
