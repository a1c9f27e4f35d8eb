"""Runs kernels on a GPU through its driver. Memory and streams are those of torch.

A launch takes a few microseconds in Python and does not wait for the GPU.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import threading
from collections.abc import Iterator
from typing import Any

import torch

from snowsplat.ops.cuda import cubins
from snowsplat.ops.cuda.availability import why_unusable
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import LARGEST_STRUCT, Fields, Layout, Mismatch

# Errors of the driver. If the code is for another GPU, the next candidate is tried.
_OUT_OF_MEMORY = 2
_NOT_FOUND = 500
_INCOMPATIBLE_CODE = (200, 209, 218, 222)  # invalid image, no binary, invalid or too new PTX
_OUTDATED = "the built kernels do not match the Python files: rebuild them (make native)"


class _Buffer(threading.local):
    """The memory from which the driver copies the struct during a launch."""

    def __init__(self) -> None:
        self.struct = ctypes.create_string_buffer(LARGEST_STRUCT)
        self._pointer = ctypes.c_void_p(ctypes.addressof(self.struct))
        #: Address of an array with one element: the pointer to the struct.
        self.address = ctypes.addressof(self._pointer)


_buffer = _Buffer()
_gpus: dict[int, _Gpu] = {}
_lock = threading.Lock()


def run(kernel: Kernel, name: str, blocks: int, fields: Fields) -> None:
    """Queues a kernel on torch's current stream of the device of the tensors.

    Raises:
        UserError: the GPU cannot be used, the kernels are outdated, or the driver reports an error.
    """
    buffer = _buffer
    index = next(x for x in fields.values() if isinstance(x, torch.Tensor)).device.index
    gpu = _gpus.get(index) or _gpu(index)
    try:
        function, layout = gpu.functions.get(name) or gpu.load(kernel, name)
        layout.pack_into(buffer.struct, name, fields)
    except Mismatch:
        raise UserError(
            "cuda:{index}: {name}: {outdated}", index=index, name=name, outdated=_OUTDATED
        ) from None
    # torch.cuda.current_stream takes longer than the launch.
    stream = torch._C._cuda_getCurrentRawStream(index)
    cuda = gpu.cuda
    launch = (function, blocks, 1, 1, kernel.threads, 1, 1, 0, stream, buffer.address, 0)
    # The threads that torch creates for backward passes initially have no context.
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
    # Imported when it is needed, because it may be missing on a machine without a GPU.
    return importlib.import_module("cuda.bindings.driver")


class _Gpu:
    """A device and the kernels that are loaded on it."""

    def __init__(self, index: int) -> None:
        why = why_unusable(index)
        if why is not None:
            raise UserError("cuda:{index}: {why}", index=index, why=why)
        self.cuda = _bindings()
        self._index = index
        self._capability = torch.cuda.get_device_capability(index)
        self._check(self.cuda.cuInit(0))
        self._version = self._check(self.cuda.cuDriverGetVersion())
        # The primary context, which torch also uses.
        device = self._check(self.cuda.cuDeviceGet(index))
        self._context = self._check(self.cuda.cuDevicePrimaryCtxRetain(device))
        self.context = int(self._context)
        #: By name: the function of the driver, and the layout of its struct.
        self.functions: dict[str, tuple[Any, Layout]] = {}
        self._libraries: dict[str, Any] = {}
        self._loading = threading.Lock()

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Within the block, calls of this thread use this device."""
        self._check(self.cuda.cuCtxPushCurrent(self._context))
        try:
            yield
        finally:
            self._check(self.cuda.cuCtxPopCurrent())

    def load(self, kernel: Kernel, name: str) -> tuple[Any, Layout]:
        """Loads the function `name` on this device, and stores it in `functions`.

        Raises: Mismatch: it was built for other constants, or by an older version.
        """
        with self._loading, self.current():
            if name not in self.functions:
                if kernel.file in self._libraries:
                    error, function = self._function(self._libraries[kernel.file], name)
                else:
                    error, function = self._first_function(kernel.file, name)
                if error != 0:
                    self.fail(error, name)
                self.functions[name] = function, self._layout(kernel, name)
            return self.functions[name]

    def _layout(self, kernel: Kernel, name: str) -> Layout:
        """The layout of the struct that the kernel takes, which is in the code beside it."""
        library = self._libraries[kernel.file]
        error, address, size = self.cuda.cuLibraryGetGlobal(library, f"{name}_fields".encode())
        if error == _NOT_FOUND:
            raise Mismatch(name)
        found = bytearray(size)
        if error == 0:
            (error,) = self.cuda.cuMemcpyDtoH(found, address, size)
        if error != 0:
            self.fail(error, name)
        return Layout(found.partition(b"\0")[0].decode())

    def _first_function(self, file: str, name: str) -> tuple[int, Any]:
        error, function = 0, None
        for code in cubins.candidates(file, self._capability, self._version // 1000):
            error, library = self.cuda.cuLibraryLoadData(code, None, None, 0, None, None, 0)
            if error == 0:
                # The driver may reject code for another GPU only at this point.
                error, function = self._function(library, name)
            if error not in _INCOMPATIBLE_CODE:
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
        """Raises UserError with the driver's error in one line."""
        name_of, text_of = self.cuda.cuGetErrorName(error), self.cuda.cuGetErrorString(error)
        known = name_of[0] == 0 and text_of[0] == 0
        text = f"{name_of[1].decode()}, {text_of[1].decode()}" if known else f"error {int(error)}"
        if error == _NOT_FOUND:
            remedy = _OUTDATED
        elif error == _OUT_OF_MEMORY:
            remedy = "close other programs that use the GPU, or make the scene smaller"
        else:
            remedy = "update the NVIDIA driver, or use device cpu"
        raise UserError(
            "cuda:{index}: {name}{what}{text}; {remedy}",
            index=self._index,
            name=name,
            what=": " if name else "",
            text=text,
            remedy=remedy,
        )
