"""Measure the structure of the package: files, depth, import circles, types, names, size.

Run with ``python tests/benchmarks/house.py --json`` for one flat object, or without ``--json``
for a table. ``--installed`` also installs the core into a fresh environment and measures its
size and the time of the first import and command, and lists the largest packages on standard error;
this takes a minute or two.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
import tokenize
import venv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "bayesoleo"
#: Token types that are no code.
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def sources() -> list[Path]:
    """Return all Python files of the package."""
    return sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    """Return the dotted name of the module that a file holds."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def docstrings(tree: ast.Module) -> set[int]:
    """Return the lines on which docstrings stand."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        first = node.body[0] if node.body else None
        value = first.value if isinstance(first, ast.Expr) else None
        if first and isinstance(value, ast.Constant) and isinstance(value.value, str):
            lines.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return lines


def code_lines(path: Path) -> int:
    """Count lines that hold code: no blank line, comment or docstring."""
    skipped = docstrings(ast.parse(path.read_text()))
    held: set[int] = set()
    with tokenize.open(path) as stream:
        for token in tokenize.generate_tokens(stream.readline):
            if token.type not in _LAYOUT:
                held.update(range(token.start[0], token.end[0] + 1))
    return len(held - skipped)


def is_type_checking(node: ast.AST) -> bool:
    """Tell whether a node is ``if TYPE_CHECKING:``."""
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def imports(tree: ast.Module, *, everywhere: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield imports of a module; ``everywhere`` includes those inside functions."""
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif not is_type_checking(node) and (
            everywhere or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        ):
            waiting.extend(ast.iter_child_nodes(node))


def import_graph() -> dict[str, set[str]]:
    """Return which modules of the package each module imports, imports in functions included."""
    names = {module_name(path) for path in sources()}
    graph: dict[str, set[str]] = {name: set() for name in names}
    for path in sources():
        name = module_name(path)
        for node in imports(ast.parse(path.read_text()), everywhere=True):
            if isinstance(node, ast.Import):
                found = {alias.name for alias in node.names}
            else:
                found = {node.module or ""} | {f"{node.module}.{a.name}" for a in node.names}
            graph[name] |= {one for one in found if one in names and one != name}
    faces = {module_name(path) for path in sources() if path.name == "__init__.py"}
    return {name: targets - faces for name, targets in graph.items()}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return groups of modules that import each other (strongly connected components)."""
    order: list[str] = []
    seen: set[str] = set()

    def visit(start: str, edges: dict[str, set[str]], out: list[str]) -> None:
        stack = [(start, iter(sorted(edges.get(start, ()))))]
        seen.add(start)
        while stack:
            node, rest = stack[-1]
            following = next((one for one in rest if one not in seen), None)
            if following is None:
                stack.pop()
                out.append(node)
            else:
                seen.add(following)
                stack.append((following, iter(sorted(edges.get(following, ())))))

    for name in sorted(graph):
        if name not in seen:
            visit(name, graph, order)
    backward: dict[str, set[str]] = {name: set() for name in graph}
    for name, targets in graph.items():
        for target in targets:
            backward[target].add(name)
    seen.clear()
    found = []
    for name in reversed(order):
        if name not in seen:
            group: list[str] = []
            visit(name, backward, group)
            if len(group) > 1:
                found.append(sorted(group))
    return found


def kernel_lines(path: Path) -> set[int]:
    """Return the lines of functions that Numba compiles."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef) and any(
            re.search(r"jit|overload|intrinsic|cfunc", ast.unparse(one))
            for one in node.decorator_list
        ):
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def strict_errors() -> list[str]:
    """Return what ``mypy --strict`` finds outside Numba kernels."""
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", str(PACKAGE)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.stderr.strip():
        raise RuntimeError(done.stderr)
    kernels = {path: kernel_lines(path) for path in sources()}
    found = []
    for line in done.stdout.splitlines():
        match = re.match(r"(?P<file>[^:]+):(?P<line>\d+):(?:\d+:)? error", line)
        if match and int(match["line"]) not in kernels.get(ROOT / match["file"], set()):
            found.append(line)
    return found


