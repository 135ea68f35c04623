"""What is written reads back."""

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bayesoleo._storage import files
from bayesoleo.data import SimulatedRun, load_campaign, write_campaign
from bayesoleo.errors import CampaignError

TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
NAMES = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=8)
CHANNELS = {
    "displacement": ("x", "mm"),
    "gas_pressure": ("p", "psig"),
    "gas_temperature": ("T", "degC"),
}


def simulated(label, rng, conditions=None, **more):
    time = np.arange(40) / 10 + more.pop("start", 0.0)
    scale = {"displacement": 0.1, "gas_pressure": 1e6, "gas_temperature": 300.0}
    samples = {name: size * rng.random(40) for name, size in scale.items()}
    more.setdefault("frequency", 0.6)
    return SimulatedRun(label, time, samples, conditions=conditions or {}, **more)


@settings(max_examples=30, deadline=None)
@given(
    text=TEXT,
    labels=st.lists(NAMES, min_size=1, max_size=3, unique=True),
    condition=NAMES.filter(lambda name: not name.endswith(("pressure", "force", "temperature"))),
    value=st.floats(-1e9, 1e9),
    start=st.integers(0, 1000),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip(text, labels, condition, value, start, seed):
    rng = np.random.default_rng(seed)
    conditions = {condition: (value, "mm", 0.5)}
    runs = [simulated(label, rng, conditions, group=text, start=start / 10) for label in labels]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "made"
        write_campaign(target, name=text, description=text, channels=CHANNELS, runs=runs)
        campaign = load_campaign(target)
    assert (campaign.name, campaign.description, campaign.controlled) == (text, text, None)
    for written, read in zip(runs, campaign.runs, strict=True):
        assert (written.label, written.group, written.role) == (read.label, read.group, read.role)
        assert read.frequency == written.frequency
        assert read.conditions[condition] == pytest.approx(value * 1e-3, rel=1e-14)
        assert read.condition_sd[condition] == pytest.approx(5e-4)
        np.testing.assert_allclose(read.time, written.time, atol=1e-9)
        for name, values in written.samples.items():
            np.testing.assert_allclose(read.samples[name], values, rtol=1e-13, atol=1e-13)


def test_transient_and_controlled(tmp_path):
    run = simulated("drop", np.random.default_rng(1), kind="transient", frequency=None)
    write_campaign(tmp_path, name="d", channels=CHANNELS, runs=[run], controlled="displacement")
    campaign = load_campaign(tmp_path)
    assert campaign.controlled == "displacement"
    assert campaign.runs[0].frequency is None
    assert (tmp_path / "drop.csv").is_file()


@pytest.mark.parametrize("label", ["r" * 300, "CON", "com1", "../a", "a\nb", ".", "測定", ""])
def test_a_label_that_is_no_name_of_a_file_on_every_system_is_numbered(tmp_path, label):
    runs = [simulated(label, np.random.default_rng(1))]
    write_campaign(tmp_path / "new", name="one", channels=CHANNELS, runs=runs)
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"campaign.toml", "run-001.csv"}
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_full_disk_leaves_no_half_of_a_campaign(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full)
    runs = [simulated("a", np.random.default_rng(1))]
    with pytest.raises(CampaignError, match="new: cannot be written: No space left on device"):
        write_campaign(tmp_path / "new", name="one", channels=CHANNELS, runs=runs)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("moved", [0, 1, 3])
