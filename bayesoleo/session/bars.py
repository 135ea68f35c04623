"""Progress of a step, shown only if it takes a while."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm.auto import tqdm

#: Seconds before anything is shown.
DELAY = 2.0


@contextmanager
def status_line(progress: bool) -> Iterator[Callable[[str], None]]:
    """A line that shows what is being done and for how long.

    Parameters
    ----------
    progress : bool
        Whether to show it.

    Yields
    ------
    callable
        Takes the text of the line.
    """
    form = "{desc} [{elapsed}]"
    options = {"delay": DELAY, "miniters": 1, "mininterval": 0.0}
    with tqdm(bar_format=form, leave=False, disable=not progress, **options) as bar:

        def say(text: str) -> None:
            bar.set_description_str(text, refresh=False)
            bar.update()

        yield say
