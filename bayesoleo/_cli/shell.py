"""Common parts of all commands: errors, warnings, progress, output folders and tables.

Labels of users are printed as they are, not as markup.
"""

from __future__ import annotations

import errno
import inspect
import io
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from bayesoleo import _schema as schema
from bayesoleo.errors import BayesoleoError, InputError, UnfinishedError, memory_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], words: int = 1) -> Table:
    """A plain table.

    Parameters
    ----------
    head : sequence of str
        Titles of the columns.
    rows : sequence of sequence
        Cells; numbers get four digits, ``None`` and NaN a dash.
    words : int
        How many columns from the left hold words and are aligned on the left, as are those in which
        no cell begins with a number.
    """
    made = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column, title in enumerate(head):
        # What does not fit goes on in the next line: an ellipsis would take digits away.
        on_left = column < words or not any(_is_number(row[column]) for row in rows)
        made.add_column(Text(title), justify="left" if on_left else "right", overflow="fold")
    for row in rows:
        made.add_row(*(Text(cell_text(cell)) for cell in row))
    return made


def _is_number(cell: Any) -> bool:
    text = cell_text(cell).lstrip("−-<± ")
    return text[:1].isdigit() or text == ""


def cell_text(value: Any) -> str:
    """A value as a table shows it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {cell_text(item)}" for key, item in value.items()) or "–"
    if isinstance(value, list | tuple | set):
        return ", ".join(cell_text(item) for item in value) or "–"
    return str(value)


def print_mapping(content: Mapping[str, Any], console: Console) -> None:
    """Print nested facts: plain values first, then one table for every list or mapping of records.

    Parameters
    ----------
    content : mapping
        Names to values, to mappings of name to record, or to lists of records, where a record is a
        mapping.
    console : rich.console.Console
        Where to print.
    """
    facts = {key: value for key, value in content.items() if _records(value) is None}
    if facts:
        width = max(len(key) for key in facts) + 2
        for key, value in facts.items():
            label = f"{key.replace('_', ' '):<{width}}"
            console.print(Text.assemble((label, "dim"), cell_text(value)), soft_wrap=True)
    for key, value in content.items():
        rows = _records(value)
        if rows is not None:
            head = list(dict.fromkeys(name for row in rows for name in row))
            cells = [[row.get(name) for name in head] for row in rows]
            console.print()
            titles = [name.replace("_", " ") for name in head]
            console.print(Text(key.replace("_", " "), style="bold"))
            words = _leading_words(cells)
            console.print(table(titles, cells, words))


def _records(value: Any) -> list[dict[str, Any]] | None:
    """Rows of a table, where a value is one."""
    if isinstance(value, Mapping) and value and all(isinstance(v, Mapping) for v in value.values()):
        return [{"name": name, **row} for name, row in value.items()]
    if isinstance(value, list | tuple) and value and all(isinstance(v, Mapping) for v in value):
        return [dict(row) for row in value]
    return None


def _leading_words(rows: Sequence[Sequence[Any]]) -> int:
    """How many columns from the left hold words."""
    count = 0
    for column in zip(*rows, strict=True):
        if any(isinstance(cell, int | float) for cell in column):
            break
        count += 1
    return count


def plain(value: Any) -> Any:
    """A value as JSON can hold it: no NumPy scalars, None where a number is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)


DEBUG = "BAYESOLEO_DEBUG"
RESULTS, OLDER = "results.nc", "older"

#: Exit statuses: input that cannot be used; a late stage failed, and what was known before it is
#: written; stopped by the user (128 + SIGINT).
UNUSABLE, UNFINISHED, STOPPED = 2, 3, 130


class Stopped(BayesoleoError):  # noqa: N818 - the user's wish is not an error
    """The user stopped a command; the message says what is kept."""


class Commands(TyperGroup):
    """Runs a command so that what goes wrong on purpose is told in one line on standard error."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command of a context.

        Parameters
        ----------
        ctx : typer.Context
            With the arguments as parsed.

        Raises
        ------
        typer.Exit
            With status 2 for input that cannot be used, 3 where a late stage failed, 130 where the
            user stopped the command.
        """
        try:
            check_address_space()
            with one_line_warnings():
                return super().invoke(ctx)
        except (Stopped, KeyboardInterrupt) as stop:
            complain(str(stop) or "stopped; nothing was written")
            raise typer.Exit(STOPPED) from None
        except UnfinishedError as error:
            if os.environ.get(DEBUG, "0") not in ("", "0"):
                raise
            complain(f"error: {error}")
            raise typer.Exit(UNFINISHED) from None
        except BayesoleoError as error:
            if os.environ.get(DEBUG, "0") not in ("", "0"):
                raise
            complain(f"error: {error}")
            raise typer.Exit(UNUSABLE) from None
        except (MemoryError, OSError, ImportError) as error:
            text = machine_text(error)
            if not text or os.environ.get(DEBUG, "0") not in ("", "0"):
                raise
            complain(f"error: {text}")
            raise typer.Exit(UNUSABLE) from None


#: What a disk refuses, whatever the program does.
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.ENAMETOOLONG)


