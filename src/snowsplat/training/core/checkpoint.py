"""Checkpoints: the complete state of a training run, from which it continues as if uninterrupted.

A checkpoint is a set of named tensors (parameters, optimiser moments, random states, statistics,
the order of the views) and a JSON value in one safetensors file, a format that contains only
numbers and cannot execute code. The file appears under its name only when it is complete and on
disk. So if the process is killed at any moment, the previous checkpoint is intact. When a file is
loaded, checksums are verified to detect damaged or truncated files; see `checkpoint_file`.
"""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from snowsplat.training.core import checkpoint_file
from snowsplat.training.step.finite import check_finite
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

_NAME = re.compile(r"step_(\d+)\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """The verified content of a file: ``tensors`` on the CPU, ``meta`` as passed to `save`."""

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
    checkpoint_file.write(path, step, arrays, meta)
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

    Raises: UserError: the file is missing, truncated, damaged, not finite, not a checkpoint, or has
    another version.
    """
    path = Path(path)
    try:
        return _read(path)
    except OSError as error:
        raise UserError(
            "{path}: cannot be read ({strerror})", path=path, strerror=error.strerror or error
        ) from None


def latest(folder: Path | str) -> Checkpoint | None:
    """The newest valid checkpoint of ``folder``, or None. Warns about each newer, damaged one.

    Raises: UserError: a file cannot be read (permissions, open files); it may be valid.
    """
    for _, path in files(folder):
        try:
            return _read(path)
        except UserError as error:
            warnings.warn(f"{error}; using the previous one", stacklevel=2)
        except OSError as error:
            raise UserError(
                "{path}: cannot be read ({strerror})", path=path, strerror=error.strerror or error
            ) from None
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
    file = checkpoint_file.read(path)
    tensors = {name: torch.from_numpy(array) for name, array in file.arrays.items()}
    return Checkpoint(path, file.step, tensors, file.meta)
