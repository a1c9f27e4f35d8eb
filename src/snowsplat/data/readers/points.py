"""`points_beside`: the point cloud that was exported beside the cameras, in a file of its own."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snowsplat.data.dataset import PosedImage, usable_points
from snowsplat.data.photos.decode import ImageSource, load_thumbnail, read_header
from snowsplat.data.points_ply import read_points
from snowsplat.data.readers.reconstruction import Reconstruction
from snowsplat.util.errors import UserError
from snowsplat.util.ply import open_table

logger = logging.getLogger(__name__)

_SAMPLE = 1000  # points and cameras at most that are compared
# Share of the points that a photo must show. In another frame, photos show few of them.
_LEAST_SEEN = 0.5
# To choose between frames: photos, pixels of their longer side, points, and those in a photo at
# least.
_PICTURES, _SIDE, _COLOURS, _FEWEST_SEEN = 12, 320, 20_000, 20


def points_beside(
    folder: Path,
    found: Reconstruction,
    frames: Sequence[np.ndarray] = (np.eye(4)[:3],),
    file: str = "*.ply",
    more_than: int = 0,
) -> None:
    """Add the points of the PLY file in ``folder`` that the photos of ``found`` show.

    Programs let the user choose the coordinate system of each export, so the points may be in
    another one than the cameras. Of several frames, the one in which the points have the colours of
    the photos is used. If the photos show few points in all of them, a warning tells it.

    ``frames``: world_from_frame (3, 4), which may have a scale, of the frames in which the points
    may be, the most probable first. ``file``: the pattern of its name. ``more_than``: a file with
    no more points than this is not used.
    """
    fitting: list[tuple[Path, np.ndarray, np.ndarray]] = []
    rejected = None
    for path in sorted(folder.glob(file)):
        try:
            table = open_table(path)
            if "f_dc_0" in table.columns or table.count <= more_than:  # Gaussians
                continue
            xyz, rgb = read_points(path)
        except UserError:  # another kind of PLY file
            continue
        rejected = path
        for matrix in frames:
            moved = xyz @ matrix[:, :3].T + matrix[:, 3]
            if _share_seen(moved, found.images) > _LEAST_SEEN:
                fitting.append((path, moved, rgb))
    if fitting:
        scores = [0.0]
        if len(fitting) > 1:
            pictures = _pictures(found.images)
            scores = [_agreement(xyz, rgb, pictures) for _, xyz, rgb in fitting]
        path, moved, rgb = fitting[scores.index(max(scores))]
        found.points, found.points_from = usable_points(path, moved, rgb), path.name
    elif rejected is not None:
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
        seen[_positions(xyz, image)[0]] = True
    return float(seen.mean()) if len(seen) else 0.0


def _positions(xyz: np.ndarray, image: PosedImage) -> tuple[np.ndarray, np.ndarray]:
    """The indices (N,) of the points that a photo shows, and where (N, 2), relative to its size."""
    pose = image.camera.cam_from_world.numpy()
    cam = xyz @ pose[:, :3].T + pose[:, 3]
    where = image.lens.project(cam) / (image.lens.width, image.lens.height)
    seen = ((where >= 0) & (where < 1)).all(1)
    return np.flatnonzero(seen), where[seen]


def _pictures(images: Sequence[PosedImage]) -> list[tuple[PosedImage, np.ndarray]]:
    """Some of the photos, spread over all, as small pictures (4, h, w) uint8."""
    chosen = images[:: max(1, len(images) // _PICTURES)]
    found = []
    for image in chosen:
        path = image.path
        header = read_header(path)
        source = ImageSource(path, header.width, header.height)
        try:
            found.append((image, load_thumbnail(source, _SIDE)))
        except UserError:  # the training says so
            continue
    return found


def _agreement(
    xyz: np.ndarray, rgb: np.ndarray, pictures: Sequence[tuple[PosedImage, np.ndarray]]
) -> float:
    """The mean correlation between the colours of points and of the pixels where they are."""
    step = max(1, len(xyz) // _COLOURS)
    xyz, rgb = xyz[::step], rgb[::step].astype(np.float32)
    values = [0.0]
    for image, picture in pictures:
        seen, where = _positions(xyz, image)
        column, row = (where * picture.shape[:0:-1]).astype(np.int64).T
        a, b = rgb[seen], picture[:3, row, column].T.astype(np.float32)
        if len(seen) >= _FEWEST_SEEN:
            a, b = a - a.mean(0), b - b.mean(0)
            values.append(float((a * b).sum() / max(1.0, np.sqrt((a * a).sum() * (b * b).sum()))))
    return sum(values) / max(1, len(pictures))