#: What the loader of the C library says where a library finds no room in memory.
_NO_ROOM = ("failed to map segment", "cannot allocate memory", "cannot map zero-fill")


#: Bytes of address space that the numerical libraries take before any work, and that their compiler
#: and their linear algebra take with it. On two cores the first was 0.86 GB; with 1.05 GB in all
#: linear algebra ended the process, with 1.16 GB an estimate of fourteen runs ended well.
LIBRARIES, TOOLS = 900 * 2**20, 256 * 2**20


def check_address_space() -> None:
    """Raise where a limit leaves no room for the libraries: some of them end the process when they
    meet it, at their first work too, and say nothing that a user can act on.

    Raises
    ------
    MemoryError
        If the limit is too low.
    """
    try:
        import resource
    except ImportError:  # a system without such limits
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    set_to = f"a limit of {limit / 2**20:.0f} MB is set (ulimit -v)"
    if limit < LIBRARIES + TOOLS:
        needed = (LIBRARIES + TOOLS) / 2**20
        raise MemoryError(f"{set_to}, and the libraries alone need {needed:.0f} MB")
    taken = _address_space()
    if limit - taken < TOOLS:
        raise MemoryError(
            f"{set_to}, of which {taken / 2**20:.0f} MB are taken, and linear algebra alone needs"
            f" {TOOLS / 2**20:.0f} MB more"
        )


def _address_space() -> int:
    """Bytes of address space that this process has; zero where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return 0


def machine_text(error: MemoryError | OSError | ImportError) -> str:
    """What is told where memory or a disk has come to its limit; empty for other errors."""
    if isinstance(error, MemoryError):
        return memory_text(error)
    if isinstance(error, ImportError):
        full = any(words in str(error).lower() for words in _NO_ROOM)
        return memory_text(MemoryError("a library cannot be loaded")) if full else ""
    if error.errno == errno.ENOMEM:
        return memory_text(MemoryError())
    if error.errno not in _DISK:
        return ""
    where = f"file {error.filename}: " if error.filename else ""
    return f"{where}{error.strerror}; give another folder, or make room on this disk"


def add(app: typer.Typer, panel: str, *commands: Callable[..., None]) -> None:
    """Add commands to an app; the docstring of each is its help.

    Parameters
    ----------
    app : typer.Typer
        To add to.
    panel : str
        Under which heading they are listed.
    *commands : callable
        In the order of the list.
    """
    for command in commands:
        app.command(rich_help_panel=panel, help=flowing(command.__doc__ or ""))(command)


def flowing(text: str) -> str:
    r"""A docstring whose paragraphs fill the line, except those that start with ``\b``."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(p if p.startswith("\b") else " ".join(p.split()) for p in paragraphs)


