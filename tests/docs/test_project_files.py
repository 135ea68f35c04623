"""Files about the project agree with each other, and the README works away from the repository."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_links_of_the_readme_are_absolute_and_name_files_that_exist() -> None:
    links = re.findall(r"\]\(([^)]+)\)", text_of("README.md"))
    assert links
    repository = PROJECT["urls"]["Repository"]
    raw = repository.replace("github.com", "raw.githubusercontent.com") + "/main/"
    for link in links:
        assert link.startswith("https://")
        for start in (f"{repository}/blob/main/", raw):
            if link.startswith(start):
                assert (ROOT / link.removeprefix(start)).is_file()


def test_picture_of_the_readme_is_small() -> None:
    assert (ROOT / "docs" / "_static" / "overview.png").stat().st_size <= 150_000


def test_the_version_is_the_same_everywhere() -> None:
    version = PROJECT["version"]
    assert f"\nversion: {version}\n" in text_of("CITATION.cff")
    assert f'version: "{version}"' in text_of(".conda/recipe.yaml")


def test_the_recipe_has_the_dependencies_of_the_core() -> None:
    recipe = text_of(".conda/recipe.yaml")
    for dependency in PROJECT["dependencies"]:
        name, bound = re.fullmatch(r"([\w-]+)(?:\[\w+\])?(>=.*)", dependency).groups()
        base = "-base" if name == "matplotlib" else ""  # without its window
        assert re.search(rf"^    - {name}{base} {re.escape(bound)}$", recipe, re.MULTILINE)


def test_the_workflow_tests_every_python_that_is_declared() -> None:
    prefix = "Programming Language :: Python :: 3."
    minors = [c.removeprefix(prefix) for c in PROJECT["classifiers"] if c.startswith(prefix)]
    listed = ", ".join(f'"3.{minor}"' for minor in minors)
    assert f"python: [{listed}]" in text_of(".github/workflows/tests.yml")


def test_the_changelog_keeps_a_changelog() -> None:
    text = text_of("docs/changelog.md")
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert "\n## [Unreleased]\n" in text
    assert set(re.findall(r"^### (.+)$", text, re.MULTILINE)) <= kinds
    for version in re.findall(r"^## \[([^\]]+)\]", text, re.MULTILINE):
        assert f"\n[{version}]: https://" in text
