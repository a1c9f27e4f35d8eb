"""`.splat` files: 32 bytes per Gaussian, no header, no view-dependent colour.

The row of a Gaussian has, in this order: position, 3 floats; standard deviations (not their
logarithms), 3 floats; colour and opacity RGBA, one byte each; quaternion wxyz, one byte each, as
128 + 128 q. Values are little-endian, in the frame of the PLY files. The format is that of the
first web viewer for Gaussian splats (github.com/antimatter15/splat). The most important Gaussians
come first, so that a viewer can display a preview while the file loads.
"""

from pathlib import Path

import numpy as np

from snowsplat.formats import packing
from snowsplat.formats.damage import Damaged, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.util.files import write_bytes

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_LOG_LIMIT = 87.0  # the exponential of a larger number exceeds float32


@reads
def read_splat(path: Path) -> GaussianArrays:
    """Read a scene of SH degree 0.

    Raises: UserError: the file cannot be read, or its size is not a multiple of 32.
    """
    data = path.read_bytes()
    if len(data) % _ROW.itemsize:
        raise Damaged(
            "not a .splat file: {size} bytes are not a multiple of {row}",
            size=len(data),
            row=_ROW.itemsize,
        )
    rows = np.frombuffer(data, _ROW)
    return usable_gaussians(
        path,
        rows["means"],
        packing.log_scales(rows["scales"]),
        packing.unit_quats((rows["quats"].astype(np.float32) - 128) / 128),
        packing.opacity_logits(rows["rgba"][:, 3]),
        packing.color_sh(rows["rgba"][:, :3]),
        np.zeros((len(rows), 0, 3), np.float32),
    )


@np.errstate(all="ignore")  # values that are too large are clamped
def write_splat(path: Path | str, gaussians: GaussianArrays) -> None:
    """Write the layout above, the largest and most opaque Gaussians first, atomically.

    The format cannot store view-dependent colour (``sh_rest``). Gaussians are sorted by volume
    times opacity, as is usual for this format.

    Raises: OSError: the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    means, log_scales, quats, opacity_logits, sh_dc, _ = packing.packable(path, gaussians)
    # log(volume · opacity): the product itself would overflow and underflow.
    importance = log_scales.sum(1) - np.logaddexp(0, -opacity_logits)
    order = np.argsort(-importance, kind="stable")
    rows = np.empty(len(means), _ROW)
    rows["means"] = means[order]
    rows["scales"] = np.exp(np.clip(log_scales[order], -_LOG_LIMIT, _LOG_LIMIT))
    rows["rgba"][:, :3] = packing.color_bytes(sh_dc[order])
    rows["rgba"][:, 3] = packing.opacity_bytes(opacity_logits[order])
    rows["quats"] = packing.to_bytes(128 + 128 * quats[order])
    write_bytes(path, rows.tobytes())
    cut = packing.Cut(path, "splat", len(means))
    packing.cut_scales(cut, log_scales, -_LOG_LIMIT, _LOG_LIMIT, step=0)
    cut.report(".ply keeps them")
