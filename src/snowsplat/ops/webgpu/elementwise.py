"""Operations of torch on large tensors that a training step needs, as kernels."""

from __future__ import annotations

from typing import Any

import torch

from snowsplat.ops.webgpu import tensor as tensors
from snowsplat.ops.webgpu.adapter import gpu
from snowsplat.ops.webgpu.kernels import run_text
from snowsplat.ops.webgpu.tensor import DEVICE, KERNELS, DeviceTensor

_SMALL = 1 << 14  # bytes of a tensor that the CPU processes as fast
_THREADS = 256

_TEXT = """
struct Params { n: u32, factor: f32, other_count: u32, product: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> first: array<f32>;
@group(0) @binding(2) var<storage, read> other: array<f32>;
@group(0) @binding(3) var<storage, read_write> made: array<f32>;

fn item(group: vec3<u32>, groups: vec3<u32>, thread: u32) -> u32 {
  return (group.y * groups.x + group.x) * 256u + thread;
}

@compute @workgroup_size(256)
fn fill(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i < params.n) { made[i] = params.factor; }
}

@compute @workgroup_size(256)
fn combine(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i >= params.n) { return; }
  let b = other[i % params.other_count];
  made[i] = select(first[i] + params.factor * b, first[i] * b, params.product != 0u);
}
"""


def _is_whole(tensor: Any) -> bool:
    """Whether a kernel can process all elements of a tensor, in the order of its memory."""
    return isinstance(tensor, DeviceTensor) and tensor.is_contiguous()


def _is_large(tensor: Any) -> bool:
    """Whether a float32 tensor is on the device, contiguous, and too large for the CPU."""
    return (
        _is_whole(tensor)
        and tensor.dtype == torch.float32
        and tensor.numel() * 4 > _SMALL
        and tensor.memory.is_on_device
    )


def _run(entry: str, made: DeviceTensor, **fields: Any) -> DeviceTensor:
    count = made.numel()
    groups = -(-count // _THREADS)
    run_text(_TEXT, entry, groups, {"n": count, "made": made, **fields})
    return made


def _filled(target: DeviceTensor, value: Any) -> Any:
    """Sets all elements. NotImplemented for small or strided tensors."""
    if not isinstance(value, (int, float)) or not _is_large(target):
        return NotImplemented
    return _run("fill", target, factor=float(value))


def _zeros(shape: Any, dtype: torch.dtype) -> DeviceTensor:
    made = tensors.empty(shape, dtype)
    made.zero_()
    return made


def _new(fill: Any, strided: bool) -> Any:
    """A factory of tensors like another one, whose values are not read."""

    def make(like: DeviceTensor, *args: Any, **options: Any) -> Any:
        device = options.get("device")
        if device is not None and torch.device(device).type != DEVICE:
            return NotImplemented
        dtype = options.get("dtype") or like.dtype
        if strided and not like.is_contiguous():
            return NotImplemented
        shape = like.shape if strided else args[0]
        if fill is None:
            return tensors.empty(shape, dtype)
        return _zeros(shape, dtype)

    return make


def _combined(first: Any, other: Any, alpha: Any, product: bool) -> Any:
    if not _is_large(first) or isinstance(alpha, torch.Tensor):
        return NotImplemented
    if isinstance(other, (int, float)):
        other = torch.full((1,), float(other), device=first.device)
    if not (_is_whole(other) and other.dtype == torch.float32):
        return NotImplemented
    if other.shape != first.shape and other.numel() != 1:
        return NotImplemented
    if other.dim() > first.dim() or first.memory is other.memory:
        return NotImplemented
    made = tensors.empty(first.shape, first.dtype)
    fields = {"first": first, "other": other, "other_count": max(1, other.numel())}
    return _run("combine", made, factor=float(alpha), product=int(product), **fields)


def _copied(target: Any, source: Any, non_blocking: bool = False) -> Any:
    """`copy_` between contiguous tensors on the device."""
    if not (_is_large(source) and _is_whole(target) and target.dtype == source.dtype):
        return NotImplemented
    if target.shape != source.shape or target.memory is source.memory:
        return NotImplemented
    begin, end = source.byte_range
    with gpu().lock:
        there, here = target.memory.buffer(), source.memory.buffer()
        gpu().encoder().copy_buffer_to_buffer(here, begin, there, target.byte_range[0], end - begin)
        target.memory.changed_on_device()
    return target


def _cloned(source: Any, **options: Any) -> Any:
    if not _is_large(source):
        return NotImplemented
    return _copied(tensors.empty(source.shape, source.dtype), source)


KERNELS |= {
    "zero_.default": lambda target: _filled(target, 0.0),
    "fill_.Scalar": _filled,
    "new_empty.default": _new(None, False),
    "new_zeros.default": _new(0.0, False),
    "empty_like.default": _new(None, True),
    "zeros_like.default": _new(0.0, True),
    "mul.Tensor": lambda first, other: _combined(first, other, 1.0, True),
    "add.Tensor": lambda first, other, *, alpha=1: _combined(first, other, alpha, False),
    "sub.Tensor": lambda first, other, *, alpha=1: _combined(first, other, -alpha, False),
    "copy_.default": _copied,
    "clone.default": _cloned,
}