def complain(text: str) -> None:
    """Print one line on standard error, whatever is in the text."""
    line = " ".join(text.split())
    encoding = sys.stderr.encoding or "utf-8"
    print(line.encode(encoding, "replace").decode(encoding), file=sys.stderr, flush=True)


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Show warnings as one line each, without the code that raised them."""

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        complain(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def stoppable(folder: Path | None, quiet: bool = True) -> Iterator[dict[str, Any]]:
    """Turn an interrupt into a line that says what is kept in a folder.

    Parameters
    ----------
    folder : Path or None
        Where the command writes, if it does.
    quiet : bool
        Whether to show no progress.

    Yields
    ------
    dict
        ``callback`` and ``progress``, as steps of the workflow take them.

    Raises
    ------
    Stopped
        In place of KeyboardInterrupt.
    """
    try:
        yield {"callback": teller(quiet), "progress": progress_shown(quiet)}
    except KeyboardInterrupt as stop:
        raise Stopped(f"stopped: {kept_in(folder)}") from stop


def kept_in(folder: Path | None) -> str:
    """A sentence on the files that a stopped command leaves in its folder."""
    if folder is None or not folder.is_dir():
        return "nothing was written"
    older, results = folder / OLDER, folder / RESULTS
    said = "no result was written"
    if (older / RESULTS).is_file():
        said = f"an older result is in {older}, what is known of the new one in {folder}"
    elif results.is_file() and _unfinished(results):
        said = f"what is known is in {results}"
    elif results.is_file():
        said = f"an older result in {folder} is as it was"
    kinds = {"draws made so far": "segment-*.npz", "finished rounds": "search.pickle"}
    kept = [kind for kind, name in kinds.items() if next(folder.rglob(name), None) is not None]
    if kept:
        said += f"; {' and '.join(kept)} are kept there, and the same command goes on from them"
    return said


def _unfinished(results: Path) -> bool:
    from bayesoleo._storage.result_files import read_attributes

    return schema.UNFINISHED in read_attributes(results)


def begin(command: str, given: Mapping[str, Any], *, search: bool) -> None:
    """Say at once that a command has begun, and load numerical libraries, which takes seconds.

    Parameters
    ----------
    command : str
        Its name.
    given : mapping of str to object
        Its arguments and options; ``quiet`` says nothing.
    search : bool
        Whether another process will help. It reads a campaign whose files are small, then loads
        the libraries too; not where something has to be compiled first.
    """
    campaign = given.get("campaign")
    if isinstance(campaign, Path) and not campaign.expanduser().exists():
        return  # an error is told in one line
    if isinstance(out := given.get("out"), Path):
        check_writable(out)
    if not given.get("quiet"):
        of = f" {campaign}" if campaign is not None else ""
        complain(f"{command}{of}: loading libraries")
    from bayesoleo._first_compilation import begin_early
    from bayesoleo._kept_processes import EARLY, load
    from bayesoleo._worker_processes import start_ahead
    from bayesoleo._workflow.read_early import begin_reading

    jobs = given.get("jobs")
    if not begin_early(jobs) and search:
        reads = isinstance(campaign, Path) and begin_reading(campaign, jobs)
        if not reads:
            start_ahead(jobs=jobs)
    load([EARLY, "bayesoleo._workflow.closing"])


def console() -> Console:
    """Standard output; wide where it is not a terminal, so that tables are not cut."""
    from rich.console import Console

    wide = None if sys.stdout.isatty() else 160
    return Console(width=wide, highlight=False, soft_wrap=False)


def say(text: object) -> None:
    """Print a text as it is."""
    console().print(str(text), markup=False, soft_wrap=True)


def progress_shown(quiet: bool) -> bool:
    """Whether progress bars make sense: somebody looks at them."""
    return not quiet and sys.stderr.isatty()


def teller(quiet: bool) -> Callable[[str], None]:
    """Prints what is being done on standard error, above progress bars.

    Parameters
    ----------
    quiet : bool
        Says nothing.
    """
    if quiet:
        return lambda _: None

    def callback(text: str) -> None:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)

    return callback


def campaign_name(campaign: Path) -> str:
    """Name of a campaign, as a folder can carry it.

    Parameters
    ----------
    campaign : Path
        Its folder, or its ``campaign.toml``.

    Raises
    ------
    CampaignError
        If the declaration cannot be used.
    """
    return re.sub(r"[^\w.-]+", "-", _declared_name(campaign)).strip("-.") or "campaign"


def _declared_name(campaign: Path) -> str:
    from bayesoleo.data._campaign_toml import FILE, read_declaration

    toml = campaign if campaign.suffix == ".toml" else campaign / FILE
    return read_declaration(toml).name


def output_folder(out: Path | None, campaign: Path, ending: str = "") -> Path:
    """The folder for results of a campaign, checked before any work is done; nothing is made yet.

    Parameters
    ----------
    out : Path or None
        As the user gave it; by default a folder in the current one, with the campaign's name.
    campaign : Path
        Its folder, or its ``campaign.toml``.
    ending : str, optional
        Of the default's name.

    Raises
    ------
    InputError
        If a folder cannot be made there, cannot be written to, or holds results of another
        campaign.
    """
    if out is None:
        out = Path(f"bayesoleo-{campaign_name(campaign)}{ending}")
    folder = check_writable(out.expanduser())
    _check_own(folder, campaign)
    return folder


def _check_own(folder: Path, campaign: Path) -> None:
    """Raise where the results of another campaign would be lost."""
    from bayesoleo._storage.result_files import read_attributes

    older = folder / RESULTS
    if not older.is_file():
        return
    name = read_attributes(older).get(schema.CAMPAIGN)
    if name is not None and name != _declared_name(campaign):
        raise InputError(
            "holds results of another campaign",
            file=older,
            key=schema.CAMPAIGN,
            value=name,
            hint="choose another folder with --out, or remove that file",
        )


def check_writable(folder: Path) -> Path:
    """See :func:`bayesoleo._storage.files.check_writable`."""
    from bayesoleo._storage.files import check_free, check_writable

    place = check_writable(folder)
    check_free(place)
    return place


def write_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Write a figure in the format that the name ends in, as a whole or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : Path
    **options
        As ``figure.savefig`` takes them.
    """
    from bayesoleo._storage.files import write_bytes_atomic

    drawn = io.BytesIO()
    try:
        figure.savefig(drawn, format=path.suffix[1:].lower() or "png", **options)
    except ValueError as error:  # it lists the formats that there are
        raise InputError(
            "is no format of a figure", file=path, hint="give a name that ends in .png or .pdf"
        ) from error
    write_bytes_atomic(path, drawn.getvalue())


def write_groups(groups: Mapping[str, Any], path: Path, seed: int | None, **about: str) -> None:
    """Write Datasets by name as one tree with its provenance.

    Parameters
    ----------
    groups : mapping of str to Dataset
    path : Path
        The file.
    seed : int or None
    **about : str
        Further attributes of the tree.
    """
    import xarray as xr

    from bayesoleo._storage.files import only_writer, sweep
    from bayesoleo._storage.result_files import provenance, write_tree

    tree = xr.DataTree.from_dict(dict(groups))
    tree.attrs.update(provenance(seed, **about))
    with only_writer(path.parent):
        sweep(path.parent, [path.name])
        write_tree(tree, path)


def print_json(value: Any) -> None:
    """Print a value as JSON, for programs."""
    import json

    typer.echo(json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False))
