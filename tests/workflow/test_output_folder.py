"""What a result leaves alone in the folder that it is written to."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from bayesoleo._workflow.output import FILES, OLDER, RESULTS, ResultFolder
from bayesoleo.errors import InputError


def written(folder, value=0.0):
    """A result written to a folder, not finished yet."""
    output = ResultFolder.checked(folder)
    output.write(xr.DataTree(xr.Dataset({"a": ("x", np.full(2, value))})))
    return output


def test_files_of_a_user_in_a_folder_of_that_name_stay(tmp_path):
    (tmp_path / OLDER).mkdir()
    (tmp_path / OLDER / "notes.txt").write_text("mine")
    written(tmp_path).finish()
    assert (tmp_path / OLDER / "notes.txt").read_text() == "mine"
    again = written(tmp_path)
    assert (tmp_path / OLDER / RESULTS).is_file(), "put aside until the new one is complete"
    again.finish()
    assert [item.name for item in (tmp_path / OLDER).iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", FILES)
def test_a_result_that_a_user_put_there_is_not_written_over(tmp_path, name):
    (tmp_path / OLDER).mkdir()
    (tmp_path / OLDER / name).write_text("mine")
    with pytest.raises(InputError, match=r"older: holds a result that was not put aside here"):
        ResultFolder.checked(tmp_path)
    assert (tmp_path / OLDER / name).read_text() == "mine"


def test_what_was_put_aside_goes_with_the_result_that_replaces_it(tmp_path):
    written(tmp_path, 1.0).finish()
    first = (tmp_path / RESULTS).read_bytes()
    written(tmp_path, 2.0)
    assert (tmp_path / OLDER / RESULTS).read_bytes() == first
    # A later process finishes what the one before it began.
    ResultFolder.checked(tmp_path).finish()
    assert not (tmp_path / OLDER).exists()
    assert (tmp_path / RESULTS).read_bytes() != first
