"""Runs the CPU kernels for Arm (NEON) in QEMU: `make neon`.

A cross compiler builds the library. A program for Arm (server.cpp) calls its functions: each call
sends it the struct of parameters and the memory of the tensors, and receives the memory back. So
the tests compare the NEON kernels with the float64 reference, as they do for other kernels.

The environment variable SNOWSPLAT_NEON=run selects these kernels instead of those of this machine.
Its value can also be the path of a library, for example one from a wheel.
"""

from __future__ import annotations

import ctypes
import fcntl
import functools
import os
import shutil
import struct
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.util import native_library
from snowsplat.util.native_layout import Fields

COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
_SYSTEM = Path("/usr/aarch64-linux-gnu")  # of Debian's cross compiler
_HERE = Path(__file__).parent
_ROOT = _HERE.parents[2]
_BUILD = _ROOT / "build" / "neon"
_ONE_CALL = threading.Lock()  # tests call from several threads


def launch(name: str, fields: Fields) -> int:
    """Calls a function of the library; for tensors and arrays in this process.

    The struct is packed for the library of this machine. The program compares both descriptions.
    """
    layout = native_library._function(name).layout
    words = ctypes.create_string_buffer(layout.size)
    layout.pack_into(words, name, fields)
    values = [fields[field] for field in layout.names]
    memory = {i: _span(v) for i, v in enumerate(values) if hasattr(v, "data_ptr")}
    blocks = _merged(memory.values())
    pointers = []
    for i, span in memory.items():
        number, block = next((k, b) for k, b in enumerate(blocks) if span.within(b))
        pointers += [i, number, span.start - block.start]

    text, description = name.encode(), layout.text.encode()
    numbers = [native_library.library()[1].get_num_threads(), layout.size // 8]
    sizes = [number for block in blocks for number in (block.size, block.start % 64)]
    with _ONE_CALL:
        process = _server()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(_packed(len(text)) + text)
        process.stdin.write(_packed(len(description)) + description)
        process.stdin.write(_packed(*numbers) + words.raw)
        process.stdin.write(_packed(len(blocks), *sizes, len(pointers) // 3, *pointers))
        for block in blocks:
            process.stdin.write(ctypes.string_at(block.start, block.size))
        process.stdin.flush()
        reply = process.stdout.read(8)
        if len(reply) < 8:
            _server.cache_clear()  # the next call starts another one
            raise AssertionError(f"{name}: the program in the emulator has ended")
        for block in blocks:
            ctypes.memmove(block.start, process.stdout.read(block.size), block.size)
    return int(struct.unpack("<q", reply)[0])


@dataclass(frozen=True, order=True)
class _Span:
    """Memory from an address on."""

    start: int
    size: int

    @property
    def end(self) -> int:
        return self.start + self.size

    def within(self, other: _Span) -> bool:
        return other.start <= self.start and self.end <= other.end


def _span(value: Any) -> _Span:
    array = getattr(value, "array", value)  # of an `_ArrayPointer`
    return _Span(value.data_ptr(), array.nbytes)


def _merged(spans: Any) -> list[_Span]:
    """Spans without overlaps that cover the given ones."""
    merged: list[_Span] = []
    for span in sorted(set(spans)):
        if merged and span.start < merged[-1].end:
            before = merged[-1]
            merged[-1] = _Span(before.start, max(before.end, span.end) - before.start)
        else:
            merged.append(span)
    return merged


def _packed(*numbers: int) -> bytes:
    return struct.pack(f"<{len(numbers)}Q", *numbers)


@functools.cache
def _server() -> subprocess.Popen[bytes]:
    """The program in the emulator. It ends with this process, which closes its stdin."""
    own = os.environ["SNOWSPLAT_NEON"]
    program, library = _BUILD / "server", _BUILD / "libsnowsplat_baseline.so"
    _BUILD.mkdir(parents=True, exist_ok=True)
    with (_BUILD / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if own == "run":
            _build_library()
        _run(COMPILER, "-std=c++17", "-O1", "-Wall", "-Wextra", _HERE / "server.cpp", "-o", program)
    command = [EMULATOR, "-L", _SYSTEM, program, library if own == "run" else own]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def _build_library() -> None:
    """CMake compiles only changed files."""
    configure = ["cmake", "-G", "Ninja", "-S", _ROOT, "-B", _BUILD, "--log-level=ERROR"]
    configure += ["-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64"]
    configure += [f"-DCMAKE_CXX_COMPILER={shutil.which(COMPILER)}"]
    _run(*configure, "-DCMAKE_DISABLE_FIND_PACKAGE_Python3=ON")  # without GPU kernels
    _run("cmake", "--build", _BUILD, "--", "--quiet")


def _run(*command: str | Path) -> None:
    made = subprocess.run(command, capture_output=True, text=True)
    assert made.returncode == 0, f"{command[0]} failed:\n{made.stdout}{made.stderr}"
