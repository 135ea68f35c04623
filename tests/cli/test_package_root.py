"""The root of the package: few names, all of them there, nothing imported early."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import bayesoleo

SOURCE = Path(bayesoleo.__file__)


@pytest.mark.parametrize("name", bayesoleo.__all__)
def test_every_name_is_there(name):
    assert getattr(bayesoleo, name) is not None
    assert name in dir(bayesoleo)


def test_type_checkers_see_the_same_names():
    block = next(n for n in ast.parse(SOURCE.read_text()).body if isinstance(n, ast.If))
    seen = {
        alias.name: node.module.removeprefix("bayesoleo.")
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == bayesoleo._HOME
    assert SOURCE.with_name("py.typed").exists()


def test_no_name_hides_a_subpackage():
    modules = {path.stem for path in SOURCE.parent.iterdir()}
    assert modules & set(bayesoleo.__all__) == set()
    assert set(bayesoleo._SUBPACKAGES) <= modules


def test_unknown_name_gets_a_hint():
    with pytest.raises(AttributeError, match=r"no attribute 'Modell'; did you mean 'Model'\?"):
        bayesoleo.Modell  # noqa: B018


def test_import_brings_nothing_with_it():
    heavy = "{'numpy', 'scipy', 'sympy', 'numba', 'xarray', 'pandas', 'matplotlib', 'typer'}"
    code = f"import sys, bayesoleo, bayesoleo.errors; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_help_does_not_wait_for_numbers():
    heavy = "{'numpy', 'scipy', 'sympy', 'numba', 'xarray', 'pandas', 'matplotlib'}"
    code = f"import sys, bayesoleo._cli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_the_command_is_where_the_project_says():
    project = tomllib.loads((SOURCE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    module, _, name = project["project"]["scripts"]["bayesoleo"].partition(":")
    assert callable(getattr(import_module(module), name))
