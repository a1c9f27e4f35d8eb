"""How well photos cover a scene: steps from photo to photo, and points that several photos show.

Everything is measured on the points of a COLMAP model and the photos that observe them. The views
of a panorama or of a wide lens are one photo.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snowsplat.sfm.pinhole_model import photo_of
from snowsplat.util.natural_order import natural_key

#: At most about this number of points is measured.
_POINTS = 20_000
#: Two photos are neighbours if they share at least this share of the points of one of them.
_NEIGHBOURS = 0.05
#: At a smaller step, points move by less than a pixel in photos of 1000 pixels: one place.
SAME_PLACE = 1e-3


@dataclass(frozen=True)
class Coverage:
    """The measures of N photos, in the order of their names."""

    names: list[str]  # of the photos
    # (N,) share of the points of a photo that at least two other photos observe. A point of two
    # photos has no third photo that could contradict a wrong match. NaN without points.
    confirmed: np.ndarray
    # (N,) distance to the nearest photo that shows the same, divided by the median depth of the
    # points; infinite if no photo shows the same.
    step: np.ndarray
    # (N,) angle in degrees between the optical axis and the mean of all axes; 180 for a panorama.
    directions: np.ndarray
    # (N,) the first photo that was taken from the same place; that of brackets of exposures.
    place: np.ndarray


def measure_coverage(model: Path) -> Coverage:
    """The measures of a COLMAP model.

    ``model``: its folder. Every point has its observations.

    Raises: ValueError: the model cannot be read.
    """
    import pycolmap

    reconstruction = pycolmap.Reconstruction(model)
    photos: dict[str, list[pycolmap.Image]] = {}
    for frame in reconstruction.frames.values():
        images = [reconstruction.image(data.id) for data in frame.image_ids]
        photos[photo_of(images[0].name) if len(images) > 1 else images[0].name] = images
    names = sorted(photos, key=natural_key)
    row = {image.image_id: i for i, name in enumerate(names) for image in photos[name]}
    ids = sorted(reconstruction.point3D_ids())
    points = [reconstruction.point3D(i) for i in ids[:: -(-len(ids) // _POINTS) or 1]]
    xyz = np.array([point.xyz for point in points]).reshape(-1, 3)
    seen = np.zeros((len(names), len(points)), bool)
    for column, point in enumerate(points):
        seen[[row[element.image_id] for element in point.track.elements], column] = True
    poses = np.array([photos[name][0].cam_from_world().matrix() for name in names])
    around = np.array([len(photos[name]) > 1 for name in names])
    directions = np.where(around, 180.0, _directions(poses))
    centres = -(poses[:, :, :3].transpose(0, 2, 1) @ poses[:, :, 3:])[:, :, 0]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    steps = _steps(seen, apart, _depths(seen, poses, around, xyz))
    return Coverage(names, _confirmed(seen), steps.min(1), directions, _places(steps))


def _confirmed(seen: np.ndarray) -> np.ndarray:
    """`Coverage.confirmed`; ``seen`` (N, P) is True for the points that a photo observes."""
    enough = seen.sum(0) >= 3
    count = seen.sum(1)
    return np.where(count > 0, (seen & enough).sum(1) / np.maximum(count, 1), np.nan)


def _steps(seen: np.ndarray, apart: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(N, N) the distance ``apart`` to each photo that shows the same, divided by the depth (N,) of
    the points; infinite for the others."""
    as_floats = seen.astype(np.float32)
    shared = as_floats @ as_floats.T
    neighbours = shared >= np.maximum(1.0, _NEIGHBOURS * seen.sum(1)[:, None])
    neighbours &= apart > 1e-9 * apart.max()  # not itself, nor another view of a wide photo
    neighbours &= (depths > 0)[:, None]
    return np.where(neighbours, apart / np.where(depths > 0, depths, 1.0)[:, None], np.inf)


def _depths(seen: np.ndarray, poses: np.ndarray, around: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """(N,) the median depth of the points that a photo observes; NaN without points.

    Poses (N, 3, 4) are cam_from_world, points (P, 3) are in the world. ``around`` (N,): it is a
    panorama; the depth of its points is their distance.
    """
    depths = np.full(len(poses), np.nan)
    for i, (pose, visible) in enumerate(zip(poses, seen, strict=True)):
        if visible.any():
            points = xyz[visible] @ pose[:, :3].T + pose[:, 3]
            depths[i] = np.median(np.linalg.norm(points, axis=1) if around[i] else points[:, 2])
    return depths


def _places(steps: np.ndarray) -> np.ndarray:
    """`Coverage.place`. Photos of a slow film are not one place: each is compared with the first
    photo of a place."""
    place = np.arange(len(steps))
    for i in range(len(steps)):
        firsts = place[:i][(place[:i] == np.arange(i)) & (steps[i, :i] < SAME_PLACE)]
        place[i] = firsts.min(initial=i)
    return place


def _directions(poses: np.ndarray) -> np.ndarray:
    """`Coverage.directions`; poses (N, 3, 4) are cam_from_world."""
    axes = poses[:, 2, :3]
    mean = axes.mean(0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    return np.degrees(np.arccos(np.clip(axes @ mean, -1.0, 1.0)))
