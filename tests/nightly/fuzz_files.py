"""Runs every reader on damaged files that are chosen by code coverage, for as long as requested.

    python tests/nightly/fuzz_files.py                       five minutes of each reader
    python tests/nightly/fuzz_files.py --seconds 60 --only spz --only glb

The fuzzer is atheris (`pip install atheris`). Each reader runs in its own process, within the
limits of tests/fuzz/limits.py. If it violates one, or raises anything but a one-line `UserError`,
the log and the file are in --findings. `SNOWSPLAT_FUZZ=20000 python -m pytest tests/fuzz` damages
files at random instead.
"""

import argparse
import logging
import os
import random
import subprocess
import sys
import time
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
    parser.add_argument("--seconds", type=int, default=300, help="of each reader")
    parser.add_argument(
        "--only", action="append", metavar="TEXT", help="only readers whose names contain it"
    )
    parser.add_argument("--findings", type=Path, default=Path("build/fuzz"), metavar="FOLDER")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.child is not None:
        fuzz(flags)
        return 0
    from tests.fuzz.readers import READERS

    names = [reader.name for reader in READERS]
    wanted = [n for n in names if not flags.only or any(text in n for text in flags.only)]
    if not wanted:
        print(f"no reader has such a name; there are: {', '.join(names)}", file=sys.stderr)
        return 2
    flags.findings.mkdir(parents=True, exist_ok=True)
    failed = sum(not survives(name, flags) for name in wanted)
    print(f"{len(wanted)} readers, {failed} failed")
    return 1 if failed else 0


def survives(name: str, flags: argparse.Namespace) -> bool:
    """Fuzz one reader in a process of its own."""
    findings = flags.findings.absolute() / "".join(c if c.isalnum() else "_" for c in name)
    command = [sys.executable, __file__, "--child", name, "--seconds", str(flags.seconds)]
    command += ["--seed", str(flags.seed), "--findings", str(findings)]
    memory = {"TMPDIR": str(_MEMORY)} if _MEMORY.is_dir() else {}
    start, log = time.monotonic(), findings.with_suffix(".log")
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
    done = [line for line in log.read_text(errors="replace").splitlines() if "runs in" in line]
    result = done[-1] if done and code == 0 else f"failed with {code}, see {log}"
    print(f"{name:32} {time.monotonic() - start:7.1f} s  {result}", flush=True)
    return code == 0


def fuzz(flags: argparse.Namespace) -> None:
    """Fuzz one reader, until a failure or for the time; ends the process."""
    import atheris

    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    with atheris.instrument_imports(include=["snowsplat"]):
        from tests.fuzz import damage, limits, readers
    reader = next(r for r in readers.READERS if r.name == flags.child)
    corpus = flags.findings.with_suffix(".corpus")
    corpus.mkdir(exist_ok=True)
    (corpus / "valid").write_bytes(reader.valid)

    def read(data: bytes) -> None:
        size = reader.write(data)
        limits.guarded(lambda: reader.read(reader.folder), reader.folder, size, reader.memory())

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        generator = random.Random(seed)
        if generator.random() < 0.5:
            return bytes(atheris.Mutate(data, max_size))[:max_size]
        changes = [damage.random_change(generator) for _ in range(generator.randint(1, 4))]
        as_json = reader.json and generator.random() < 0.5
        return (damage.damaged_json if as_json else damage.damaged)(data, changes)[:max_size]

    read(reader.valid)
    largest = max(4096, 4 * len(reader.valid))
    arguments = [sys.argv[0], f"-seed={flags.seed + 1}", f"-max_len={largest}", "-timeout=60"]
    arguments += ["-rss_limit_mb=0", "-detect_leaks=0", "-verbosity=1", "-print_final_stats=0"]
    arguments += [f"-max_total_time={flags.seconds}", f"-artifact_prefix={flags.findings}."]
    atheris.Setup([*arguments, str(corpus)], read, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