def duplicate_classes() -> dict[str, int]:
    """Return class names that are defined more than once."""
    counted = Counter(
        node.name
        for path in sources()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    )
    return {name: times for name, times in sorted(counted.items()) if times > 1}


def function_lengths() -> list[int]:
    """Return the number of lines of each function's body, docstrings excluded."""
    lengths = []
    for path in sources():
        tree = ast.parse(path.read_text())
        skipped = docstrings(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                lines = range(node.body[0].lineno, (node.end_lineno or node.lineno) + 1)
                lengths.append(len(set(lines) - skipped))
    return lengths


def public_names() -> list[str]:
    """Return the names that ``bayesoleo.__all__`` holds."""
    code = "import bayesoleo, json; print(json.dumps(sorted(bayesoleo.__all__)))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [name for name in json.loads(done.stdout) if name != "__version__"]


def measure_tree() -> dict[str, float]:
    """Return the figures that the source alone gives."""
    files = sources()
    lengths = sorted(function_lengths())
    sizes = [len(path.read_text().splitlines()) for path in files]
    return {
        "files": len(files),
        "depth": max(len(path.relative_to(PACKAGE).parts) - 1 for path in files),
        "circles": len(circles(import_graph())),
        "strict_errors": len(strict_errors()),
        "duplicate_class_names": len(duplicate_classes()),
        "public_names": len(public_names()),
        "code_lines": sum(map(code_lines, files)),
        "file_lines_median": statistics.median(sizes),
        "file_lines_largest": max(sizes),
        "function_lines_median": statistics.median(lengths),
        "function_lines_p95": lengths[int(0.95 * len(lengths))],
        "function_lines_largest": lengths[-1],
    }


def timed(command: list[str], times: int = 5) -> float:
    """Return the shortest wall time of a command in seconds, after one run to warm up."""
    spent = []
    for _ in range(times + 1):
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        spent.append(time.perf_counter() - start)
    return min(spent[1:])


def measure_installed() -> dict[str, float]:
    """Install the core into a fresh environment; return its size and how fast it starts."""
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "environment"
        venv.create(home, with_pip=True)
        python = str(home / "bin" / "python")
        before = disk_usage(home)
        subprocess.run([python, "-m", "pip", "install", "-q", str(ROOT)], check=True)
        size = disk_usage(home) - before
        listed = subprocess.run(
            [python, "-m", "pip", "list", "--format=json"], check=True, capture_output=True
        )
        for name, megabytes in package_sizes(python)[:20]:
            print(f"{name:24} {megabytes:7.1f} MB", file=sys.stderr)
        bare = timed([python, "-c", "pass"])
        return {
            "installed_mb": round(size / 1e6, 1),
            "packages": len(json.loads(listed.stdout)) - 1,  # without pip
            "import_s": round(timed([python, "-c", "import bayesoleo"]) - bare, 3),
            "first_command_s": round(timed([str(home / "bin" / "bayesoleo"), "effects"]), 2),
        }


def package_sizes(python: str) -> list[tuple[str, float]]:
    """Return the installed packages of an environment with their sizes in MB, largest first."""
    code = """
import json
from importlib.metadata import distributions

sizes = {}
for found in distributions():
    paths = [one.locate() for one in found.files or () if one.suffix != ".pyc"]
    sizes[found.name] = sum(path.stat().st_size for path in paths if path.is_file()) / 1e6
print(json.dumps(sizes))
"""
    done = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True)
    return sorted(json.loads(done.stdout).items(), key=lambda item: -item[1])


def disk_usage(folder: Path) -> int:
    """Return the bytes of all files below a folder, bytecode excluded."""
    return sum(
        os.lstat(path).st_size
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object")
    parser.add_argument("--installed", action="store_true", help="install the core and measure it")
    parser.add_argument("--show", action="store_true", help="list what is counted")
    wanted = parser.parse_args()
    figures = measure_tree() | (measure_installed() if wanted.installed else {})
    if wanted.json:
        print(json.dumps(figures))
    else:
        for key, value in figures.items():
            print(f"{key:24} {value:g}")
    if wanted.show:
        print("circles:", circles(import_graph()), file=sys.stderr)
        print("classes:", duplicate_classes(), file=sys.stderr)
        print("\n".join(strict_errors()), file=sys.stderr)


if __name__ == "__main__":
    main()
