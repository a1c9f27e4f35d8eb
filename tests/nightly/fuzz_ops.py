"""Compares the ops with the float64 reference on extreme scenes, by hypothesis: see extremes.py.

    python tests/nightly/fuzz_ops.py                              20,000 cases and some on emulation
    python tests/nightly/fuzz_ops.py --cases 1000 --isa avx2 --seed 7

The scenes are those of tests/ops/extremes.py. Each instruction set runs in its own process. One
case in fifty also runs on the emulated GPU kernels. The exit code is 1 after a failure; the
smallest failing case is printed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

#: Cases out of a thousand; the others go to `check_project`.
SHARES = {
    "rasterize": 350,
    "harm": 150,
    "neighbours": 100,
    "plane sweep": 50,
    "photometric": 98,
    "long images": 2,
}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=20_000, help="over all instruction sets")
    parser.add_argument("--isa", nargs="+", help="default: all that run here")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-emulation", action="store_true")
    parser.add_argument("--part", nargs=2, help=argparse.SUPPRESS)  # instruction set, cases
    flags = parser.parse_args()
    if flags.part is not None:
        return _part(flags.part[0], int(flags.part[1]), flags.seed)
    from snowsplat.ops import native

    isas = flags.isa or native.available_isas()
    parts = [(isa, flags.cases // len(isas)) for isa in isas]
    if not flags.no_emulation:
        parts.append(("emulated", flags.cases // 50))
    failed = []
    for name, cases in parts:
        environment = dict(os.environ)
        if name != "emulated":
            environment["SNOWSPLAT_ISA"] = name
        command = [sys.executable, __file__, "--part", name, str(cases), "--seed", str(flags.seed)]
        if subprocess.run(command, env=environment, check=False).returncode != 0:
            failed.append(name)
    print(f"failed on: {', '.join(failed)}" if failed else "all checks hold")
    return 1 if failed else 0


def _part(name: str, cases: int, seed: int) -> int:
    import torch
    from tests.ops.engines import launcher
    from tests.ops.scenes import (
        EMULATED_FLOAT32,
        EMULATED_FLOAT64,
        NATIVE_FLOAT32,
        NATIVE_FLOAT64,
    )

    from snowsplat.ops.native import LAUNCHERS

    torch.set_num_threads(1)
    variants = [NATIVE_FLOAT32, NATIVE_FLOAT64]
    if name == "emulated":
        LAUNCHERS["cpu"] = launcher("emulated")
        variants = [EMULATED_FLOAT32, EMULATED_FLOAT64]
    shares = {"project": 1000 - sum(SHARES.values()), **SHARES}
    wrong = 0
    for check, share in shares.items():
        for variant, part in zip(variants, (0.75, 0.25), strict=True):
            count = max(1, round(cases * share * part / 1000))
            started, done = time.monotonic(), [0]
            try:
                _run(check, variant, count, seed, done)
                verdict = "holds"
            except Exception:
                traceback.print_exc(file=sys.stdout)
                verdict, wrong = "DOES NOT HOLD", wrong + 1
            seconds = time.monotonic() - started
            print(
                f"{name} {variant} {check}: {done[0]} cases, {verdict}, {seconds:.0f} s", flush=True
            )
    return 1 if wrong else 0


def _run(check: str, variant: object, count: int, seed: int, done: list[int]) -> None:
    from hypothesis import HealthCheck, given, settings
    from hypothesis import seed as seeded
    from hypothesis import strategies as st
    from tests.ops import extremes

    strategies, holds = extremes.CHECKS[check]

    def test(drawn: tuple) -> None:
        done[0] += 1
        holds(variant, *drawn)

    quiet = settings(
        max_examples=count,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    counted: Callable[[], None] = seeded(seed)(quiet(given(st.tuples(*strategies))(test)))
    counted()


if __name__ == "__main__":
    sys.exit(main())
