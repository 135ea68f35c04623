"""Files of test rigs, each made by a real writer, hold after loading what was written."""

import warnings

import pytest
from reading_files import CASES, campaign, check

from bayesoleo.errors import DataWarning


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_file_is_read_without_conversion(case, tmp_path):
    for module in case.needs:
        pytest.importorskip(module)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries that write
        folder = campaign(case, tmp_path / "rig")
    if case.note:
        with pytest.warns(DataWarning, match=case.note):
            check(case, folder)
    else:
        check(case, folder)
