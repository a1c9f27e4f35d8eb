"""Checkpoints of gsplat (`ckpt_29999_rank0.pt`): the tensors of its "splats", without optimizers.

The file is a zip file of PyTorch: pickled metadata, `data.pkl`, and one uncompressed member per
tensor. torch loads only weights, in a restricted unpickler that calls no code of the file, and maps
the tensors into memory. The parameters are those of a PLY: logarithms of scales, quaternions wxyz,
logits of opacities, SH coefficients by order.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats.archive import first_member
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.formats.zip_members import ZipMembers
from snowsplat.scene.sh_constants import SH_REST_COUNTS

logger = logging.getLogger(__name__)

_METADATA = "data.pkl"
_METADATA_LIMIT = 1 << 18  # bytes; unpickled values need more memory
_NAMES = ("means", "scales", "quats", "opacities", "sh0", "shN")


def is_checkpoint(head: bytes) -> bool:
    """Whether a file that begins with ``head`` was saved by PyTorch."""
    name = first_member(head)
    return name is not None and (name == _METADATA or name.endswith(f"/{_METADATA}"))


@reads
def read_checkpoint(path: Path) -> GaussianArrays:
    """Read the Gaussians of a checkpoint; SH coefficients beyond degree 3 are ignored.

    Raises: UserError: the file cannot be read, is damaged, or is another kind of checkpoint.
    """
    with ZipMembers(path) as members:
        inner = [name for name in members.names() if name.endswith(_METADATA)]
        if len(inner) != 1 or len(members.read(inner[0], 1)) > _METADATA_LIMIT:
            raise Damaged("not a plausible checkpoint of PyTorch")
    splats = _splats(_load(path))
    arrays = [_array(path, splats[name]) for name in _NAMES if name in splats]
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


def _load(path: Path) -> Any:
    import torch

    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception:  # the restricted unpickler raises errors of any type for damaged files
        raise Damaged("a checkpoint that cannot be loaded safely, or a damaged one") from None


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


def _array(path: Path, tensor: Any) -> np.ndarray:
    """A tensor as float32, or as float64 if it has doubles.

    Raises: Damaged: not a tensor of floats, or larger than the file.
    """
    import torch

    dense = isinstance(tensor, torch.Tensor) and tensor.layout == torch.strided
    if not dense or tensor.device.type != "cpu" or not tensor.is_floating_point():
        raise Damaged("its splats are not tensors of numbers")
    if tensor.numel() * tensor.element_size() > path.stat().st_size:
        raise Damaged("its tensors are larger than the file")
    dtype = torch.float64 if tensor.dtype == torch.float64 else torch.float32
    array: np.ndarray = tensor.detach().to(dtype).contiguous().numpy()
    return array


def _name_other_ranks(path: Path) -> None:
    """A training on several GPUs writes a checkpoint of each, with a part of the Gaussians."""
    match = re.fullmatch(r"(.*_rank)\d+(\.pt)", path.name)
    if not match:
        return
    others = sorted(p.name for p in path.parent.glob("*_rank*.pt") if p != path)
    same = [name for name in others if name.startswith(match[1])]
    if same:
        logger.warning("%s: %s has more Gaussians of this scene; merge them", path, ", ".join(same))
