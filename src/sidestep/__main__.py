"""Entry point of the program, for `sidestep` and `python -m sidestep`."""

import sys

from sidestep import _interrupts


def main() -> int:
    """Run the command line; returns the exit status. Ctrl-C is handled from here on, during imports too."""
    _interrupts.claim()
    from sidestep import cli

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
