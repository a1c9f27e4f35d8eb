"""Checkpoints: everything that a training needs to go on as if it had never stopped.

A checkpoint is a set of named tensors (parameters, optimiser moments, random states, statistics,
the order of the views) and a JSON value, in ONE safetensors file: a format that holds numbers only
and cannot execute code. It appears under its name when it is whole and on disk, so a kill at any
moment leaves the one before. Each tensor's CRC-32 is in the header, which has one of its own, and
all are checked on load, as a file can also rot or be cut in a copy.
"""

import json
import os
import re
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from snowsplat.training.finite import check_finite
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.safe_json import check_header, parse_json

#: One more whenever the meaning of the tensors changes, so that an old file is refused.
VERSION = 1
_HEADER = "snowsplat"
_NAME = re.compile(r"step_(\d+)\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """What `save` was given, back from disk and checked."""

    path: Path
    step: int
    tensors: dict[str, Tensor]  # on the CPU
    meta: dict[str, Any]


def save(
    folder: Path | str,
    step: int,
    tensors: Mapping[str, Tensor],
    meta: Mapping[str, Any],
    *,
    keep: int = 2,
) -> Path:
    """Write ``folder/step_000500.safetensors`` atomically, then `remove_old`.

    Args:
        tensors: any shapes and dtypes, 0-dimensional and empty ones too.
        meta: JSON values.

    Raises:
        UserError: a state that is not finite. Older checkpoints are as they were.
        OSError: the folder is not writable, or the disk is full. Older checkpoints are as they
        were.
    """
    check_finite(f"the state of step {step}", tensors, "older checkpoints are unchanged")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step_{step:06d}.safetensors"
    whole = {name: _owned(tensor) for name, tensor in tensors.items()}
    header = {
        "version": VERSION,
        "step": step,
        "meta": dict(meta),
        "crc32": {name: _crc32(tensor) for name, tensor in whole.items()},
        "layout": _layout(whole),
    }
    text = json.dumps(header)
    metadata = {_HEADER: text, "crc32": str(zlib.crc32(text.encode()))}
    with atomic_path(path) as temporary:
        try:
            safetensors.torch.save_file(whole, temporary, metadata=metadata)
        except safetensors.SafetensorError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise OSError(f"{path}: cannot be written ({error})") from None
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from None
    remove_old(folder, step, keep=keep)
    return path


def remove_old(folder: Path | str, step: int, *, keep: int = 2) -> None:
    """Remove the checkpoints before the ``keep`` newest up to ``step``, and what killed saves left.

    Newer ones stay: a training goes on from ``step`` where it found those damaged.
    """
    folder = Path(folder)
    for leftover in folder.glob(".*tmp*"):
        leftover.unlink(missing_ok=True)
    for _, old in [file for file in files(folder) if file[0] <= step][keep:]:
        old.unlink(missing_ok=True)


def load(path: Path | str) -> Checkpoint:
    """Read one checkpoint and check every byte of it.

    Raises:
        UserError: absent, cut, damaged, not finite, not a checkpoint, or one of another version.
    """
    path = Path(path)
    try:
        return _read(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None


def latest(folder: Path | str) -> Checkpoint | None:
    """The newest whole checkpoint of ``folder``, or None; a warning for each newer, damaged one.

    Raises:
        UserError: one that cannot be read, which may be whole.
    """
    for _, path in files(folder):
        try:
            return _read(path)
        except UserError as error:
            warnings.warn(f"{error}; using the one before it", stacklevel=2)
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    return None


def exists(folder: Path | str) -> bool:
    """Whether ``folder`` holds a checkpoint, whole or not."""
    return bool(files(folder))


def files(folder: Path | str) -> list[tuple[int, Path]]:
    """Steps and files of the checkpoints of ``folder``, newest first."""
    folder = Path(folder)
    if not folder.is_dir():
        return []
    found = [
        (int(match[1]), path) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))
    ]
    return sorted(found, reverse=True)


def _read(path: Path) -> Checkpoint:
    """Raises: OSError: it cannot be read. UserError: what can be read is no whole checkpoint."""
    try:
        check_header(path)
        with safetensors.safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
            text = metadata[_HEADER].encode("utf-8", "replace")
            header = parse_json(text)
            if header["version"] != VERSION:
                raise UserError(
                    f"{path}: a checkpoint of version {header['version']}, this program reads "
                    f"{VERSION}; go on with the snowsplat that wrote it"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        whole = header["crc32"] == {name: _crc32(tensor) for name, tensor in tensors.items()}
        # Not in older files, where a damaged header may go unseen.
        whole = whole and header.get("layout", _layout(tensors)) == _layout(tensors)
        whole = whole and metadata.get("crc32", str(zlib.crc32(text))) == str(zlib.crc32(text))
        if not isinstance(header["meta"], dict):
            raise ValueError("no names")
        # Floats of a byte, which nothing here writes and torch hardly reckons with.
        if any(t.is_floating_point() and t.itemsize < 2 for t in tensors.values()):
            raise ValueError("tensors of another program")
        checkpoint = Checkpoint(path, int(header["step"]), tensors, header["meta"])
    except RuntimeError as error:  # as torch says what the system said
        number = re.search(r"\((\d+)\)$", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from None
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError, OverflowError):
        raise UserError(f"{path}: damaged, or not a checkpoint") from None
    if not whole:
        raise UserError(f"{path}: damaged (its checksums do not match)")
    check_finite(str(path), checkpoint.tensors, "remove it, and go on from an earlier one")
    return checkpoint


def _owned(tensor: Tensor) -> Tensor:
    """On the CPU, contiguous, alone in its storage: safetensors refuses views that share one."""
    tensor = tensor.detach().cpu().contiguous()
    alone = tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
    return tensor if alone else tensor.clone()


def _layout(tensors: Mapping[str, Tensor]) -> dict[str, list[Any]]:
    return {name: [str(tensor.dtype), list(tensor.shape)] for name, tensor in tensors.items()}


def _crc32(tensor: Tensor) -> int:
    flat = (
        tensor.reshape(-1).view(torch.uint8)
        if tensor.numel()
        else torch.empty(0, dtype=torch.uint8)
    )
    return zlib.crc32(flat.numpy().data)
