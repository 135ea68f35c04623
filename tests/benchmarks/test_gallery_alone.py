"""Pages of the gallery run in an empty folder."""

import pytest
from gallery_alone import PAGES, run_alone


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
def test_page_runs_alone(name):
    done = run_alone(PAGES[name])
    assert done.returncode == 0, done.stderr


def test_a_page_without_data_says_so_and_ends_well():
    done = run_alone(PAGES["silverbox"])
    assert done.returncode == 0, done.stderr
    assert "measured/silverbox is not on this machine" in done.stdout
