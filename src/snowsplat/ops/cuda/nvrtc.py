"""Compiles kernels with NVRTC, NVIDIA's compiler library. It needs no CUDA toolkit and no GPU.

This module must not import torch or other modules of snowsplat: the build of a wheel runs it as a
script, in an environment that has neither (see CMakeLists.txt).

    python nvrtc.py --find
    python nvrtc.py SOURCE --target sm_90 --output FILE
"""

import argparse
import ctypes
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

# Options that increase the speed without a relevant loss of accuracy: denormal numbers are flushed
# to zero, as on the CPU, but divisions and square roots stay exact. With the last option, lambdas
# in kernels need no __device__.
OPTIONS = ("--std=c++17", "--ftz=true", "--device-as-default-execution-space")

# NVRTC 12.9 prints this for 7.0, and has no option against it. NVRTC 13 does not know 7.0.
_DEPRECATED = re.compile(r"^nvrtc: warning: Architectures prior to .*deprecated.*$", re.MULTILINE)

_NATIVE = Path(__file__).resolve().parents[2] / "native"

# Folders of the library in Python packages, relative to sys.path, and its file names.
_FOLDERS = {
    12: ("nvidia/cuda_nvrtc/lib", "nvidia/cuda_nvrtc/bin", "torch/lib"),
    13: ("nvidia/cu13/lib", "nvidia/cu13/bin/x86_64", "nvidia/cu13/bin", "torch/lib"),
}
_NAMES = {
    12: ("libnvrtc.so.12", "nvrtc64_120_0.dll"),
    13: ("libnvrtc.so.13", "nvrtc64_130_0.dll"),
}


class NotFound(Exception):
    """NVRTC is not installed."""


class CompileError(Exception):
    """A kernel cannot be compiled; the message is that of the compiler."""


def path_of(file: str) -> Path:
    """The source of a `Kernel.file`."""
    return _NATIVE / "cuda" / f"{file}.cu"


def sources(path: Path) -> list[Path]:
    """A source file and all files that it includes; the file itself is first.

    Both branches of an #if are followed; missing files (the header of the emulation) are ignored.
    """
    found = [path]
    for file in found:
        for name in re.findall(r'^\s*#\s*include\s+"(.+)"', file.read_text("utf-8"), re.MULTILINE):
            places = (place / name for place in (file.parent, _NATIVE))
            header = next((p.resolve() for p in places if p.exists()), None)
            if header is not None and header not in found:
                found.append(header)
    return found


def find(majors: Sequence[int] = (12, 13)) -> str:
    """The path of the library of the first available major version, or its name for the loader.

    Raises: NotFound: none of them is installed.
    """
    for major in majors:
        for entry in sys.path:
            for folder in _FOLDERS[major]:
                for name in _NAMES[major]:
                    path = Path(entry, folder, name)
                    if path.exists():
                        return str(path.resolve())
        for name in _NAMES[major]:
            try:
                ctypes.CDLL(name)
            except OSError:
                continue
            return name
    raise NotFound("NVRTC is not installed")


class Nvrtc:
    """A loaded NVRTC library: its architectures, and `compile`. Thread-safe."""

    def __init__(self, library: str) -> None:
        if sys.platform == "win32" and os.path.isabs(library):
            os.add_dll_directory(os.path.dirname(library))  # it loads another library from there
        self._library = ctypes.CDLL(library)
        self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._check(self._library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
        self.version = (major.value, minor.value)
        count = ctypes.c_int()
        self._check(self._library.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
        numbers = (ctypes.c_int * count.value)()
        self._check(self._library.nvrtcGetSupportedArchs(numbers))
        self.architectures = tuple(numbers)  # 75, 80, …: it generates machine code for them

    def compile(self, source: Path, target: str, lineinfo: bool = False) -> tuple[bytes, str]:
        """The compiled file, and the compiler's warnings ("" for none).

        Args:
            target: "sm_90" for machine code (a cubin), "compute_90" for PTX.
            lineinfo: include source lines for profilers and sanitizers.

        Raises:
            CompileError: the code cannot be compiled; contains the complete output of the compiler.
        """
        options = [f"--gpu-architecture={target}", *OPTIONS, f"--include-path={_NATIVE}"]
        if lineinfo:
            options.append("--generate-line-info")
        encoded = [os.fsencode(option) for option in options]
        library, program = self._library, ctypes.c_void_p()
        text, name = source.read_bytes(), os.fsencode(source)
        self._check(library.nvrtcCreateProgram(ctypes.byref(program), text, name, 0, None, None))
        try:
            array = (ctypes.c_char_p * len(encoded))(*encoded)
            result = library.nvrtcCompileProgram(program, len(encoded), array)
            log = self._text("ProgramLog", program).rstrip(b"\0").decode(errors="replace")
            log = _DEPRECATED.sub("", log).strip()
            if result:
                raise CompileError(
                    f"{source.name} does not compile for {target}: {self._error(result)}\n{log}"
                )
            return self._text("CUBIN" if target.startswith("sm_") else "PTX", program), log
        finally:
            library.nvrtcDestroyProgram(ctypes.byref(program))

    def _text(self, what: str, program: ctypes.c_void_p) -> bytes:
        size = ctypes.c_size_t()
        self._check(getattr(self._library, f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
        content = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, f"nvrtcGet{what}")(program, content))
        return content.raw

    def _error(self, result: int) -> str:
        return str(self._library.nvrtcGetErrorString(result).decode())

    def _check(self, result: int) -> None:
        if result:
            raise CompileError(f"NVRTC: {self._error(result)}")


def _main() -> int:
    parser = argparse.ArgumentParser(description="Compile a CUDA source file with NVRTC.")
    parser.add_argument("source", type=Path, nargs="?")
    parser.add_argument("--find", action="store_true", help="print the library's path")
    parser.add_argument("--target", help="sm_90 and so on")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--depfile", type=Path, help="list the source files in this file")
    parser.add_argument("--log", type=Path, help="write NVRTC's version and warnings to this file")
    parser.add_argument("--library", help="the NVRTC to use")
    parser.add_argument("--lineinfo", action="store_true")
    asked = parser.parse_args()
    try:
        library = asked.library or find()
        nvrtc = Nvrtc(library)
        if asked.find:
            print(library)
            return 0
        code, log = nvrtc.compile(asked.source.resolve(), asked.target, asked.lineinfo)
    except (NotFound, CompileError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    if log:
        print(log, file=sys.stderr)
    asked.output.parent.mkdir(parents=True, exist_ok=True)
    if asked.log:
        version = ".".join(map(str, nvrtc.version))
        asked.log.write_text(f"{version}\n{log}", encoding="utf-8")
    asked.output.write_bytes(code)
    if asked.depfile:
        paths = (asked.output, *sources(asked.source.resolve()))
        target, *names = (str(path).replace(" ", r"\ ") for path in paths)
        asked.depfile.write_text(f"{target}: {' '.join(names)}\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(_main())
