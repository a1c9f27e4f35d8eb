"""`points_beside`: the point cloud that was exported beside the cameras, in a file of its own."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from snowsplat.data.dataset import usable_points
from snowsplat.data.imports.lenses import intrinsics_of
from snowsplat.data.imports.reconstruction import Reconstruction, Shot
from snowsplat.data.points_ply import read_points
from snowsplat.util.errors import UserError
from snowsplat.util.ply import open_table

logger = logging.getLogger(__name__)

_SAMPLE = 1000  # points and cameras at most that are compared
# Share of the points that a photo must show. In another frame, photos show few of them.
_LEAST_SEEN = 0.5


def points_beside(
    folder: Path, found: Reconstruction, frames: Mapping[str, np.ndarray] | None = None
) -> None:
    """Add the points of the PLY file in ``folder`` that the photos of ``found`` show.

    Programs let the user choose the coordinate system of each export, so the points may be in
    another one than the cameras. Such points are not used, and a warning tells it.

    Args:
        frames: the frames in which the points may be: a name, and world_from_frame (3, 4), which
            may have a scale. None: that of the cameras.
    """
    best, seen, rejected = None, _LEAST_SEEN, []
    for path in sorted(folder.glob("*.ply")):
        try:
            if "f_dc_0" in open_table(path).columns:  # Gaussians
                continue
            xyz, rgb = read_points(path)
        except UserError:  # another kind of PLY file, such as the faces of a mesh alone
            continue
        rejected.append(path.name)
        for matrix in (frames or {"": np.eye(4)[:3]}).values():
            moved = xyz @ matrix[:, :3].T + matrix[:, 3]
            share = _share_seen(moved, found.shots)
            if share > seen:
                best, seen = (path, moved, rgb), share
    if best is not None:
        path, moved, rgb = best
        found.points, found.points_from = usable_points(path, moved, rgb), path.name
    elif rejected:
        logger.warning(
            "%s: its points are not where the cameras look; not used; export cameras and points "
            "in the same coordinate system",
            folder / rejected[0],
        )


def _share_seen(xyz: np.ndarray, shots: Sequence[Shot]) -> float:
    """The share of the points that at least one photo shows, from a sample."""
    xyz = xyz[:: max(1, len(xyz) // _SAMPLE)]
    xyz = xyz[np.isfinite(xyz).all(1)]
    seen = np.zeros(len(xyz), bool)
    for shot in shots[:: max(1, len(shots) // _SAMPLE)]:
        fx, fy, cx, cy = intrinsics_of(shot.lens)
        cam = xyz @ shot.cam_from_world[:, :3].T + shot.cam_from_world[:, 3]
        with np.errstate(all="ignore"):
            x, y = fx * cam[:, 0] / cam[:, 2] + cx, fy * cam[:, 1] / cam[:, 2] + cy
            inside = (x >= 0) & (x < shot.lens.width) & (y >= 0) & (y < shot.lens.height)
        seen |= inside & (cam[:, 2] > 0)
    return float(seen.mean()) if len(seen) else 0.0
