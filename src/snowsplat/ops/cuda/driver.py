"""Runs kernels on a GPU, through its driver: torch has the memory and the streams, we the kernels.

Launching costs microseconds of Python and waits for nothing.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import struct
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from snowsplat.ops.cuda import cubins
from snowsplat.ops.cuda.availability import why_unusable
from snowsplat.ops.cuda.kernels import Argument, Kernel
from snowsplat.util.errors import UserError

# Of the driver. What is no code for this card may be followed by what is.
_OUT_OF_MEMORY = 2
_NOT_FOUND = 500
_NO_CODE_FOR_IT = (200, 209, 218, 222)  # invalid image, no binary, invalid PTX, too new a PTX

_MOST_PARAMETERS = 128


class _Parameters(threading.local):
    """Where the driver reads a launch's arguments, each in 8 bytes; it is done when it returns."""

    def __init__(self) -> None:
        self.values = ctypes.create_string_buffer(8 * _MOST_PARAMETERS)
        first = ctypes.addressof(self.values)
        self._pointers = (ctypes.c_void_p * _MOST_PARAMETERS)(
            *range(first, first + 8 * _MOST_PARAMETERS, 8)
        )
        self.address = ctypes.addressof(self._pointers)


_parameters = _Parameters()
_gpus: dict[int, _Gpu] = {}
_lock = threading.Lock()


def run(kernel: Kernel, name: str, blocks: int, args: Sequence[Argument]) -> None:
    """Queue a kernel on torch's current stream of the device that has the tensors.

    Raises:
        UserError: the GPU cannot be used, or the driver refuses.
    """
    index, kinds = -1, "="
    values: list[int | float] = []
    for arg in args:
        if isinstance(arg, torch.Tensor):
            kinds += "Q"
            values.append(arg.data_ptr())
            if index < 0:
                index = arg.device.index
        elif arg is None:
            kinds += "Q"
            values.append(0)
        else:
            kinds += "q" if isinstance(arg, int) else "d"
            values.append(arg)
    gpu = _gpus.get(index) or _gpu(index)
    function = gpu.functions.get(name) or gpu.load(kernel, name)
    parameters = _parameters
    struct.pack_into(kinds, parameters.values, 0, *values)
    stream = torch.cuda.current_stream(index).cuda_stream
    cuda = gpu.cuda
    launch = (function, blocks, 1, 1, kernel.threads, 1, 1, 0, stream, parameters.address, 0)
    # Threads that torch makes, for backward passes, begin without a context.
    if int(cuda.cuCtxGetCurrent()[1]) == gpu.context:
        (error,) = cuda.cuLaunchKernel(*launch)
    else:
        with gpu.current():
            (error,) = cuda.cuLaunchKernel(*launch)
    if error != 0:
        gpu.fail(error, name)


def _gpu(index: int) -> _Gpu:
    with _lock:
        if index not in _gpus:
            _gpus[index] = _Gpu(index)
        return _gpus[index]


@functools.cache
def _bindings() -> Any:
    # Only now: who computes on a CPU need not have it.
    return importlib.import_module("cuda.bindings.driver")


class _Gpu:
    """A device and the kernels that are loaded on it."""

    def __init__(self, index: int) -> None:
        why = why_unusable(index)
        if why is not None:
            raise UserError(f"cuda:{index}: {why}")
        self.cuda = _bindings()
        self._index = index
        self._capability = torch.cuda.get_device_capability(index)
        self._check(self.cuda.cuInit(0))
        self._version = self._check(self.cuda.cuDriverGetVersion())
        # The context that torch uses, too.
        device = self._check(self.cuda.cuDeviceGet(index))
        self._context = self._check(self.cuda.cuDevicePrimaryCtxRetain(device))
        self.context = int(self._context)
        self.functions: dict[str, Any] = {}
        self._libraries: dict[str, Any] = {}
        self._loading = threading.Lock()

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """In the block, this thread's calls go to this device."""
        self._check(self.cuda.cuCtxPushCurrent(self._context))
        try:
            yield
        finally:
            self._check(self.cuda.cuCtxPopCurrent())

    def load(self, kernel: Kernel, name: str) -> Any:
        """The function `name` on this device, to be had from `functions` from now on."""
        with self._loading, self.current():
            if name not in self.functions:
                if kernel.file in self._libraries:
                    error, function = self._function(self._libraries[kernel.file], name)
                else:
                    error, function = self._first_function(kernel.file, name)
                if error != 0:
                    self.fail(error, name)
                self.functions[name] = function
            return self.functions[name]

    def _first_function(self, file: str, name: str) -> tuple[int, Any]:
        error, function = 0, None
        for code in cubins.candidates(file, self._capability, self._version // 1000):
            error, library = self.cuda.cuLibraryLoadData(code, None, None, 0, None, None, 0)
            if error == 0:
                # Code for another card may be noticed only here.
                error, function = self._function(library, name)
            if error not in _NO_CODE_FOR_IT:
                if error == 0:
                    self._libraries[file] = library
                break
        return error, function

    def _function(self, library: Any, name: str) -> tuple[int, Any]:
        error, kernel = self.cuda.cuLibraryGetKernel(library, name.encode())
        if error != 0:
            return error, None
        error, function = self.cuda.cuKernelGetFunction(kernel)
        return error, function

    def _check(self, result: tuple[Any, ...]) -> Any:
        if result[0] != 0:
            self.fail(result[0], "")
        return result[1] if len(result) > 1 else None

    def fail(self, error: Any, name: str) -> None:
        """Raises: UserError: always; a line about an error of the driver."""
        said, what = self.cuda.cuGetErrorName(error), self.cuda.cuGetErrorString(error)
        known = said[0] == 0 and what[0] == 0
        text = f"{said[1].decode()}, {what[1].decode()}" if known else f"error {int(error)}"
        if error == _NOT_FOUND:
            do = "the built kernels are older than the Python files: rebuild them (make native)"
        elif error == _OUT_OF_MEMORY:
            do = "close other programs that use the GPU, or make the scene smaller"
        else:
            do = "update the NVIDIA driver, or use device cpu"
        raise UserError(f"cuda:{self._index}: {name}{': ' if name else ''}{text}; {do}")
