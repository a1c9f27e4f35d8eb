"""The command `snowsplat`, also `python -m snowsplat`: all subcommands, with the extras."""

import sys

from snowsplat import extras
from snowsplat.cli.main import main as run


def main() -> int:
    """Run the command with the arguments of the process; returns the exit code."""
    extras.register()
    return run()


if __name__ == "__main__":
    sys.exit(main())
