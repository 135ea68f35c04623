"""Registered sets: local first, verified, and never a silent download."""

import pooch
import pytest

from bayesoleo.data import dataset_folder
from bayesoleo.data._campaign import REGISTERED, VARIABLE
from bayesoleo.errors import CampaignError


def test_local_folders_of_all_kinds(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    for place in ("measured/mine", "campaigns/shaker-x", "nist"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "file").write_text("1")
        assert dataset_folder(place.split("/")[-1], ["file"]) == tmp_path / place


def test_changed_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    (tmp_path / "measured/silverbox").mkdir(parents=True)
    (tmp_path / "measured/silverbox/Schroeder80mV.mat").write_text("something else")
    with pytest.raises(CampaignError, match=r"Schroeder80mV\.mat: file is not the registered one"):
        dataset_folder("silverbox", ["Schroeder80mV.mat"])


def test_unknown_set_says_what_to_set(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(CampaignError, match=rf"key dataset: .*'shaker-plain'.; set {VARIABLE} to"):
        dataset_folder("shaker-plain")


def test_no_way_out_of_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "inside"))
    with pytest.raises(CampaignError, match="not here and cannot be fetched"):
        dataset_folder("../..")


def test_measured_set_is_fetched_by_hash(tmp_path, monkeypatch):
    asked = {}

    class Fetcher:
        def fetch(self, file):
            asked["file"] = file

    def create(path, base_url, registry):
        asked.update(url=base_url, registry=registry)
        return Fetcher()

    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(pooch, "create", create)
    assert dataset_folder("mr_damper", ["ensaio1.1.mat"]).name == "mr_damper"
    assert asked["file"] == "ensaio1.1.mat"
    assert asked["registry"] == REGISTERED["mr_damper"].hashes
    with pytest.raises(
        CampaignError, match=r"file other\.mat: mr_damper has no such registered file"
    ):
        dataset_folder("mr_damper", ["other.mat"])


def test_failed_download_is_told(monkeypatch):
    def create(**_):
        raise OSError("no route to host")

    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(pooch, "create", create)
    with pytest.raises(
        CampaignError, match=rf"cannot fetch silverbox: no route.*measured/silverbox .*{VARIABLE}"
    ):
        dataset_folder("silverbox")


@pytest.mark.reference
@pytest.mark.parametrize("name", list(REGISTERED))
def test_files_at_hand_are_the_registered_ones(data_folder, name):
    assert dataset_folder(name) == data_folder / "measured" / name