def test_what_a_killed_process_was_moving_is_written_anew(tmp_path, monkeypatch, moved):
    runs = [simulated(label, np.random.default_rng(1)) for label in "abc"]
    place, done = os.replace, []

    def killed(source, target):
        if not Path(target).name.startswith("."):
            if len(done) == moved:
                raise KeyboardInterrupt
            done.append(target)
        place(source, target)

    monkeypatch.setattr("os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_campaign(tmp_path, name="one", channels=CHANNELS, runs=runs)
    monkeypatch.undo()
    (tmp_path / f"{files._TRIAL}1").mkdir()  # of a process that tried the folder
    assert not (tmp_path / "campaign.toml").exists()
    write_campaign(tmp_path, name="two", channels=CHANNELS, runs=runs)
    assert load_campaign(tmp_path).name == "two"
    assert not list(tmp_path.glob(".campaign*"))


def test_a_campaign_that_is_whole_is_not_written_over(tmp_path):
    runs = [simulated("a", np.random.default_rng(1))]
    write_campaign(tmp_path, name="one", channels=CHANNELS, runs=runs)
    # A process was killed before it removed its list.
    (tmp_path / ".campaign-files").write_text("a.csv\ncampaign.toml")
    with pytest.raises(CampaignError, match="folder is not empty"):
        write_campaign(tmp_path, name="two", channels=CHANNELS, runs=runs)
    assert load_campaign(tmp_path).name == "one"


def test_a_process_that_is_killed_while_it_overwrites_leaves_no_mixture(tmp_path, monkeypatch):
    write_campaign(
        tmp_path, name="one", channels=CHANNELS,
        runs=[simulated(label, np.random.default_rng(1)) for label in "ab"],
    )  # fmt: skip
    place = os.replace

    def killed(source, target):
        if Path(target).name == "d.csv":
            raise KeyboardInterrupt
        place(source, target)

    monkeypatch.setattr("os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_campaign(
            tmp_path, name="two", channels=CHANNELS, overwrite=True,
            runs=[simulated(label, np.random.default_rng(2)) for label in "acd"],
        )  # fmt: skip
    monkeypatch.undo()
    with pytest.raises(CampaignError, match="no such file"):
        load_campaign(tmp_path)


def test_files_of_two_processes_that_were_killed_are_swept(tmp_path):
    for name in ("a.csv", "b.csv", "x.csv"):
        (tmp_path / name).write_text("half")
    (tmp_path / ".campaign-files").write_text("a.csv\nx.csv\nb.csv\ncampaign.toml")
    runs = [simulated("a", np.random.default_rng(1))]
    write_campaign(tmp_path, name="one", channels=CHANNELS, runs=runs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "campaign.toml"]


def test_files_of_others_are_spared_beside_those_of_a_killed_process(tmp_path):
    (tmp_path / ".campaign-files").write_text("a.csv\ncampaign.toml")
    (tmp_path / "b.csv").write_text("mine")
    with pytest.raises(CampaignError, match="folder is not empty"):
        write_campaign(tmp_path, name="one", channels=CHANNELS, runs=[])


@pytest.mark.parametrize("place", ["name", "description", "label"])
def test_a_null_character_is_refused(tmp_path, place):
    texts = {"name": "one", "description": "", "label": "a"} | {place: "a\0b"}
    runs = [simulated(texts.pop("label"), np.random.default_rng(1))]
    with pytest.raises(CampaignError, match="null character"):
        write_campaign(tmp_path / "new", channels=CHANNELS, runs=runs, **texts)
    assert not (tmp_path / "new").exists()


def test_files_are_not_overwritten(tmp_path):
    runs = [simulated("a", np.random.default_rng(1))]
    write_campaign(tmp_path, name="one", channels=CHANNELS, runs=runs)
    with pytest.raises(CampaignError, match=r"folder is not empty; .*overwrite=True"):
        write_campaign(tmp_path, name="two", channels=CHANNELS, runs=runs)
    write_campaign(tmp_path, name="two", channels=CHANNELS, runs=runs, overwrite=True)
    assert load_campaign(tmp_path).name == "two"


@pytest.mark.parametrize(
    ("channels", "labels", "message"),
    [
        ({"displacement": ("x,y", "mm")}, ["a"], "column x,y: .*without commas"),
        ({"displacement": ("time_s", "mm")}, ["a"], "column time_s: .*of its own"),
        ({"displacement": ("x", "furlog")}, ["a"], "unknown unit"),
        ({"displacement": ("x", "mm")}, ["a", "a"], "run a: two runs have this label"),
        ({"force": ("f", "N")}, ["a"], "run a, column f: channel 'force' has no sample"),
    ],
)
def test_what_would_not_read_back_is_refused(tmp_path, channels, labels, message):
    runs = [simulated(label, np.random.default_rng(1)) for label in labels]
    with pytest.raises(CampaignError, match=message):
        write_campaign(tmp_path, name="n", channels=channels, runs=runs)
