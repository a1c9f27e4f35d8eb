"""Checkpoints of gsplat (`ckpt_29999_rank0.pt`): the tensors of its "splats", without optimizers.

The parameters are those of a PLY: logarithms of scales, quaternions wxyz, logits of opacities, SH
coefficients by order.

`torch.load` reads them with ``weights_only``, so no code of the file runs. Even so, a file of 400
bytes can take gigabytes: therefore a child process with limits reads it first.
"""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats.archive import first_member
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.scene.sh_constants import SH_REST_COUNTS
from snowsplat.util.limited_child import check_readable

_METADATA = "data.pkl"

logger = logging.getLogger(__name__)

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
    check_readable(splats_in, path, ["torch"])
    arrays = splats_in(path)
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


@reads
def splats_in(path: Path) -> list[np.ndarray]:
    """The tensors of `_NAMES` that a checkpoint has, in this order; float32, or float64 as stored.

    Raises: UserError: the file cannot be loaded safely, or is another kind of checkpoint.
    """
    import torch

    with open(path, "rb") as file:
        if not is_checkpoint(file.read(512)):  # torch would try older formats, such as tar files
            raise Damaged("a checkpoint that cannot be loaded safely, or a damaged one")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # torch raises many kinds
        raise Damaged("a checkpoint that cannot be loaded safely, or a damaged one") from None
    splats = _splats(content)
    tensors = [splats[name] for name in _NAMES if name in splats]
    if not all(isinstance(t, torch.Tensor) and t.is_floating_point() for t in tensors):
        raise Damaged("its splats are not tensors of numbers")
    kept = (torch.float32, torch.float64)
    # A tensor may repeat its numbers, and then be larger than the file.
    return [(t if t.dtype in kept else t.float()).detach().contiguous().numpy() for t in tensors]


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
