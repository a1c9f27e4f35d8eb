"""Follows each walk-through of docs/extend in a copy of the project, command by command.

    python tests/nightly/try_walk_throughs.py                    all four
    python tests/nightly/try_walk_throughs.py "a loss" --keep    one; keep the copy

The copy has the files that git tracks, as they are in the working tree, and the built libraries.
The commands run in it with this Python. The exit code is 1 if a change does not apply or a command
fails.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from walk_throughs import ROOT, Mismatch, WalkThrough, walk_throughs

_BUILT = ("src/snowsplat/_lib", "src/snowsplat/_viewer")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("only", nargs="*", help="parts of titles (default: all walk-throughs)")
    parser.add_argument("--keep", action="store_true", help="keep the copies")
    flags = parser.parse_args()
    walks = walk_throughs()
    chosen = [w for w in walks if not flags.only or any(part in w.title for part in flags.only)]
    if not chosen:
        parser.error(f"no walk-through has such a title; there are {[w.title for w in walks]}")
    failed = 0
    for walk in chosen:
        folder = Path(tempfile.mkdtemp(prefix="snowsplat-walk-"))
        try:
            failed += not follow(walk, folder)
        finally:
            if flags.keep:
                print(f"kept {folder}")
            else:
                shutil.rmtree(folder)
    return 1 if failed else 0


def follow(walk: WalkThrough, folder: Path) -> bool:
    """Apply a walk-through to a copy in ``folder``; True if all of its commands succeed."""
    print(f"== {walk.title}", flush=True)
    copy_project(folder)
    try:
        walk.apply(folder)
    except Mismatch as error:
        print(f"FAILED: {error}", flush=True)
        return False
    environment = {
        **os.environ,
        "PYTHON": sys.executable,
        "PYTHONPATH": os.pathsep.join([str(use_copy(folder)), str(folder / "src")]),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    for command in walk.commands:
        started = time.monotonic()
        print(f"$ {command}", flush=True)
        code = subprocess.run(command, shell=True, cwd=folder, env=environment).returncode
        print(f"exit code {code}, {time.monotonic() - started:.0f} s", flush=True)
        if code:
            print("FAILED", flush=True)
            return False
    return True


def use_copy(folder: Path) -> Path:
    """A folder for PYTHONPATH, with which Python imports the copy and not an editable installation.

    Such an installation adds a finder to `sys.meta_path`, which comes before PYTHONPATH.
    """
    site = folder / ".site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(
        '"""Removes the finders of editable installations."""\n\n'
        "import sys\n\n"
        "sys.meta_path[:] = [\n"
        '    f for f in sys.meta_path if not type(f).__module__.startswith("_editable_skbc_")\n'
        "]\n"
    )
    return site


def copy_project(folder: Path) -> None:
    """Copy the tracked files and the built libraries."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    for name in _BUILT:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name)


if __name__ == "__main__":
    sys.exit(main())
