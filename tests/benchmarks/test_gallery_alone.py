"""Pages of the gallery run in an empty folder."""

import pytest
from gallery_alone import PAGES, run_alone

#: A quick page of each section whose pages are quick, those first that do something else alone than
#: in the documentation, where data and ``studies`` are at hand. The documentation runs every page,
#: and no page may import from ``studies`` (``tests/docs/test_studies.py``); ``gallery_alone.py``
#: runs all of them alone.
SAMPLE = ("reduction", "friction", "end_stop")


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLE)
def test_page_runs_alone(name):
    done = run_alone(PAGES[name])
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_page_without_data_says_so_and_ends_well():
    """The sample's page of the third section."""
    done = run_alone(PAGES["silverbox"])
    assert done.returncode == 0, done.stderr
    assert "measured/silverbox is not on this machine" in done.stdout


def test_the_sample_has_a_page_of_each_section_but_that_of_statistics():
    sections = {PAGES[name].parent.name for name in (*SAMPLE, "silverbox")}
    assert sections == {page.parent.name for page in PAGES.values()} - {"5_statistics"}
