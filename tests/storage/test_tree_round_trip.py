"""A result comes back as it was written, or an error says in one line why it does not."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from bayesoleo import _schema as schema
from bayesoleo._storage.files import write_text_atomic
from bayesoleo._storage.result_files import provenance, read_tree, write_tree
from bayesoleo.errors import ResultsError

TEXT = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=12)
ENDINGS = ["nc", "zarr"]


def small_tree(**attributes: object) -> xr.DataTree:
    samples = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 5.0]])
    observed = xr.Dataset(
        {
            "force": ((schema.RUN, schema.SAMPLE), samples, {"units": "N", "long_name": "force"}),
            "time": ((schema.RUN, schema.SAMPLE), samples, {"units": "s"}),
            "age": (schema.RUN, [1.0, 2.0], {"units": "seconds"}),
            "settled": (schema.RUN, [True, False]),
            "role": (schema.RUN, np.array([schema.FIT, schema.HOLD_OUT], dtype=object)),
            "offset[a b]": (schema.RUN, [1, 2]),
        },
        coords={schema.RUN: ["a b", "lauf 2 · ü"]},
    )
    posterior = xr.Dataset({"k": (("chain", "draw"), np.arange(20_000.0).reshape(4, -1))})
    tree = xr.DataTree.from_dict(
        {"/": xr.Dataset(), "observed_data": observed, "posterior": posterior}
    )
    tree.attrs.update(provenance(3, **attributes))
    return tree


@pytest.mark.parametrize("ending", ENDINGS)
def test_everything_comes_back(tmp_path, ending):
    tree = small_tree(campaign="shaker", summary={"text": "x" * 200_000})
    write_tree(tree, tmp_path / f"results.{ending}")
    back = read_tree(tmp_path / f"results.{ending}")
    for group in ("observed_data", "posterior"):
        xr.testing.assert_identical(
            back[group].to_dataset(), tree[group].to_dataset().map(lambda a: a, keep_attrs=True)
        )
    assert back.attrs == tree.attrs
    assert back["observed_data/settled"].dtype == bool
    assert back["observed_data/role"].dtype.kind == "U"


@pytest.mark.parametrize("ending", ENDINGS)
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    values=hnp.arrays(
        st.sampled_from([np.float64, np.int64, np.bool_]), hnp.array_shapes(max_dims=3, max_side=5)
    ),
    labels=st.lists(TEXT, min_size=1, max_size=4),
    unit=TEXT,
)
def test_any_array_text_and_unit(tmp_path, ending, values, labels, unit):
    dims = [f"d{axis}" for axis in range(values.ndim)]
    data = xr.Dataset({"x": (dims, values, {"units": unit}), "label": ("run", labels)})
    tree = xr.DataTree.from_dict({"group": data})
    write_tree(tree, tmp_path / f"any.{ending}")
    back = read_tree(tmp_path / f"any.{ending}")["group"].to_dataset()
    np.testing.assert_array_equal(back["x"].values, values)
    assert back["x"].dtype == values.dtype
    assert back["x"].attrs == {"units": unit}
    assert back["label"].values.tolist() == labels


def test_formats_convert_into_each_other_and_files_are_closed(tmp_path):
    tree = small_tree()
    write_tree(tree, tmp_path / "a.nc")
    for source, target in (("a.nc", "b.zarr"), ("b.zarr", "a.nc"), ("a.nc", "a.nc")):
        write_tree(read_tree(tmp_path / source), tmp_path / target)
    for group in ("observed_data", "posterior"):
        back = read_tree(tmp_path / "a.nc")[group].to_dataset()
        xr.testing.assert_identical(back, tree[group].to_dataset())


def test_large_arrays_are_compressed(tmp_path):
    zeros = xr.Dataset({"x": ("sample", np.zeros(100_000))})
    write_tree(xr.DataTree.from_dict({"g": zeros}), tmp_path / "a.nc")
    assert (tmp_path / "a.nc").stat().st_size < 50_000


def test_writing_changes_neither_the_tree_nor_what_was_there_on_failure(tmp_path):
    path = tmp_path / "results.nc"
    write_tree(small_tree(), path)
    before = path.read_bytes()
    broken = xr.DataTree.from_dict(
        {"g": xr.Dataset({"x": ("n", np.array([object(), 1], dtype=object))})}
    )
    with pytest.raises(ValueError, match=r"."):
        write_tree(broken, path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.nc"]
    assert schema.FORMAT_ATTRIBUTE not in broken.attrs


def test_missing_file(tmp_path):
    with pytest.raises(ResultsError, match=r"none.nc: there is no such file; give the results.nc"):
        read_tree(tmp_path / "none.nc")


@pytest.mark.parametrize("keep", [100, 3000, -200])
def test_truncated_file(tmp_path, keep):
    write_tree(small_tree(), tmp_path / "a.nc")
    content = (tmp_path / "a.nc").read_bytes()
    (tmp_path / "a.nc").write_bytes(content[:keep])
    with pytest.raises(
        ResultsError, match=r"a.nc: cannot be read; it is damaged, cut short"
    ) as caught:
        read_tree(tmp_path / "a.nc")
    assert "\n" not in str(caught.value)


def test_empty_file_and_other_kinds(tmp_path):
    (tmp_path / "a.nc").write_bytes(b"")
    with pytest.raises(ResultsError, match=r"a.nc: is empty"):
        read_tree(tmp_path / "a.nc")
    (tmp_path / "b.nc").write_text("time,force\n0,1\n")
    with pytest.raises(ResultsError, match=r"b.nc: cannot be read"):
        read_tree(tmp_path / "b.nc")
    (tmp_path / "c.zarr").mkdir()
    with pytest.raises(ResultsError, match=r"c.zarr: (cannot be read|is not a result)"):
        read_tree(tmp_path / "c.zarr")
    xr.Dataset({"x": ("n", [1.0])}).to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    with pytest.raises(ResultsError, match=r"d.nc: is not a result of bayesoleo"):
        read_tree(tmp_path / "d.nc")
    with pytest.raises(ResultsError, match=r"is a folder; give .*results.nc"):
        read_tree(tmp_path)


def test_later_format(tmp_path):
    tree = small_tree()
    tree.attrs[schema.FORMAT_ATTRIBUTE] = schema.FORMAT + 1
    write_tree(tree, tmp_path / "a.nc")
    with pytest.raises(ResultsError, match=r"later version \(got 2\); update bayesoleo"):
        read_tree(tmp_path / "a.nc")


def test_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ResultsError, match=r"results.nc: cannot be written: "):
        write_tree(small_tree(), tmp_path / "file" / "results.nc")
    with pytest.raises(ResultsError, match=r"cannot be written: "):
        write_text_atomic(tmp_path / "file" / "a.json", "{}")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ResultsError, match=r"folder: cannot be written: "):
        write_text_atomic(tmp_path / "folder", "{}")


def test_text_is_replaced_as_a_whole(tmp_path):
    path = tmp_path / "new" / "summary.json"
    write_text_atomic(path, "old\r\n")
    write_text_atomic(path, "neu ü\n")
    assert path.read_bytes() == "neu ü\n".encode()
    assert [entry.name for entry in path.parent.iterdir()] == ["summary.json"]


def test_provenance_is_plain():
    attributes = provenance(None, campaign="a", drive=None, effects=["x"], samples=3)
    assert "seed" not in attributes
    assert "drive" not in attributes
    assert attributes["effects"] == '["x"]'
    assert attributes["samples"] == 3
    assert attributes["created"].endswith("+00:00")
    assert attributes["numpy_version"] == np.__version__
