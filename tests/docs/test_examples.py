"""What README and documentation show must work: every Python block runs, every campaign loads."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bayesoleo._workflow.simulating import demo_campaign
from bayesoleo.data._campaign_toml import read_declaration
from bayesoleo.model import Model

ROOT = Path(__file__).resolve().parents[2]
#: The campaign that ``bayesoleo demo`` leaves.
DEMO = "bayesoleo-demo/campaign"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a page, without those under a ``<!-- not run: … -->``."""
    pattern = rf"(<!-- not run[^\n]*-->\n)?```{language}\n(.*?)```"
    found = re.findall(pattern, page.read_text(encoding="utf-8"), re.DOTALL)
    return [body for skipped, body in found if not skipped]


def pages_with(language: str) -> list[Path]:
    return [page for page in PAGES if blocks(page, language)]


@pytest.mark.slow
@pytest.mark.parametrize("page", pages_with("python"), ids=lambda page: page.stem)
def test_python_of_a_page_runs_from_top_to_bottom(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # pages save figures
    if any(DEMO in body for body in blocks(page, "python")):
        demo_campaign(DEMO)
    namespace: dict[str, object] = {}
    for number, body in enumerate(blocks(page, "python"), 1):
        exec(compile(body, f"{page.name}, Python block {number}", "exec"), namespace)


@pytest.mark.parametrize("page", pages_with("toml"), ids=lambda page: page.stem)
def test_campaign_of_a_page_follows_the_format(page: Path, tmp_path: Path) -> None:
    first, *others = blocks(page, "toml")
    # A table that is shown by itself goes below a whole campaign.
    for body in (first, *(b if b.startswith("format") else first + b for b in others)):
        path = tmp_path / "campaign.toml"
        path.write_text(body, encoding="utf-8")
        roles = {run.role for run in read_declaration(path).runs}
        assert roles == {"fit", "hold-out"}


@pytest.mark.parametrize("name", ["README.md", "docs/quickstart.md"])
def test_model_reads_the_channels_of_the_campaign_beside_it(name: str, tmp_path: Path) -> None:
    namespace: dict[str, object] = {}
    exec(blocks(ROOT / name, "python")[0], namespace)
    model = namespace["model"]
    assert isinstance(model, Model)
    path = tmp_path / "campaign.toml"
    path.write_text(blocks(ROOT / name, "toml")[0], encoding="utf-8")
    assert {*model.inputs, *model.outputs} == set(read_declaration(path).channels)
    assert model.order("position") == 2


def test_readme_has_one_command_under_each_mark() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = dict(re.findall(r"^<!-- ci: (\w+) -->\n```sh\n([^\n]+)\n```$", text, re.MULTILINE))
    assert list(commands) == ["demo", "test"]
    assert commands["demo"].endswith("bayesoleo demo")
    assert "pytest" in commands["test"]


def test_pages_link_to_files_that_exist() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
