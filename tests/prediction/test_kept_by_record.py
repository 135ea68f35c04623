"""What follows from a run is kept for its next model, as long as the run is there."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest

from bayesoleo.prediction._kept_by_record import KeptByRecord
from bayesoleo.prediction._records import Record

MADE = []


def some(size: int = 10):
    MADE.append(size)
    return np.arange(float(size))


@pytest.fixture
def record():
    MADE.clear()
    time = np.arange(4) / 2.0
    return Record("a", "", "fit", "periodic", 1.0, 0.0, 2, time, {}, {}, {})


def test_it_is_made_once_for_each_run_and_key(record):
    kept, other = KeptByRecord(1e6), replace(record, frequency=2.0)
    first = kept.of(record, "key", some)
    assert kept.of(record, "key", some) is first
    assert kept.of(other, "key", some) is not first
    assert kept.of(record, "another", some) is not first
    assert len(MADE) == 3
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 1.0


def test_it_goes_with_its_run(record):
    kept, other = KeptByRecord(1e6), replace(record, frequency=2.0)
    for one in (record, other):
        kept.of(one, "key", some)
    assert len(kept.kept) == len(kept.runs) == 2
    del one, other
    gc.collect()
    assert len(kept.kept) == len(kept.runs) == 1
    assert kept._bytes == 80


def test_what_was_asked_for_last_is_kept_up_to_a_size(record):
    kept = KeptByRecord(200.0)
    kept.of(record, "a", some)
    kept.of(record, "b", some)
    kept.of(record, "a", some)
    kept.of(record, "c", some)  # 240 bytes: the one that was not asked for again goes
    assert [key for _, key in kept.kept] == ["a", "c"]
    kept.of(record, "large", lambda: some(1000))  # the last one is kept whatever its size
    assert [key for _, key in kept.kept] == ["large"]
