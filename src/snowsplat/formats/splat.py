"""`.splat` files: 32 bytes a Gaussian, no header, no view-dependent colour.

Of each Gaussian, in this order: position, 3 floats; standard deviations, 3 floats, not their
logarithms; colour and opacity RGBA, a byte each; the quaternion wxyz, a byte each, as 128 + 128 q.
Little-endian, in the frame of the PLY files. The format is that of the first web viewer of splats
(github.com/antimatter15/splat); the Gaussians that matter most come first there, so that a viewer
shows something while it loads.
"""

from pathlib import Path

import numpy as np

from snowsplat.formats import packing
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_LOG_LIMIT = 87.0  # e to more is not a float


@np.errstate(all="ignore")  # what is not finite is left out at the end
def read_splat(path: Path | str) -> Gaussians:
    """Read a scene of SH degree 0.

    Raises:
        UserError: not readable, or of a size that is no multiple of 32.
    """
    path = Path(path)
    data = packing.read_file(path)
    if len(data) % _ROW.itemsize:
        raise UserError(
            f"{path}: {len(data)} bytes are not a .splat file, which has {_ROW.itemsize} a "
            "Gaussian; copy or export it again"
        )
    rows = np.frombuffer(data, _ROW)
    return packing.to_gaussians(
        path,
        rows["means"],
        packing.log_scales(rows["scales"]),
        packing.unit_quats((rows["quats"].astype(np.float32) - 128) / 128),
        packing.opacity_logits(rows["rgba"][:, 3]),
        packing.color_sh(rows["rgba"][:, :3]),
        np.zeros((len(rows), 0, 3), np.float32),
    )


@np.errstate(all="ignore")  # what is too large is clamped
def write_splat(path: Path | str, gaussians: Gaussians) -> None:
    """Write the layout above, the largest and most opaque Gaussians first, atomically.

    View-dependent colour (``sh_rest``) has no place in this format. The order is by volume times
    opacity, as is customary.

    Raises:
        OSError: the folder is absent or not writable, or the disk is full.
    """
    path = Path(path)
    means, log_scales, quats, opacity_logits, sh_dc, _ = packing.to_arrays(path, gaussians)
    # log(volume · opacity): the product itself would over- and underflow.
    importance = log_scales.sum(1) - np.logaddexp(0, -opacity_logits)
    order = np.argsort(-importance, kind="stable")
    rows = np.empty(len(means), _ROW)
    rows["means"] = means[order]
    rows["scales"] = np.exp(np.clip(log_scales[order], -_LOG_LIMIT, _LOG_LIMIT))
    rows["rgba"][:, :3] = packing.color_bytes(sh_dc[order])
    rows["rgba"][:, 3] = packing.opacity_bytes(opacity_logits[order])
    rows["quats"] = packing.to_bytes(128 + 128 * quats[order])
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.tobytes())
