"""Pages of the gallery: stored figures are there, small, and shown where the data are not."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from bayesoleo import gallery as stored_module

STUDIES = Path(__file__).resolve().parents[2] / "studies"
PAGES = sorted(STUDIES.glob("*/plot_*.py"))


@pytest.fixture
def stored(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The helper of the pages, without data, as a page of the repository sees it."""
    monkeypatch.setattr(sys, "argv", [str(PAGES[0])])
    monkeypatch.delenv("BAYESOLEO_DATA", raising=False)
    monkeypatch.delenv("BAYESOLEO_STORE_FIGURES", raising=False)
    return stored_module


def wanted(page: Path) -> set[str]:
    """Files that a page shows when its data are away."""
    text = page.read_text(encoding="utf-8")
    studies = dict(re.findall(r'^(\w+) = Study\("(\w+)"', text, re.MULTILINE))
    shown = re.findall(r'(\w+)\.(text|figure)\(\s*"(\w+)"', text)
    ends = {"text": "txt", "figure": "png"}
    return {f"{studies[s]}-{name}.{ends[kind]}" for s, kind, name in shown if s in studies}


def test_what_pages_show_without_data_is_stored_and_nothing_else() -> None:
    names = set().union(*(wanted(page) for page in PAGES))
    assert names == {path.name for path in (STUDIES / "figures").iterdir()}


@pytest.mark.parametrize("path", sorted((STUDIES / "figures").iterdir()), ids=lambda p: p.name)
def test_stored_file_is_small(path: Path) -> None:
    assert path.stat().st_size <= 100_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_is_short_and_has_a_title(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").splitlines()
    assert re.fullmatch("=+", lines[2])
    assert len(lines) <= 160


def test_study_without_data_says_so_and_shows_its_last_run(
    stored: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    study = stored.Study("silverbox", data="measured/silverbox")
    assert "not on this machine" in capsys.readouterr().out
    assert study.run(lambda: 1 / 0) is None
    study.text("rounds", lambda: 1 / 0)
    assert "cubic stiffness" in capsys.readouterr().out
    width, height = study.figure("spectrum", lambda: 1 / 0).get_size_inches()
    assert (width, height) == (10.0, 4.2)


def test_study_stores_what_it_shows(
    stored: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "set").mkdir()
    monkeypatch.setenv("BAYESOLEO_DATA", str(tmp_path))
    monkeypatch.setenv("BAYESOLEO_STORE_FIGURES", "1")
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "studies" / "section" / "plot_page.py")])
    (tmp_path / "studies" / "figures").mkdir(parents=True)
    figures = tmp_path / "studies" / "figures"
    study = stored.Study("page", data="set", slow=True)
    assert study.run(lambda: 7) == 7
    study.text("table", lambda: print("one  \ntwo"))
    assert (figures / "page-table.txt").read_text(encoding="utf-8") == "one\ntwo\n"
    study.figure("picture", lambda: stored.Figure(figsize=(3, 2)))
    shown = stored._framed(figures / "page-picture.png")
    assert tuple(shown.get_size_inches()) == (3.0, 2.0)


def test_slow_study_is_shown_from_the_store(
    stored: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "set").mkdir()
    monkeypatch.setenv("BAYESOLEO_DATA", str(tmp_path))
    assert not stored.Study("page", data="set", slow=True).live
    assert "takes minutes" in capsys.readouterr().out


def test_page_alone_has_nothing_to_show_and_says_so(
    stored: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "plot_page.py")])
    study = stored.Study("page", slow=True)
    assert "in the folder studies of the repository" in capsys.readouterr().out
    study.text("table", lambda: 1 / 0)
    assert study.figure("picture", lambda: 1 / 0) is None
    assert study.helper("no_such_module") is None


def test_study_says_which_module_of_the_repository_it_needs(
    stored: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not stored.Study("page", needs=("no_such_module",)).live
    assert "needs studies/no_such_module.py" in capsys.readouterr().out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_imports_nothing_of_the_repository(page: Path) -> None:
    helpers = {path.stem for path in STUDIES.glob("*.py")}
    tree = ast.parse(page.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not helpers & {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.module not in helpers


@pytest.mark.parametrize("name", ["silverbox", "mr_damper", "mbari_gas_spring"])
def test_page_shows_the_model_of_its_campaign(name: str) -> None:
    text = (STUDIES / "measured" / name / "model.py").read_text(encoding="utf-8")
    model = text[text.index("model = Model(") :]
    page = "mbari" if name == "mbari_gas_spring" else name
    assert model in next(STUDIES.glob(f"*/plot_{page}.py")).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["silverbox", "mr_damper", "mbari_gas_spring"])
def test_page_declares_its_campaign(name: str) -> None:
    page = next(STUDIES.glob(f"*/plot_{name.removesuffix('_gas_spring')}.py"))
    nodes = ast.parse(page.read_text(encoding="utf-8")).body
    names: dict[str, object] = {}
    for node in nodes[: 1 + next(k for k, n in enumerate(nodes) if _assigns(n, "DECLARATION"))]:
        if isinstance(node, ast.Assign):
            exec(compile(ast.Module([node], []), str(page), "exec"), names)
    declared = tomllib.loads(str(names["DECLARATION"]))
    stored = tomllib.loads((STUDIES / "measured" / name / "campaign.toml").read_text("utf-8"))
    assert declared == {key: item for key, item in stored.items() if key != "description"}


def _assigns(node: ast.stmt, name: str) -> bool:
    return isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == name


PRIVATE = re.compile(r"bayesoleo(\.\w+)*\._|from bayesoleo[\w.]* import (.*\b)?_")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_uses_public_names_only(page: Path) -> None:
    assert not PRIVATE.search(page.read_text(encoding="utf-8").replace("__version__", ""))


def test_many_parameters_of_an_effect_are_counted_only(
    stored: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One for each of eight runs, for instance: they need not be values of a spline."""
    names = [f"offset[{k}]" for k in range(8)]
    monkeypatch.setattr(stored, "added_parameters", lambda _: iter([("an offset by run", names)]))
    stored.print_before_after({"error_after": {}, "error_before": {}}, "N", 1.0)
    assert capsys.readouterr().out.endswith("an offset by run\n  8 parameters\n")


def test_an_effect_that_was_added_again_is_told_once_and_by_its_place(stored: ModuleType) -> None:
    def entry(effect: str, target: str, *names: str) -> dict[str, object]:
        item = {"effect": effect, "target": target, "expected": dict.fromkeys(names, 1.0)}
        return {"accepted": effect, "accepted_target": target, "candidates": [item]}

    summary = {
        "effects": ["leak", "overflow"],
        "targets": ["upper", "lower"],
        "titles": {},
        "parameters": {"a": {}, "b": {}, "c": {}},
        "rounds": [
            entry("overflow", "upper", "gone"),
            entry("leak", "upper", "a"),
            entry("overflow", "lower", "b"),
            entry("leak", "upper", "a", "c"),
        ],
    }
    assert [names for _, names in stored.added_parameters(summary)] == [["a", "c"], ["b"]]
