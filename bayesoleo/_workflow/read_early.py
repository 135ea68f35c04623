"""A campaign that another process reads and reduces while this one loads its libraries.

Both take seconds, and the libraries that read a campaign are a small part of those of a search.
Beyond three jobs nothing is read early: all of them read at once then.
"""

from __future__ import annotations

import tomllib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from bayesoleo._kept_processes import load
from bayesoleo._process_messages import Message, as_it_is, dumps, loads
from bayesoleo._worker_processes import OF_A_SEARCH, Beside

if TYPE_CHECKING:
    from bayesoleo.data._reduction import ReducedCampaign

#: Bytes of files that one process reads in about the time that libraries take. Beyond it all cores
#: read, and show how far they are.
LARGEST = 10_000_000

#: What only figures of draws need. The other process loads it before a search shares its first
#: work: it would have nothing to do for most of that time.
OF_FIGURES = ("corner",)
#: What only draws need. This process loads it while it waits for the campaign.
OF_DRAWS = ("bayesoleo.posterior._ensemble_moves",)

_begun: dict[Path, Beside[Path, Message]] = {}


def begin_reading(campaign: Path, jobs: int | None = None) -> bool:
    """Begin, and have the process load what a search needs after that.

    Parameters
    ----------
    campaign : Path
        Its folder or its ``campaign.toml``.
    jobs : int, optional
        Processes, this one included.

    Returns
    -------
    bool
        Whether it reads: not where files are large or have to be fetched first, or no process may.
    """
    _begun.clear()  # of a command that failed before it asked
    if not _is_small(campaign):
        return False
    beside = Beside.begun(_read, campaign, jobs, then=(_loaded, None, [OF_A_SEARCH, OF_FIGURES]))
    if beside is None:
        return False
    _begun[campaign] = beside
    return True


def read_early(campaign: object) -> ReducedCampaign | None:
    """The campaign, if :func:`begin_reading` began it; only the first call gets it.

    None if it has to be read here. If reading failed there, it is read again here, and the error is
    raised here.

    Warns
    -----
    DataWarning
        What reading it warned of.
    """
    beside = _begun.pop(campaign, None) if isinstance(campaign, Path) else None
    if beside is None:
        return None
    if not beside.answered:
        load(OF_DRAWS)  # in the meantime
    reduced: ReducedCampaign
    said: list[tuple[str, type[Warning]]]
    try:
        # What comes out of a message may not be written to: code would be compiled for that.
        reduced, said = loads(as_it_is(beside.result()))
    except Exception:
        return None
    for text, category in said:
        warnings.warn(text, category, stacklevel=3)
    return reduced


def _is_small(campaign: Path) -> bool:
    """By the declaration alone: the modules that check it take seconds to load, and say what is
    wrong with it."""
    toml = campaign if campaign.suffix == ".toml" else campaign / "campaign.toml"
    try:
        with toml.open("rb") as file:
            declared = tomllib.load(file)
        if "dataset" in declared:
            return False
        files = {str(run["file"]) for run in declared["runs"]}
        return sum((toml.parent / file).stat().st_size for file in files) <= LARGEST
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _read(campaign: Path) -> Message:
    """The reduced campaign and its warnings as a message.

    The thread that waits for them must not make objects of them: that loads modules, and while the
    command loads others the two threads could wait for each other.
    """
    from bayesoleo.data._campaign import load_campaign
    from bayesoleo.data._reduction import reduce_campaign

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        reduced = reduce_campaign(load_campaign(campaign), jobs=1)
    return dumps((reduced, [(str(one.message), one.category) for one in said]))


def _loaded(_: None, modules: tuple[str, ...]) -> None:
    load(modules)
