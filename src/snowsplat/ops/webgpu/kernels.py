"""`run`: queues a kernel of `native/wgsl` on the device."""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

from snowsplat.ops.webgpu.adapter import ALIGNMENT, STORAGE_BUFFERS, gpu
from snowsplat.ops.webgpu.memory import Memory
from snowsplat.ops.webgpu.shaders import Shader, read, shader
from snowsplat.ops.webgpu.tensor import DeviceTensor
from snowsplat.util.errors import UserError

_MOST_GROUPS = 65535  # in a dimension
_FORMATS = {"f32": "f", "i32": "i", "u32": "I"}


def run(file: str, entry: str, groups: int, fields: Mapping[str, Any]) -> None:
    """Queue a kernel; `adapter.Gpu.submit` starts it.

    Args:
        file, entry: a kernel in ``native/wgsl/<file>.wgsl``.
        groups: the number of work groups; those of more than 65535 are spread over two dimensions.
        fields: the tensors and numbers by the names of the variables in WGSL. Tensors that are
            missing are null, and numbers 0; more than the kernel has are ignored.

    Raises:
        UserError: a tensor is larger than the adapter allows.
    """
    _run(_pipeline(file, entry), shader(file), entry, groups, fields)


def run_text(text: str, entry: str, groups: int, fields: Mapping[str, Any]) -> None:
    """`run` for a kernel whose text is given."""
    _run(_pipeline_of(text, entry), _shader_of(text), entry, groups, fields)


_shader_of = functools.cache(read)


def _run(pipeline: Any, code: Shader, entry: str, groups: int, fields: Mapping[str, Any]) -> None:
    if groups <= 0:
        return
    names, has_numbers = code.entries[entry]
    offsets: dict[str, int] = {}
    bound: list[dict[str, Any]] = []
    written: list[Memory] = []
    copies: list[tuple[_Copied, bool]] = []
    device = gpu()
    with device.lock:
        for name in names:
            binding, tensor = code.bindings[name], fields.get(name)
            if tensor is None or tensor.numel() == 0:
                resource = {"buffer": _nothing(entry, name)}
            else:
                resource, offsets[name], copied = _range(entry, name, tensor, code)
                if binding.written:
                    written.append(tensor.memory)
                if copied is not None:  # kept until the kernel is recorded
                    copies.append((copied, binding.written))
            bound.append({"binding": binding.index, "resource": resource})
        if has_numbers:
            numbers = [_number(name, kind, fields, offsets) for name, kind in code.numbers]
            packed = struct.pack(
                "<" + "".join(_FORMATS[kind] for _, kind in code.numbers), *numbers
            )
            bound.append({"binding": code.uniform, "resource": device.uniform(packed)})
        group = device.device.create_bind_group(
            layout=pipeline.get_bind_group_layout(0), entries=bound
        )
        across = min(groups, _MOST_GROUPS)
        work = device.encoder().begin_compute_pass()
        work.set_pipeline(pipeline)
        work.set_bind_group(0, group)
        work.dispatch_workgroups(across, -(-groups // across), 1)
        work.end()
        for copied, is_written in copies:
            if is_written:
                copied.copy_back()
        for memory in written:
            memory.changed_on_device()


def _range(
    entry: str, name: str, tensor: DeviceTensor, code: Shader
) -> tuple[dict[str, Any], int, _Copied | None]:
    """The part of a buffer with the elements of a tensor, and the offset in it, in words.

    A tensor that begins at an address that no binding can have is copied, if the kernel has no
    offset for it.
    """
    begin, end = tensor.byte_range
    buffer = tensor.memory.buffer()
    first = begin // ALIGNMENT * ALIGNMENT
    size = -(-(end - first) // 4) * 4
    if size > gpu().largest:
        raise UserError(
            "webgpu: {name} of {entry} has {size} bytes, and this adapter allows {largest}",
            name=name,
            entry=entry,
            size=size,
            largest=gpu().largest,
        )
    if first == begin or (f"{name}_offset", "u32") in code.numbers:
        return {"buffer": buffer, "offset": first, "size": size}, (begin - first) // 4, None
    size = -(-(end - begin) // 4) * 4
    copied = _Copied(buffer, begin, Memory(size), size)
    gpu().encoder().copy_buffer_to_buffer(buffer, begin, copied.memory.buffer(), 0, size)
    return {"buffer": copied.memory.buffer(), "offset": 0, "size": size}, 0, copied


class _Copied(NamedTuple):
    """The copy of a part of a buffer."""

    buffer: Any
    begin: int
    memory: Memory
    size: int

    def copy_back(self) -> None:
        own = self.memory.buffer()
        gpu().encoder().copy_buffer_to_buffer(own, 0, self.buffer, self.begin, self.size)


def _number(name: str, kind: str, fields: Mapping[str, Any], offsets: dict[str, int]) -> Any:
    if name.endswith("_offset"):
        return offsets.get(name[:-7], 0)
    if name.startswith("has_") and name not in fields:
        return int(fields.get(name[4:]) is not None)
    value = fields.get(name, 0)  # the numbers are those of all kernels of a file
    if kind == "f32":
        return float(value)
    return int(value) & 0xFFFFFFFF if kind == "u32" else int(value)


@functools.cache
def _nothing(entry: str, name: str) -> Any:
    """A buffer for a tensor that is null: each has its own, as none may be bound twice."""
    return gpu().buffer(16)


@functools.cache
def _pipeline(file: str, entry: str) -> Any:
    return _compiled(_module(file), shader(file), entry)


@functools.cache
def _pipeline_of(text: str, entry: str) -> Any:
    module = gpu().device.create_shader_module(code=text)
    return _compiled(module, _shader_of(text), entry)


@functools.cache
def _module(file: str) -> Any:
    return gpu().device.create_shader_module(code=shader(file).text)


def _compiled(module: Any, code: Shader, entry: str) -> Any:
    assert len(code.entries[entry][0]) <= STORAGE_BUFFERS, entry
    return gpu().device.create_compute_pipeline(
        layout="auto", compute={"module": module, "entry_point": entry}
    )
