"""The table of mutants fits the package and the tests; that these notice is a benchmark."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

TESTS = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def mutants() -> Iterator[ModuleType]:
    """The benchmark, with its folder importable as when it is run by hand."""
    path = list(sys.path)
    sys.path.insert(0, str(Path(__file__).parent))
    import mutants

    yield mutants
    sys.path[:] = path


def test_every_mutant_changes_one_place(mutants):
    """Its text stands there once, and the file can still be compiled; names tell them apart."""
    for mutant in mutants.MUTANTS:
        source = (TESTS.parent / "bayesoleo" / mutant.file).read_text("utf-8")
        assert mutants.mutated(mutant, source) != source
    names = [mutant.name for mutant in mutants.MUTANTS]
    assert len(set(names)) == len(names)


def test_a_mutant_without_its_place_is_an_error(mutants):
    for text in ("nothing", "twice twice"):
        mutant = mutants.Mutant("name", "file.py", "twice", "once", ())
        with pytest.raises(ValueError, match=r"name: the text stands [02] times in file\.py"):
            mutants.mutated(mutant, text)


def test_the_tests_of_every_mutant_exist(mutants):
    for name in {name for mutant in mutants.MUTANTS for name in mutant.tests}:
        file, _, test = name.partition("::")
        text = (TESTS / file).read_text("utf-8")
        assert re.search(rf"^def {test or 'test_'}", text, re.MULTILINE), name


def test_a_sample_is_of_all_packages(mutants):
    packages = {mutant.file.partition("/")[0] for mutant in mutants.chosen(few=True)}
    assert packages >= {"solvers", "estimation", "posterior", "error_models", "discovery"}
