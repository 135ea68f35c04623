"""Without an optional package the core works, and the error says which extra brings it."""

import sys
import tomllib
from pathlib import Path

import pytest
import xarray as xr

from bayesoleo._parallel import connected
from bayesoleo._storage.result_files import read_tree, write_tree
from bayesoleo._workflow.settings import Settings
from bayesoleo.data import dataset_folder
from bayesoleo.data._campaign import VARIABLE
from bayesoleo.data._files import read_columns
from bayesoleo.errors import BayesoleoError, MissingExtraError

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
EXTRAS = {
    "dask": "distributed",
    "data": "pooch",
    "formats": "nptdms",
    "nuts": "nutpie",
    "parquet": "pyarrow",
    "zarr": "zarr",
}
PACKAGES = {"nptdms": "npTDMS"}


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """Block the import of all optional packages; return a file of every kind."""
    for module in EXTRAS.values():
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delenv(VARIABLE, raising=False)
    (tmp_path / "run.parquet").write_bytes(b"PAR1")
    (tmp_path / "run.tdms").write_bytes(b"TDSm")
    (tmp_path / "result.zarr").mkdir()
    return tmp_path


def connect(folder):
    with connected("local:2"):
        pass


@pytest.mark.parametrize(
    ("extra", "use"),
    [
        ("dask", connect),
        ("data", lambda folder: dataset_folder("silverbox")),
        ("formats", lambda folder: read_columns(folder / "run.tdms")),
        ("nuts", lambda folder: Settings(sampler="nuts")),
        ("parquet", lambda folder: read_columns(folder / "run.parquet")),
        ("zarr", lambda folder: read_tree(folder / "result.zarr")),
        ("zarr", lambda folder: write_tree(xr.DataTree(), folder / "new.zarr")),
    ],
)
def test_the_error_names_the_extra(bare, extra, use):
    pattern = rf"needs the package {EXTRAS[extra]}; pip install 'bayesoleo\[{extra}\]'"
    with pytest.raises(MissingExtraError, match=pattern) as caught:
        use(bare)
    assert isinstance(caught.value, BayesoleoError)
    assert isinstance(caught.value, ImportError)
    assert caught.value.extra == extra
    assert not (bare / "new.zarr").exists()


def test_results_are_stored_without_extras(bare):
    write_tree(xr.DataTree(), bare / "result.nc")
    assert read_tree(bare / "result.nc").children == {}


def test_extras_are_declared_and_no_dependency_of_the_core():
    declared = PROJECT["optional-dependencies"]
    for extra, module in EXTRAS.items():
        assert any(one.startswith(PACKAGES.get(module, module)) for one in declared[extra])
        assert not any(one.startswith(module) for one in PROJECT["dependencies"])
    assert declared["all"] == [f"bayesoleo[{','.join(EXTRAS)}]"]
