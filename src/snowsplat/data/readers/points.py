"""`points_beside`: the point cloud that was exported beside the cameras, in a file of its own."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snowsplat.data.dataset import PosedImage, usable_points
from snowsplat.data.points_ply import read_points
from snowsplat.data.readers.reconstruction import Reconstruction
from snowsplat.util.errors import UserError
from snowsplat.util.ply import open_table

logger = logging.getLogger(__name__)

_SAMPLE = 1000  # points and cameras at most that are compared
# Share of the points that a photo must show. In another frame, photos show few of them.
_LEAST_SEEN = 0.5


def points_beside(
    folder: Path,
    found: Reconstruction,
    frames: Sequence[np.ndarray] = (np.eye(4)[:3],),
    file: str = "*.ply",
    more_than: int = 0,
) -> None:
    """Add the points of the PLY file in ``folder`` that the photos of ``found`` show.

    Programs let the user choose the coordinate system of each export, so the points may be in
    another one than the cameras. Of several frames, the one in which the photos show most points is
    used; if they show few points in all of them, a warning tells it. `data.judge` compares colours.

    ``frames``: world_from_frame (3, 4), which may have a scale, of the frames in which the points
    may be, the most probable first. ``file``: the pattern of its name. ``more_than``: a file with
    no more points than this is not used.
    """
    best, rejected = _LEAST_SEEN, None
    for path in sorted(folder.glob(file)):
        try:
            table = open_table(path)
            if "f_dc_0" in table.columns or table.count <= more_than:  # Gaussians
                continue
            xyz, rgb = read_points(path)
        except UserError:  # another kind of PLY file
            continue
        rejected = rejected or path
        for matrix in frames:
            moved = xyz @ matrix[:, :3].T + matrix[:, 3]
            if (seen := _share_seen(moved, found.images)) > best:
                best, found.points_from = seen, path.name
                found.points = usable_points(path, moved, rgb)
    if rejected is not None and not found.points_from:
        logger.warning(
            "%s: its points are not where the cameras look; not used; export cameras and points "
            "in the same coordinate system",
            rejected,
        )


def _share_seen(xyz: np.ndarray, images: Sequence[PosedImage]) -> float:
    """The share of the points that at least one photo shows, from a sample."""
    xyz = xyz[:: max(1, len(xyz) // _SAMPLE)]
    seen = np.zeros(len(xyz), bool)
    for image in images[:: max(1, len(images) // _SAMPLE)]:
        pose = image.camera.cam_from_world.numpy()
        where = image.lens.project(xyz @ pose[:, :3].T + pose[:, 3])
        seen |= ((where >= 0) & (where < (image.lens.width, image.lens.height))).all(1)
    return float(seen.mean()) if len(seen) else 0.0
