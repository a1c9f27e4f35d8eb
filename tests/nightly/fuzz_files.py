"""Runs every reader on damaged files, guided by code coverage, for as long as requested.

    python tests/nightly/fuzz_files.py                       20,000 runs of each reader
    python tests/nightly/fuzz_files.py --runs 5000 --only spz --only glb
    python tests/nightly/fuzz_files.py --seconds 600         ten minutes of each

Each reader runs in its own process. A run fails if the reader takes more than 10 s or more memory
than tests/fuzz/limits.py allows, accesses files outside of its folder, runs a program, ends the
process, or raises anything but a one-line `UserError`. The file is then stored in --findings.

The fuzzer is atheris, which uses the branches taken in our code to select promising damage:
`pip install atheris`. Without it the damage is random, and the report says so.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import os
import random
import subprocess
import sys
import time
import traceback
import warnings
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]
_GRACE = 60.0  # seconds that a process may use in addition, to start and to end
_MEMORY = Path("/dev/shm")  # files in memory: on a disk, most of the time is spent waiting for it


def main() -> int:
    """Returns the exit code: 0, 1 after a failure, 2 for wrong flags."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20_000, help="of each reader")
    parser.add_argument("--seconds", type=float, default=300.0, help="at most, of each reader")
    parser.add_argument(
        "--only", action="append", metavar="TEXT", help="only readers whose names contain it"
    )
    parser.add_argument("--findings", type=Path, default=Path("build/fuzz"), metavar="FOLDER")
    parser.add_argument("--random", action="store_true", help="without atheris")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.child is not None:
        return _Child(flags).run()
    return _all(flags)


def _all(flags: argparse.Namespace) -> int:
    from tests.fuzz.readers import READERS

    guided = not flags.random and importlib.util.find_spec("atheris") is not None
    names = [reader.name for reader in READERS]
    wanted = [n for n in names if not flags.only or any(text in n for text in flags.only)]
    if not wanted:
        print(f"no reader has such a name; there are: {', '.join(names)}", file=sys.stderr)
        return 2
    print("guided by coverage (atheris)" if guided else "at random: atheris is not installed")
    flags.findings.mkdir(parents=True, exist_ok=True)
    failed, total = [], 0
    for name in wanted:
        runs, seconds, failure = _one(name, flags, guided)
        total += runs
        line = f"{name:32} {runs:7} runs {seconds:7.1f} s  {failure or 'ok'}"
        print(line, flush=True)
        if failure:
            failed.append(name)
    print(f"{len(wanted)} readers, {total} runs, {len(failed)} failed")
    return 1 if failed else 0


def _one(name: str, flags: argparse.Namespace, guided: bool) -> tuple[int, float, str]:
    """Number of runs, seconds, and the failure as text (empty: none)."""
    command = [sys.executable, __file__, "--child", name, "--runs", str(flags.runs)]
    command += ["--seconds", str(flags.seconds), "--seed", str(flags.seed)]
    command += ["--findings", str(flags.findings.absolute())]
    command += [] if guided else ["--random"]
    memory = {"TMPDIR": str(_MEMORY)} if _MEMORY.is_dir() else {}
    note = flags.findings.absolute() / f"{_file_name(name)}.json"
    note.unlink(missing_ok=True)
    start = time.monotonic()
    log = note.with_suffix(".log")
    with open(log, "wb") as output:
        try:
            code = subprocess.run(
                command,
                stdout=output,
                stderr=output,
                timeout=flags.seconds + _GRACE,
                env={**memory, **os.environ},
            ).returncode
        except subprocess.TimeoutExpired:
            code = -1
    seconds = time.monotonic() - start
    report = json.loads(note.read_text()) if note.exists() else {"runs": 0, "failure": ""}
    failure = report["failure"]
    if code != 0 and not failure:
        failure = f"the process ended with {code}, see {log} and the last file beside it"
    return report["runs"], seconds, failure


def _file_name(reader: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in reader)


class _Child:
    """The runs of one reader."""

    def __init__(self, flags: argparse.Namespace) -> None:
        self.flags = flags
        self.note = flags.findings / f"{_file_name(flags.child)}.json"
        self.last = self.note.with_suffix(".last")  # the current file, in case the process ends
        self.runs = 0
        self.end = time.monotonic() + flags.seconds
        logging.disable(logging.WARNING)
        warnings.simplefilter("ignore")

    def run(self) -> int:
        """Returns the exit code."""
        if self.flags.random:
            self._load()
            return self._at_random()
        return self._guided()

    def _load(self) -> None:
        from tests.fuzz import damage, limits, readers

        self.damage, self.limits = damage, limits
        self.reader = next(r for r in readers.READERS if r.name == self.flags.child)
        self.try_out(self.reader.valid)

    def _at_random(self) -> int:
        generator = random.Random(self.flags.seed)
        while self.runs < self.flags.runs and time.monotonic() < self.end:
            self.try_out(self.damaged(self.reader.valid, generator))
        self._report("")
        return 0

    def _guided(self) -> int:
        import atheris

        with atheris.instrument_imports(include=["snowsplat"]):
            self._load()
        corpus = self.note.with_suffix(".corpus")
        corpus.mkdir(exist_ok=True)
        (corpus / "valid").write_bytes(self.reader.valid)

        def mutate(data: bytes, max_size: int, seed: int) -> bytes:
            generator = random.Random(seed)
            if generator.random() < 0.5:
                return bytes(atheris.Mutate(data, max_size))[:max_size]
            return self.damaged(data, generator)[:max_size]

        largest = max(4096, 4 * len(self.reader.valid))
        arguments = [sys.argv[0], f"-seed={self.flags.seed + 1}", f"-max_len={largest}"]
        arguments += ["-timeout=60", "-rss_limit_mb=0", "-detect_leaks=0", "-verbosity=0"]
        arguments += [f"-artifact_prefix={self.note.with_suffix('')}.", str(corpus)]
        atheris.Setup(arguments, self._one_input, custom_mutator=mutate)
        atheris.Fuzz()
        return 0

    def _one_input(self, data: bytes) -> None:
        if self.runs >= self.flags.runs or time.monotonic() > self.end:
            self._report("")
            os._exit(0)  # libFuzzer ends by itself only after a failure
        self.try_out(data)

    def damaged(self, data: bytes, generator: random.Random) -> bytes:
        """Damage the bytes, or their JSON."""
        changes = [self.damage.random_change(generator) for _ in range(generator.randint(1, 4))]
        as_json = self.reader.json and generator.random() < 0.5
        return (self.damage.damaged_json if as_json else self.damage.damaged)(data, changes)

    def try_out(self, data: bytes) -> None:
        """Read one file; ends the process on a failure."""
        reader = self.reader
        self.last.write_bytes(data)
        size = reader.write(data)
        try:
            self.limits.guarded(
                lambda: reader.read(reader.folder), reader.folder, size, reader.memory()
            )
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            traceback.print_exc()
            stored = self.last.rename(self.last.with_suffix(".failed"))
            first = (str(error).splitlines() or [""])[0][:200]
            self._report(f"{type(error).__name__}: {first}; {stored}")
            os._exit(1)
        self.runs += 1

    def _report(self, failure: str) -> None:
        self.note.write_text(json.dumps({"runs": self.runs, "failure": failure}))


if __name__ == "__main__":
    sys.exit(main())
