"""The machine code of the kernels for a GPU: from the wheel, or compiled by NVRTC and cached.

A cubin runs on GPUs of its compute capability, and of later capabilities of the same major version.
"""

import contextlib
import functools
import hashlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from snowsplat.ops.cuda import nvrtc
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_bytes

Capability = tuple[int, int]

_BUILT = Path(__file__).resolve().parents[2] / "_lib" / "cuda"


def candidates(file: str, capability: Capability, cuda_major: int) -> Iterator[bytes]:
    """Code that may run on this GPU: a cubin of the wheel, then code compiled by NVRTC.

    Args:
        file: the file of the `Kernel`.
        cuda_major: the CUDA version of the driver, which cannot load code of later versions.

    Raises: UserError: there is no cubin in the wheel, and no compiler.
    """
    major, minor = capability
    for lower in range(minor, -1, -1):
        path = _BUILT / f"sm_{10 * major + lower}" / f"{file}.cubin"
        if path.exists():
            yield path.read_bytes()
            break
    yield _compiled_here(file, capability, cuda_major)


def built_for() -> list[str]:
    """The compute capabilities for which the package contains kernels: "7.5", …"""
    numbers = sorted(int(folder.name[3:]) for folder in _BUILT.glob("sm_*"))
    return [f"{number // 10}.{number % 10}" for number in numbers]


@functools.cache
def _nvrtc(newest: int) -> nvrtc.Nvrtc:
    return nvrtc.Nvrtc(nvrtc.find(range(newest, 11, -1)))


def _compiled_here(file: str, capability: Capability, cuda_major: int) -> bytes:
    shown = f"{capability[0]}.{capability[1]}"
    # The newest NVRTC supports the most GPUs; from 13 on, it does not support those before 7.5.
    newest = min(cuda_major, 13 if capability >= (7, 5) else 12)
    try:
        compiler = _nvrtc(newest)
    except nvrtc.NotFound:
        package = "nvidia-cuda-nvrtc" + ("-cu12" if newest < 13 else "")
        raise UserError(
            "no kernels are built for a GPU of compute capability {shown}, and NVRTC, which "
            "could compile them, is missing: pip install {package}",
            shown=shown,
            package=package,
        ) from None
    number = 10 * capability[0] + capability[1]
    if number in compiler.architectures:
        target = f"sm_{number}"
    else:  # a GPU newer than this compiler: PTX, which the driver compiles
        older = [known for known in compiler.architectures if known < number]
        if not older:
            raise UserError(
                "NVRTC {version} does not support compute capability {shown}",
                version=compiler.version,
                shown=shown,
            )
        target = f"compute_{max(older)}"
    source = nvrtc.path_of(file)
    path = _cache_path(file, target, _key(compiler.version, target, source))
    code = _read(path)
    if code is None:
        code, _ = compiler.compile(source, target)
        _write(path, code)
    return code


def _key(version: tuple[int, int], target: str, source: Path) -> str:
    """A hash of everything that affects the code."""
    digest = hashlib.sha256(repr((version, target, nvrtc.OPTIONS)).encode())
    for path in nvrtc.sources(source):
        content = path.read_bytes()
        digest.update(f"\n{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:32]


def _cache_path(file: str, target: str, key: str) -> Path | None:
    """The file in the user's cache folder; None if there is no such folder."""
    try:
        base: str | Path
        if sys.platform == "win32":
            base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
        else:
            named = os.environ.get("XDG_CACHE_HOME", "")
            base = named if os.path.isabs(named) else Path.home() / ".cache"
    except RuntimeError:  # no home directory
        return None
    return Path(base, "snowsplat", "kernels", f"{file}-{target}-{key}")


# A file contains the SHA-256 of the code, followed by the code, so that damage is detected.


def _read(path: Path | None) -> bytes | None:
    if path is None:
        return None
    try:
        content = path.read_bytes()
    except OSError:
        return None
    code = content[32:]
    return code if hashlib.sha256(code).digest() == content[:32] else None


def _write(path: Path | None, code: bytes) -> None:
    if path is None:
        return
    with contextlib.suppress(OSError):  # if writing fails, the code is compiled again next time
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, hashlib.sha256(code).digest() + code)
