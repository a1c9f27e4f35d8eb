"""Checkpoints: the complete state of a training run, from which it continues as if uninterrupted.

A checkpoint is a set of named tensors (parameters, optimiser moments, random states, statistics,
the order of the views) and a JSON value in one safetensors file, a format that contains only
numbers and cannot execute code. The file appears under its name only when it is complete and on
disk. So if the process is killed at any moment, the previous checkpoint is intact.

The header contains the CRC-32, the dtype and the shape of each array, and the CRC-32 of the header
itself. `load` verifies all of them. This module does not import torch, so that a program that
inspects a file does not wait for it.
"""

from __future__ import annotations

import json
import os
import re
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors
import safetensors.numpy

from snowsplat.training.step.finite import check_finite, rows_text
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path, reading
from snowsplat.util.messages import message
from snowsplat.util.safe_json import check_header, parse_json

if TYPE_CHECKING:
    from torch import Tensor

#: Incremented when the meaning of the arrays changes: files of another version are rejected.
VERSION = 1
_HEADER = "snowsplat"
_NAME = re.compile(r"step_(\d+)\.safetensors")


class InvalidCheckpoint(UserError):
    """The content of a file is not that of a checkpoint of this version, or damaged."""


@dataclass(frozen=True)
class Checkpoint:
    """The verified content of a file: ``arrays`` are finite, ``meta`` is as passed to `save`."""

    path: Path
    step: int
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The arrays as tensors on the CPU, which share their memory."""
        import torch

        return {name: torch.from_numpy(array) for name, array in self.arrays.items()}


def save(
    folder: Path | str,
    step: int,
    tensors: Mapping[str, Tensor],
    meta: Mapping[str, Any],
    *,
    keep: int = 2,
) -> Path:
    """Write ``folder/step_000500.safetensors`` atomically, then call `remove_old`.

    Args:
        tensors: of any shape, including 0-dimensional and empty tensors; of dtypes that NumPy has.
        meta: JSON values.

    Raises:
        UserError: the state is not finite.
        OSError: the folder is not writable, or the disk is full.

    Older checkpoints are unchanged after an error.
    """
    check_finite(
        message("the state of step {step}", step=step),
        tensors,
        message("older checkpoints are unchanged"),
    )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step_{step:06d}.safetensors"
    # The arrays must be contiguous, because safetensors ignores strides.
    arrays = {name: t.detach().cpu().contiguous().numpy() for name, t in tensors.items()}
    header = {
        "version": VERSION,
        "step": step,
        "meta": dict(meta),
        "crc32": {name: _crc32(array) for name, array in arrays.items()},
        "layout": _layout(arrays),
    }
    text = json.dumps(header)
    metadata = {_HEADER: text, "crc32": str(zlib.crc32(text.encode()))}
    with atomic_path(path) as temporary:
        try:
            safetensors.numpy.save_file(arrays, temporary, metadata=metadata)
        except safetensors.SafetensorError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise OSError(f"{path}: cannot be written ({error})") from None
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from None
    remove_old(folder, step, keep=keep)
    return path


def remove_old(folder: Path | str, step: int, *, keep: int = 2) -> None:
    """Remove all but the ``keep`` newest checkpoints up to ``step``, and temporary files.

    Checkpoints of later steps are not removed. They exist if training resumed from ``step`` because
    they were damaged. Temporary files remain if a process was killed while it saved.
    """
    folder = Path(folder)
    for leftover in folder.glob(".*tmp*"):
        leftover.unlink(missing_ok=True)
    for _, old in [file for file in files(folder) if file[0] <= step][keep:]:
        old.unlink(missing_ok=True)


def load(path: Path | str) -> Checkpoint:
    """Read a checkpoint and verify its checksums.

    Raises:
        InvalidCheckpoint: the file is truncated, damaged, not finite, not a checkpoint, or has
            another version.
        UserError: the file is missing or cannot be read; it may be valid.
    """
    path = Path(path)
    try:
        with reading(path):
            check_header(path)
            with safetensors.safe_open(path, framework="np") as file:
                metadata = file.metadata() or {}
                text = metadata[_HEADER].encode("utf-8", "replace")
                header = parse_json(text)
                if header["version"] != VERSION:
                    raise InvalidCheckpoint(
                        "{path}: checkpoint of version {header}, this program reads version "
                        "{version}; resume with the snowsplat that wrote it",
                        path=path,
                        header=header["version"],
                        version=VERSION,
                    )
                names = file.keys()
                arrays = {name: file.get_tensor(name) for name in names}
        intact = header["crc32"] == {name: _crc32(array) for name, array in arrays.items()}
        intact = intact and header["layout"] == _layout(arrays)
        intact = intact and metadata["crc32"] == str(zlib.crc32(text))
        if not isinstance(header["meta"], dict):
            raise ValueError("meta is not an object")
        content = Checkpoint(path, int(header["step"]), arrays, header["meta"])
    except (
        safetensors.SafetensorError,
        AttributeError,  # a dtype that NumPy does not have, for example floats of one byte
        KeyError,
        TypeError,
        ValueError,
        OverflowError,
    ):
        raise InvalidCheckpoint(
            "{path}: not a checkpoint, or damaged; use another one", path=path
        ) from None
    if not intact:
        raise InvalidCheckpoint(
            "{path}: damaged, checksums do not match; use another one", path=path
        )
    if found := _rows_not_finite(arrays):
        raise InvalidCheckpoint(
            "{path}: non-finite values in {listed}; remove it and resume from an earlier one",
            path=path,
            listed=rows_text(found),
        )
    return content


def latest(folder: Path | str) -> Checkpoint | None:
    """The newest valid checkpoint of ``folder``, or None. Warns about each newer, damaged one.

    Raises: UserError: a file cannot be read (permissions, open files); it may be valid.
    """
    for _, path in files(folder):
        try:
            return load(path)
        except InvalidCheckpoint as error:
            warnings.warn(f"{error}; using the previous one", stacklevel=2)
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


def _layout(arrays: Mapping[str, np.ndarray]) -> dict[str, list[Any]]:
    """Name → dtype and shape. Dtypes have the names of torch."""
    return {name: [f"torch.{array.dtype}", list(array.shape)] for name, array in arrays.items()}


def _crc32(array: np.ndarray) -> int:
    return zlib.crc32(array.reshape(-1).view(np.uint8).data)


def _rows_not_finite(arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """As `finite.rows_not_finite`, which takes tensors."""
    found: dict[str, int] = {}
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            rows = array.reshape(len(array) if array.ndim else 1, -1)
            found[name] = int((~np.isfinite(rows)).any(axis=1).sum())
    return found
