"""Checkpoints: the complete state of a training, from which it resumes with a bit-identical result.

A checkpoint is a set of named tensors (parameters, optimiser moments, random states, statistics,
the order of the views) and a JSON value in one safetensors file, a format that contains only
numbers and cannot execute code. The file appears under its name only when it is complete and on
disk, so a kill at any moment leaves the previous one. The header contains the CRC-32 of each tensor
and of itself. All are checked when a file is loaded, to detect damaged or truncated files.
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

#: Incremented when the meaning of the tensors changes: files of another version are rejected.
VERSION = 1
_HEADER = "snowsplat"
_NAME = re.compile(r"step_(\d+)\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """The content of a file, checked: ``tensors`` on the CPU, ``meta`` as passed to `save`."""

    path: Path
    step: int
    tensors: dict[str, Tensor]
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
        UserError: the state is not finite.
        OSError: the folder is not writable, or the disk is full.

    Older checkpoints are unchanged after an error.
    """
    check_finite(f"the state of step {step}", tensors, "older checkpoints are unchanged")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step_{step:06d}.safetensors"
    stored = {name: _owned(tensor) for name, tensor in tensors.items()}
    header = {
        "version": VERSION,
        "step": step,
        "meta": dict(meta),
        "crc32": {name: _crc32(tensor) for name, tensor in stored.items()},
        "layout": _layout(stored),
    }
    text = json.dumps(header)
    metadata = {_HEADER: text, "crc32": str(zlib.crc32(text.encode()))}
    with atomic_path(path) as temporary:
        try:
            safetensors.torch.save_file(stored, temporary, metadata=metadata)
        except safetensors.SafetensorError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise OSError(f"{path}: cannot be written ({error})") from None
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from None
    remove_old(folder, step, keep=keep)
    return path


def remove_old(folder: Path | str, step: int, *, keep: int = 2) -> None:
    """Remove all but the ``keep`` newest checkpoints up to ``step``, and files of killed saves.

    Newer ones are kept: they are damaged if a training resumes from ``step``.
    """
    folder = Path(folder)
    for leftover in folder.glob(".*tmp*"):
        leftover.unlink(missing_ok=True)
    for _, old in [file for file in files(folder) if file[0] <= step][keep:]:
        old.unlink(missing_ok=True)


def load(path: Path | str) -> Checkpoint:
    """Read a checkpoint and verify its checksums.

    Raises:
        UserError: the file is missing, truncated, damaged, not finite, not a checkpoint, or has
            another version.
    """
    path = Path(path)
    try:
        return _read(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None


def latest(folder: Path | str) -> Checkpoint | None:
    """The newest valid checkpoint of ``folder``, or None; warns of each newer, damaged one.

    Raises:
        UserError: a file cannot be read (permissions, open files); it may be valid.
    """
    for _, path in files(folder):
        try:
            return _read(path)
        except UserError as error:
            warnings.warn(f"{error}; using the previous one", stacklevel=2)
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    return None


def exists(folder: Path | str) -> bool:
    """Whether ``folder`` contains a checkpoint, valid or damaged."""
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
    """Raises OSError if the file cannot be read, UserError if its content is not valid."""
    try:
        check_header(path)
        with safetensors.safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
            text = metadata[_HEADER].encode("utf-8", "replace")
            header = parse_json(text)
            if header["version"] != VERSION:
                raise UserError(
                    f"{path}: checkpoint of version {header['version']}, this program reads "
                    f"version {VERSION}; resume with the snowsplat that wrote it"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        intact = header["crc32"] == {name: _crc32(tensor) for name, tensor in tensors.items()}
        # Older files lack the next two, and may have an undetected error in the header.
        intact = intact and header.get("layout", _layout(tensors)) == _layout(tensors)
        intact = intact and metadata.get("crc32", str(zlib.crc32(text))) == str(zlib.crc32(text))
        if not isinstance(header["meta"], dict):
            raise ValueError("meta is not an object")
        # Floats of one byte are never written here, and torch supports few operations on them.
        if any(t.is_floating_point() and t.itemsize < 2 for t in tensors.values()):
            raise ValueError("unsupported dtype")
        checkpoint = Checkpoint(path, int(header["step"]), tensors, header["meta"])
    except RuntimeError as error:  # torch wraps an error of the operating system
        number = re.search(r"\((\d+)\)$", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from None
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError, OverflowError):
        raise UserError(f"{path}: not a checkpoint, or damaged; use another one") from None
    if not intact:
        raise UserError(f"{path}: damaged, checksums do not match; use another one")
    check_finite(str(path), checkpoint.tensors, "remove it and resume from an earlier one")
    return checkpoint


def _owned(tensor: Tensor) -> Tensor:
    """On the CPU, contiguous, in its own storage: safetensors rejects views that share one."""
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
