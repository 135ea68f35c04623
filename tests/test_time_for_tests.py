"""Tests that are begun too late are skipped, and said to be."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ONE = HERE / "docs" / "test_project_files.py::test_picture_of_the_readme_is_small"


@pytest.mark.parametrize(("seconds", "said"), [(-1, "skipped"), (600, "passed")])
def test_after_a_time_no_test_is_begun(seconds, said):
    again = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rs", ONE],
        cwd=HERE.parent, capture_output=True, text=True, check=True,
        env={**os.environ, "BAYESOLEO_TESTS_UNTIL": str(time.time() + seconds)},
    )  # fmt: skip
    last = again.stdout.strip().splitlines()[-1]
    assert said in last
    assert last.count("passed") + last.count("skipped") == 1
    assert ("BAYESOLEO_TESTS_UNTIL" in again.stdout) == (said == "skipped")
