"""Runs the CPU kernels under sanitizers: AddressSanitizer and UndefinedBehaviorSanitizer with the
tests of the ops and of matching, on each instruction set of this machine, and ThreadSanitizer for
the threads.

    python tests/nightly/sanitize_native.py              some minutes
    python tests/nightly/sanitize_native.py --isa avx2 --skip threads

It needs g++ with its sanitizers. The exit code is 1 if anything is found.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "snowsplat"
BUILD = ROOT / "build" / "sanitized_native"
NATIVE = PACKAGE / "native"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--isa", nargs="+", help="default: all that run here")
    parser.add_argument("--skip", nargs="+", default=[], choices=["memory", "threads"])
    flags = parser.parse_args()
    failed = []
    if "memory" not in flags.skip:
        package = _sanitized_package()
        for isa in flags.isa or _isas(package):
            failed += [] if _tests(package, isa) else [isa]
    if "threads" not in flags.skip and not _threads():
        failed.append("threads")
    print(f"errors in: {', '.join(failed)}" if failed else "no errors")
    return 1 if failed else 0


def _sanitized_package() -> Path:
    """A folder with a copy of the package whose libraries are sanitized."""
    sanitize = "-fsanitize=address,undefined -fno-sanitize-recover=undefined -g1"
    configure = ["cmake", "-G", "Ninja", "-S", ROOT, "-B", BUILD / "cmake", "--log-level=WARNING"]
    # Without GPU kernels, which take a minute to build and are tested elsewhere.
    configure += ["-DCMAKE_CXX_COMPILER=g++", "-DCMAKE_DISABLE_FIND_PACKAGE_Python3=ON"]
    subprocess.run([*configure, f"-DCMAKE_CXX_FLAGS={sanitize}"], check=True)
    subprocess.run(["cmake", "--build", BUILD / "cmake", "--", "--quiet"], check=True)
    source = BUILD / "src"
    shutil.rmtree(source, ignore_errors=True)
    install = ["cmake", "--install", BUILD / "cmake", "--prefix", source]
    subprocess.run(install, check=True, stdout=subprocess.DEVNULL)
    for path in PACKAGE.iterdir():
        link = source / "snowsplat" / path.name
        if not link.exists() and path.name != "_lib":
            link.symlink_to(path)
    return source


def _preloaded() -> dict[str, str]:
    libraries = [
        subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True).stdout
        for name in ("libasan.so", "libubsan.so")
    ]
    return os.environ | {
        "LD_PRELOAD": " ".join(path.strip() for path in libraries),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python itself has leaks
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }


def _isas(package: Path) -> list[str]:
    code = "from snowsplat.ops import native; print(*native.available_isas())"
    environment = _preloaded() | {"PYTHONPATH": str(package)}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True
    ).stdout.split()


def _tests(package: Path, isa: str) -> bool:
    started = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-m", "not emulated and not gpu"]
    command += ["tests/ops", "tests/sfm/colmap/pairs/test_matching.py", "tests/data/lens"]
    # Without tests that measure times, load their own libraries, or compile with NVRTC, which does
    # not find its own libraries under a sanitizer.
    for other in ("native", "emulation", "driver", "cuda_build"):
        command.append(f"--ignore=tests/ops/test_{other}.py")
    command += ["-o", f"pythonpath={package}"]
    environment = _preloaded() | {"PYTHONPATH": str(package), "SNOWSPLAT_ISA": isa}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    lines = run.stdout.strip().splitlines() or ["no output of pytest"]
    print(f"{isa}: {lines[-1]}, {time.monotonic() - started:.0f} s in all", flush=True)
    if run.returncode != 0:
        print(run.stdout[-5000:], run.stderr[-5000:], flush=True)
    return run.returncode == 0


def _threads() -> bool:
    """ThreadSanitizer does not support torch's locks, so a separate program calls the kernels."""
    program = BUILD / "races"
    BUILD.mkdir(parents=True, exist_ok=True)
    command = ["g++", "-std=c++17", "-O1", "-g", "-fsanitize=thread", "-pthread", "-Wno-psabi"]
    command += ["-DSNOWSPLAT_ISA_BASELINE=1", f"-I{NATIVE}", ROOT / "tests" / "ops" / "races.cpp"]
    sources = sorted((NATIVE / "cpu").glob("*.cpp"))
    subprocess.run([*command, *sources, "-o", program], check=True)
    run = subprocess.run([program], capture_output=True, text=True)
    print(f"threads: {run.stdout.strip() or 'no output'}; exit code {run.returncode}", flush=True)
    if run.returncode != 0:
        print(run.stderr[-5000:], flush=True)
    return run.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
