"""Loads the library of CPU kernels for the best instruction set of this machine.

`snowsplat/_lib` has one shared library per instruction set. All have the same entries: C functions
that take a pointer to a struct of parameters and return an int64. The environment variable
SNOWSPLAT_ISA (avx512, avx2 or baseline) selects another library than the best.

This module does not import torch, so that programs that only process NumPy arrays start fast.
"""

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from snowsplat.util.errors import UserError
from snowsplat.util.machine import processor_count
from snowsplat.util.native_layout import LARGEST_STRUCT, Fields, Layout, Mismatch

# Worst to best. The index of a name is its number in native/cpu/isa.cpp.
ISAS = ("baseline", "avx2", "avx512")

_LIBRARIES = Path(__file__).resolve().parent.parent / "_lib"
_SUFFIX = ".dll" if sys.platform == "win32" else ".so"  # on macOS, too
_lock = threading.RLock()


def _path(isa: str) -> Path:
    return _LIBRARIES / f"libsnowsplat_{isa}{_SUFFIX}"


def _open(isa: str) -> ctypes.CDLL:
    """The library of one instruction set. Its calls release the interpreter lock."""
    path = _path(isa)
    if not path.exists():
        raise UserError(
            "the native library {name} is missing; in a checkout `make native` builds it, "
            "elsewhere `pip install .` does",
            name=path.name,
        )
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise UserError(
            "the native library {path} cannot be loaded ({error}); rebuild it",
            path=path,
            error=error,
        ) from error


@functools.cache
def available_isas() -> tuple[str, ...]:
    """The instruction sets that are built and that this machine supports, worst first."""
    best = _open("baseline").best_isa()
    built = (isa for isa in ISAS if _path(isa).exists())
    return tuple(isa for isa in built if ISAS.index(isa) <= best)


def _choose() -> str:
    forced = os.environ.get("SNOWSPLAT_ISA", "")
    if not forced:
        return available_isas()[-1]
    if forced not in ISAS:
        raise UserError(
            "SNOWSPLAT_ISA={forced!r} is not an instruction set; use one of {isas}",
            forced=forced,
            isas=", ".join(ISAS),
        )
    if forced not in available_isas():
        raise UserError(
            "SNOWSPLAT_ISA={forced} is not supported here; this machine and this build have "
            "{available_isas}",
            forced=forced,
            available_isas=", ".join(available_isas()),
        )
    return forced


@functools.cache
def library() -> tuple[str, ctypes.CDLL]:
    """The instruction set in use, and its library.

    Raises UserError if the library is missing, or SNOWSPLAT_ISA or SNOWSPLAT_THREADS is invalid.
    """
    with _lock:
        isa = _choose()
        found = _open(isa)
        found.set_num_threads(ctypes.c_int64(default_threads()))
        return isa, found


class _Function(NamedTuple):
    call: Callable[[int], int]
    layout: Layout


class _Buffer(threading.local):
    """Memory for the struct of a call; each thread has its own."""

    def __init__(self) -> None:
        self.bytes = ctypes.create_string_buffer(LARGEST_STRUCT)
        self.address = ctypes.addressof(self.bytes)


_functions: dict[str, _Function] = {}  # those that have been called
_buffer = _Buffer()


def call(name: str, fields: Fields) -> int:
    """Call a function with the parameters `fields`; C++ does not check their values.

    Tensors, and other objects with `data_ptr`, must be contiguous, and in the memory of the CPU.

    Raises:
        UserError: as `library`; or the library does not match the Python files.
        TypeError: a field of the wrong type.
    """
    buffer = _buffer
    try:
        function = _functions.get(name) or _function(name)
        function.layout.pack_into(buffer.bytes, name, fields)
    except Mismatch:
        raise UserError(
            "the native library for {isa} does not match the Python files ({name}); rebuild it: "
            "`make native` in a checkout, `pip install .` elsewhere",
            isa=library()[0],
            name=name,
        ) from None
    return function.call(buffer.address)


def call_with_arrays(name: str, **fields: NDArray[Any] | float | None) -> int:
    """`call` with NumPy arrays, for programs that do not import torch.

    Raises ValueError if an array is not contiguous.
    """
    return call(
        name,
        {
            field: _ArrayPointer(value) if isinstance(value, np.ndarray) else value
            for field, value in fields.items()
        },
    )


def check_array(name: str, array: NDArray[Any], shape: tuple[int, ...], dtype: Any) -> None:
    """Raises ValueError if an array, whose memory a function reads, has another shape or type."""
    if array.shape != shape or array.dtype != dtype:
        expected = f"{shape} {np.dtype(dtype)}"
        raise ValueError(f"{name} must be {expected}, got {array.shape} {array.dtype}")


class _ArrayPointer:
    __slots__ = ("array",)

    def __init__(self, array: NDArray[Any]) -> None:
        if not array.flags.c_contiguous:
            raise ValueError(f"an array of shape {array.shape} is not contiguous")
        self.array = array

    def data_ptr(self) -> int:
        return int(self.array.ctypes.data)


def _function(name: str) -> _Function:
    try:
        describe = getattr(library()[1], f"{name}_fields")
        function = getattr(library()[1], name)
    except AttributeError:
        raise Mismatch(f"no {name}") from None
    describe.restype = ctypes.c_char_p
    function.restype, function.argtypes = ctypes.c_int64, (ctypes.c_void_p,)
    _functions[name] = _Function(function, Layout(describe().decode()))
    return _functions[name]


def set_num_threads(threads: int) -> None:
    """Sets the number of threads that the kernels use. Results are bit-identical for any number.

    Raises UserError if the number is less than 1, and as `library`.
    """
    if threads < 1:
        raise UserError("the number of threads must be 1 or more, not {threads}", threads=threads)
    library()[1].set_num_threads(ctypes.c_int64(threads))


def default_threads() -> int:
    """SNOWSPLAT_THREADS, or else the number of processors that this process may use."""
    asked = os.environ.get("SNOWSPLAT_THREADS", "")
    if not asked:
        return processor_count()
    if not asked.isdecimal() or int(asked) < 1:
        raise UserError(
            "SNOWSPLAT_THREADS={asked!r} is not a number of threads; use 1 or more", asked=asked
        )
    return int(asked)
