"""Checkpoints of gsplat (`ckpt_29999_rank0.pt`): the tensors of its "splats", without optimizers.

The parameters are those of a PLY: logarithms of scales, quaternions wxyz, logits of opacities, SH
coefficients by order.

The file is a zip file: `data.pkl`, a pickle with metadata, and one uncompressed member per storage.
`torch.load` unpickles it: even with ``weights_only``, a file of 400 bytes can take gigabytes. Here,
the few instructions are followed that dictionaries of tensors need. They make no more values than
there are instructions, call nothing, and leave other objects out.
"""

from __future__ import annotations

import logging
import math
import pickletools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats.archive import first_member
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.formats.zip_members import ZipMembers
from snowsplat.scene.sh_constants import SH_REST_COUNTS

METADATA = "data.pkl"
_METADATA_LIMIT = 1 << 18  # bytes
_TYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2"}
_TYPES |= {"BFloat16Storage": "<u2"}
_VALUES = ("UNICODE", "INT", "LONG", "FLOAT", "STRING", "BYTES")  # of the names of instructions


@dataclass(frozen=True)
class Tensor:
    """A tensor of the file: a view of a storage, with its first element, shape and strides."""

    dtype: str
    key: str
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclass(frozen=True)
class _Global:
    name: str  # module and name; nothing is imported


class _Other:
    """An object of the file that is not read."""


def read_content(members: ZipMembers) -> tuple[Any, str]:
    """The content: dictionaries, lists, tuples, numbers, texts, `Tensor`; and its folder.

    Raises: Damaged: not such a file, or other instructions than those of dictionaries of tensors.
    """
    inner = [name for name in members.names() if name.endswith(METADATA)]
    if len(inner) != 1 or len(data := members.read(inner[0], 1)) > _METADATA_LIMIT:
        raise Damaged("not a plausible checkpoint of PyTorch")
    try:
        return _Machine().run(pickletools.genops(data)), inner[0].removesuffix(METADATA)
    except Exception:  # an incomplete stack or file, values of other types
        raise Damaged("a checkpoint that cannot be loaded safely, or a damaged one") from None


def read_tensor(members: ZipMembers, folder: str, tensor: Tensor, most: int) -> np.ndarray:
    """A tensor as float32, or as float64 if it has doubles; ``most``: elements.

    Raises: Damaged: it is outside of its storage, or has more elements.
    """
    if math.prod(tensor.shape) > most:
        raise Damaged("its tensors are larger than the file")
    stored = np.frombuffer(members.read(f"{folder}data/{tensor.key}", 1), tensor.dtype)
    pairs = list(zip(tensor.shape, tensor.strides, strict=True))
    last = tensor.offset + sum((size - 1) * stride for size, stride in pairs)
    if min(tensor.shape, default=1) and last >= len(stored):
        raise Damaged("its tensors are outside of the file")
    if tensor.dtype == "<u2":  # bfloat16: the upper half of a float32
        stored = (stored.astype("<u4") << 16).view("<f4")
    strides = [stride * stored.itemsize for stride in tensor.strides]
    values = np.lib.stride_tricks.as_strided(stored[tensor.offset :], tensor.shape, strides)
    return np.array(values, np.float64 if tensor.dtype == "<f8" else np.float32)


