"""The file of a checkpoint: NumPy arrays and a JSON value in a safetensors file; without torch.

The header contains the CRC-32, the dtype and the shape of each array, and the CRC-32 of the header
itself. `read` verifies all of them.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from snowsplat.training.step.finite import rows_text
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.safe_json import check_header, parse_json

#: Incremented when the meaning of the arrays changes: files of another version are rejected.
VERSION = 1
_HEADER = "snowsplat"


@dataclass(frozen=True)
class CheckpointFile:
    """The verified content of a file; ``arrays`` are finite, ``meta`` is as passed to `write`."""

    path: Path
    step: int
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]


def write(path: Path, step: int, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically.

    Args:
        arrays: contiguous; of any shape, including () and empty; of dtypes that safetensors
            supports.
        meta: JSON values.

    Raises:
        OSError: the folder is missing or not writable, or the disk is full.
    """
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
            safetensors.numpy.save_file(dict(arrays), temporary, metadata=metadata)
        except safetensors.SafetensorError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise OSError(f"{path}: cannot be written ({error})") from None
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from None


def read(path: Path) -> CheckpointFile:
    """Read and verify a checkpoint.

    Raises:
        OSError: the file is missing or cannot be read; it may be valid.
        UserError: the file is truncated, damaged, not finite, not a checkpoint, or has another
            version.
    """
    try:
        check_header(path)
        with safetensors.safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            text = metadata[_HEADER].encode("utf-8", "replace")
            header = parse_json(text)
            if header["version"] != VERSION:
                raise UserError(
                    "{path}: checkpoint of version {header}, this program reads version "
                    "{version}; resume with the snowsplat that wrote it",
                    path=path,
                    header=header["version"],
                    version=VERSION,
                )
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        intact = header["crc32"] == {name: _crc32(array) for name, array in arrays.items()}
        intact = intact and header["layout"] == _layout(arrays)
        intact = intact and metadata["crc32"] == str(zlib.crc32(text))
        if not isinstance(header["meta"], dict):
            raise ValueError("meta is not an object")
        content = CheckpointFile(path, int(header["step"]), arrays, header["meta"])
    except (
        safetensors.SafetensorError,
        AttributeError,  # a dtype that NumPy does not have, for example floats of one byte
        KeyError,
        TypeError,
        ValueError,
        OverflowError,
    ):
        raise UserError(
            "{path}: not a checkpoint, or damaged; use another one", path=path
        ) from None
    if not intact:
        raise UserError("{path}: damaged, checksums do not match; use another one", path=path)
    if found := _rows_not_finite(arrays):
        raise UserError(
            "{path}: non-finite values in {listed}; remove it and resume from an earlier one",
            path=path,
            listed=rows_text(found),
        )
    return content


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
