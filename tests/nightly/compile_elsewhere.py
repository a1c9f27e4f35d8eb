"""Compiles and links the CPU kernels with Clang for macOS and Windows, with every warning an error.

    python tests/nightly/compile_elsewhere.py            some minutes

The compiler is Zig, which contains Clang, the headers of macOS, and those of MinGW-w64 for Windows
(pip install '.[wheel]'). The libraries are not run, and nothing is known about the headers of
MSVC. The exit code is 1 if something does not compile.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

NATIVE = Path(__file__).resolve().parents[2] / "src" / "snowsplat" / "native"
FLAGS = ["-std=c++17", "-O1", "-shared", "-fPIC", "-fvisibility=hidden", "-ffp-contract=fast"]
FLAGS += ["-Wall", "-Wextra", "-Werror", "-Wno-psabi"]
AVX2 = ["-mavx2", "-mfma", "-mbmi", "-mbmi2", "-mlzcnt", "-mpopcnt"]
AVX512 = [f"-mavx512{part}" for part in ("f", "bw", "dq", "vl", "cd")] + AVX2
ISAS = {"baseline": [], "avx2": AVX2, "avx512": AVX512}
TARGETS = {
    "aarch64-macos": ["baseline"],
    "x86_64-macos": list(ISAS),
    "x86_64-windows-gnu": list(ISAS),
}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--target", nargs="+", choices=TARGETS, default=list(TARGETS))
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        for target in parser.parse_args().target:
            for isa in TARGETS[target]:
                if not compiles(target, isa, Path(folder)):
                    failed.append(f"{target} {isa}")
    print(f"errors in: {', '.join(failed)}" if failed else "no errors")
    return 1 if failed else 0


def compiles(target: str, isa: str, folder: Path) -> bool:
    started = time.monotonic()
    command = [sys.executable, "-m", "ziglang", "c++", "-target", target, *FLAGS, *ISAS[isa]]
    command += [f"-DSNOWSPLAT_ISA_{isa.upper()}=1", f"-I{NATIVE}"]
    command += map(str, sorted((NATIVE / "cpu").glob("*.cpp")))
    library = folder / f"{target}-{isa}"
    run = subprocess.run([*command, "-o", str(library)], cwd=folder, capture_output=True, text=True)
    passed = run.returncode == 0 and library.is_file()
    result = f"{library.stat().st_size:,} bytes" if passed else "does not compile"
    print(f"{target} {isa}: {result}, {time.monotonic() - started:.0f} s", flush=True)
    if not passed:
        print(run.stdout[-5000:], run.stderr[-5000:], flush=True)
    return passed


if __name__ == "__main__":
    sys.exit(main())