class _Machine:
    """Follows the instructions of a pickle; any error means a file of another kind."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def run(self, instructions: Iterator[tuple[Any, Any, Any]]) -> Any:
        for code, argument, _ in instructions:
            if code.name == "STOP":
                (content,) = self.stack
                return content
            self._step(code.name, argument)
        raise ValueError

    def _from_mark(self) -> list[Any]:
        mark = self.marks.pop()
        items, self.stack[mark:] = self.stack[mark:], []
        return items

    def _step(self, name: str, argument: Any) -> None:
        stack = self.stack
        if name in ("PROTO", "FRAME"):
            pass
        elif name == "MARK":
            self.marks.append(len(stack))
        elif name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
            self.memo[len(self.memo) if argument is None else argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name in ("EMPTY_DICT", "EMPTY_LIST", "EMPTY_TUPLE", "NONE", "NEWTRUE", "NEWFALSE"):
            made: dict[str, Any] = {"EMPTY_DICT": {}, "EMPTY_LIST": [], "EMPTY_TUPLE": ()}
            stack.append(made.get(name, {"NEWTRUE": True, "NEWFALSE": False}.get(name)))
        elif any(kind in name for kind in _VALUES):
            stack.append(argument)
        elif name == "TUPLE":
            stack.append(tuple(self._from_mark()))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            stack[-count:] = [tuple(stack[-count:])]
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else self._from_mark()
            stack[-1].extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = [stack.pop(), stack.pop()][::-1] if name == "SETITEM" else self._from_mark()
            pairs = zip(items[::2], items[1::2], strict=True)
            stack[-1].update({key: v for key, v in pairs if isinstance(key, str | int)})
        elif name == "GLOBAL":
            stack.append(_Global(argument))
        elif name == "STACK_GLOBAL":
            words = [stack.pop(), stack.pop()]
            stack.append(_Global(f"{words[1]} {words[0]}"))
        elif name == "BINPERSID":
            _, kind, key, _, _ = stack.pop()
            stack.append((_TYPES.get(kind.name.split()[-1]), key))
        elif name in ("REDUCE", "NEWOBJ"):
            values, function = stack.pop(), stack.pop()
            stack.append(_result(function.name, values))
        elif name == "BUILD":
            stack.pop()
        else:
            raise ValueError(name)


def _result(function: str, values: Any) -> Any:
    if function == "collections OrderedDict" and not values:
        return {}
    if function == "torch._utils _rebuild_parameter":
        return values[0]
    if function == "torch._utils _rebuild_tensor_v2":
        (dtype, key), offset, shape, strides = values[:4]
        numbers = (offset, *shape, *strides)
        if dtype and all(isinstance(n, int) and 0 <= n < 1 << 40 for n in numbers):
            return Tensor(dtype, str(key), offset, shape, strides)
    return _Other()


logger = logging.getLogger(__name__)

_NAMES = ("means", "scales", "quats", "opacities", "sh0", "shN")


def is_checkpoint(head: bytes) -> bool:
    """Whether a file that begins with ``head`` was saved by PyTorch."""
    name = first_member(head)
    return name is not None and (name == METADATA or name.endswith(f"/{METADATA}"))


@reads
def read_checkpoint(path: Path) -> GaussianArrays:
    """Read the Gaussians of a checkpoint; SH coefficients beyond degree 3 are ignored.

    Raises: UserError: the file cannot be read, is damaged, or is another kind of checkpoint.
    """
    with ZipMembers(path) as members:
        content, folder = read_content(members)
        splats = _splats(content)
        tensors = [splats[name] for name in _NAMES if name in splats]
        if not all(isinstance(tensor, Tensor) for tensor in tensors):
            raise Damaged("its splats are not tensors of numbers")
        most = path.stat().st_size // 2
        arrays = [read_tensor(members, folder, tensor, most) for tensor in tensors]
    means, scales, quats, opacities, sh0 = arrays[:5]
    n = len(means)
    shN = arrays[5] if len(arrays) > 5 else np.zeros((n, 0, 3), np.float32)
    opacities = opacities.reshape(-1)
    shapes = [array.shape for array in (means, scales, quats, opacities, sh0)]
    rest = shN.shape[1] if shN.ndim == 3 else -1
    if shapes != [(n, 3), (n, 3), (n, 4), (n,), (n, 1, 3)] or shN.shape != (n, rest, 3):
        raise Damaged("its tensors do not have the shapes of Gaussians")
    if rest not in [(degree + 1) ** 2 - 1 for degree in range(11)]:
        raise Unsupported("{rest} SH coefficients do not match an SH degree", rest=rest)
    if rest > SH_REST_COUNTS[-1]:
        logger.warning("%s: its SH degree is reduced to 3", path)
    _name_other_ranks(path)
    return usable_gaussians(
        path, means, scales, quats, opacities, sh0, shN[:, : SH_REST_COUNTS[-1]]
    )


def _splats(content: Any) -> dict[Any, Any]:
    """The tensors by name. Raises: Unsupported: another kind of checkpoint."""
    splats = content.get("splats", content) if isinstance(content, dict) else None
    if isinstance(splats, dict) and all(name in splats for name in _NAMES[:4]):
        if "sh0" in splats:
            return splats
        raise Unsupported(
            "a checkpoint of gsplat whose colours are a network (app_opt); train without "
            "it, or save a .ply",
        )
    if isinstance(content, tuple | list):
        raise Unsupported(
            "a checkpoint of the reference implementation; use its point_cloud.ply",
        )
    if isinstance(content, dict) and "pipeline" in content:
        raise Unsupported("a checkpoint of nerfstudio; ns-export gaussian-splat makes a .ply")
    missing = [name for name in _NAMES[:5] if not isinstance(splats, dict) or name not in splats]
    raise Unsupported(
        "a checkpoint of PyTorch without the Gaussians of gsplat (no {missing} in "
        "splats); save a .ply in the program that made it",
        missing=", ".join(missing),
    )


def _name_other_ranks(path: Path) -> None:
    """A training on several GPUs writes a checkpoint of each, with a part of the Gaussians."""
    match = re.fullmatch(r"(.*_rank)\d+(\.pt)", path.name)
    if not match:
        return
    others = sorted(p.name for p in path.parent.glob("*_rank*.pt") if p != path)
    same = [name for name in others if name.startswith(match[1])]
    if same:
        logger.warning("%s: %s has more Gaussians of this scene; merge them", path, ", ".join(same))
