"""Which device to compute on."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch

from snowsplat.ops.cuda import availability
from snowsplat.util.errors import UserError


def default_device(note: Callable[[str], None] | None = None) -> torch.device:
    """The GPU, or the CPU where there is none of use.

    Args:
        note: is given a line where there is a GPU that cannot be used.
    """
    index = _current_index()
    why = availability.why_unusable(index)
    if why is None:
        return torch.device("cuda", index)
    if note is not None and availability.gpu_there():
        note(f"the GPU cannot be used: {why}; computing on the CPU")
    return torch.device("cpu")


def resolve_device(
    text: str | None = None, note: Callable[[str], None] | None = None
) -> torch.device:
    """The device that a user means: "cpu", "cuda", "cuda:1"; with None, the best there is.

    The environment variable SNOWSPLAT_DEVICE stands for a missing `text`.

    Args:
        note: is given a line where there is a GPU that cannot be used, and none was asked for.

    Raises:
        UserError: a device that is not there, or cannot be used.
    """
    asked, otherwise = f"--device {text}", "leave --device out to use the CPU"
    if text is None:
        text = os.environ.get("SNOWSPLAT_DEVICE", "")
        if not text:
            return default_device(note)
        asked, otherwise = f"SNOWSPLAT_DEVICE={text}", "set it to cpu to use the CPU"
    try:
        device = torch.device(text)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise UserError(f"{asked}: this is no device for us; use cpu, cuda or cuda:1")
    if device.type == "cpu":
        return torch.device("cpu")
    index = _current_index() if device.index is None else device.index
    why = availability.why_unusable(index)
    if why is not None:
        raise UserError(f"{asked}: {why}; {otherwise}")
    return torch.device("cuda", index)


def _current_index() -> int:
    """What "cuda" means to torch; asking torch for it would start the driver."""
    return torch.cuda.current_device() if torch.cuda.is_initialized() else 0
