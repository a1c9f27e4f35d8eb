"""Builds wheels that run on every Linux with glibc 2.28 or later, into dist/: `make wheel`.

One wheel for each processor whose compiler is installed: see cmake/manylinux.cmake. auditwheel
finds the version of glibc that the libraries need, and names the wheel after it.
"""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MACHINES = ("x86_64", "aarch64")
TOOLS = ("python-zig", "auditwheel", "patchelf")


def main() -> int:
    missing = [tool for tool in TOOLS if not shutil.which(tool)]
    if missing:
        print(f"snowsplat: {missing[0]} is missing; run: pip install '.[wheel]'", file=sys.stderr)
        return 1
    built: list[Path] = []
    cubins = ""  # of the first wheel: GPU kernels do not depend on the processor
    for machine in MACHINES:
        if shutil.which(f"{machine}-linux-gnu-g++"):
            built.append(build(machine, cubins))
            cubins = cubins or f"{folder_of(machine)}/cmake/cuda"
        else:
            package = f"g++-{machine.replace('_', '-')}-linux-gnu"
            print(f"snowsplat: no wheel for {machine}; it needs {package} (apt install {package})")
    for wheel in built:
        print(f"{wheel.relative_to(ROOT)}: {wheel.stat().st_size / 1e6:.1f} MB")
    return 0 if built else 1


def folder_of(machine: str) -> Path:
    return ROOT / "build" / f"wheel-{machine}"


def build(machine: str, cubins: str) -> Path:
    """The wheel for a processor. Compiles the GPU kernels if there are no ``cubins``."""
    work = folder_of(machine)
    shutil.rmtree(work / "wheel", ignore_errors=True)
    settings = {
        "build-dir": f"{work}/cmake",
        "cmake.define.CMAKE_TOOLCHAIN_FILE": f"{ROOT}/cmake/manylinux.cmake",
        "cmake.define.SNOWSPLAT_MACHINE": machine,
        "cmake.define.SNOWSPLAT_CUBINS": cubins,
    }
    command = ["pip", "wheel", str(ROOT), "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--wheel-dir", str(work / "wheel")]
    command += [f"--config-settings={name}={value}" for name, value in settings.items()]
    run(command, {"_PYTHON_HOST_PLATFORM": f"linux-{machine}"})
    (wheel,) = (work / "wheel").glob("*.whl")
    check_contents(wheel, machine)

    run(["auditwheel", "repair", "--plat=auto", f"--wheel-dir={work}/wheel", str(wheel)])
    (repaired,) = (work / "wheel").glob("*manylinux*.whl")
    oldest = min(map(int, re.findall(r"manylinux_2_(\d+)_", repaired.name)))
    if oldest > 28:
        sys.exit(f"snowsplat: {repaired.name} needs glibc 2.{oldest}; see cmake/manylinux.cmake")
    (ROOT / "dist").mkdir(exist_ok=True)
    return Path(shutil.copy(repaired, ROOT / "dist"))


def check_contents(wheel: Path, machine: str) -> None:
    """A build without NVRTC or for fewer instruction sets works, but is not one to publish."""
    isas = ("baseline", "avx2", "avx512") if machine == "x86_64" else ("baseline",)
    needed = [f"snowsplat/_lib/libsnowsplat_{isa}.so" for isa in isas]
    needed += ["snowsplat/_lib/cuda/sm_90/rasterize.cubin", "snowsplat/_viewer/index.html"]
    missing = set(needed) - set(zipfile.ZipFile(wheel).namelist())
    if missing:
        sys.exit(
            f"snowsplat: {wheel.name} lacks {', '.join(sorted(missing))}; see the output of CMake"
        )


def run(command: list[str], environment: dict[str, str] | None = None) -> None:
    """Run a module of this Python; exit with its output if it fails."""
    result = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=ROOT,
        env=os.environ | (environment or {}),
        capture_output=True,
        text=True,
    )
    if result.returncode:
        sys.exit(f"{result.stdout}{result.stderr}snowsplat: {command[0]} failed; see above")


if __name__ == "__main__":
    sys.exit(main())
