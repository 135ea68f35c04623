"""``python -m bayesoleo`` is the command line."""

from __future__ import annotations

from bayesoleo._cli import run

if __name__ == "__main__":
    run()
