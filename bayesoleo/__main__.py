"""``python -m bayesoleo`` is the command line."""

from bayesoleo.cli import main

if __name__ == "__main__":
    main()
