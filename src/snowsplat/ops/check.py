"""Argument checks of the public ops. Error messages are one line."""

import torch
from torch import Tensor

FLOATS = (torch.float32, torch.float64)


def check_tensor(
    op: str, name: str, tensor: Tensor, shape: tuple[int | None, ...], like: Tensor
) -> None:
    """Raises ValueError unless `tensor` has `shape` (None: any), and dtype and device of `like`."""
    if len(tensor.shape) != len(shape) or any(
        want not in (None, got) for want, got in zip(shape, tensor.shape, strict=True)
    ):
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"{op}: {name} must be ({wanted}), got {tuple(tensor.shape)}")
    if tensor.dtype != like.dtype:
        raise ValueError(f"{op}: {name} must be {like.dtype}, got {tensor.dtype}")
    if tensor.device != like.device:
        raise ValueError(f"{op}: {name} must be on {like.device}, got {tensor.device}")


def check_ids(op: str, ids: Tensor, like: Tensor) -> None:
    """Raises ValueError unless `ids` is int32, on the device of `like`."""
    if ids.dtype != torch.int32 or ids.device != like.device:
        raise ValueError(
            f"{op}: ids must be torch.int32 on {like.device}, got {ids.dtype} on {ids.device}"
        )


def check_float(op: str, name: str, tensor: Tensor) -> None:
    if tensor.dtype not in FLOATS:
        raise ValueError(f"{op}: {name} must be float32 or float64, got {tensor.dtype}")


def check_size(op: str, width: int, height: int) -> None:
    if not (isinstance(width, int) and isinstance(height, int)):
        raise ValueError(f"{op}: width and height must be int, got {width!r} and {height!r}")
    if width < 1 or height < 1:
        raise ValueError(f"{op}: the image must be at least 1×1, got {width}×{height}")


def variant(name: str, tensor: Tensor) -> str:
    """The name of the native entry for the dtype of `tensor`."""
    return name if tensor.dtype == torch.float32 else name + "_f64"
