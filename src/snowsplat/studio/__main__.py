"""Starts the worker; see `snowsplat.studio.worker`.

A job holds its lock before the worker is imported, which takes seconds: a studio that starts in
these seconds knows that the job runs.
"""

import sys
from pathlib import Path

from snowsplat.project.studio_scene import TASKS, StudioScene
from snowsplat.util.run_lock import InUse, locked


def main(words: list[str]) -> int:
    """Returns the exit code; 2 if another process does the task."""
    if words[0] not in TASKS:
        return _work(words)
    scene = StudioScene(Path(words[1]))
    try:
        with locked(scene.lock(words[0]), str(scene.folder)):
            return _work(words)
    except InUse as error:
        print(error, file=sys.stderr)
        return 2


def _work(words: list[str]) -> int:
    from snowsplat.studio.worker import main as work  # torch

    return work(words)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
