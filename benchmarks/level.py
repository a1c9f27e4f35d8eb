"""How level a dataset is, and how far its path differs from GPS.

    python benchmarks/level.py DATASET [DATASET ...]

A row per dataset that `snowsplat sfm` made, from its model in ``distorted/`` and the metadata in
``sfm.json``. Columns: the photos in the model; the expected error of the level; the angle between
the up direction and that of the cameras alone; the angle between the up direction and the normal of
the largest plane that is nearly horizontal, with the share of the points in it (a floor is level;
the ground outdoors may not be); for a metric dataset, the length of the path of the cameras
over that of the GPS positions, and the slope of both from end to end.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import torch

from snowsplat.scene.orientation import level_of_cameras
from snowsplat.sfm.gps import east_north_up, middle_of
from snowsplat.sfm.ingest.inputs import Gathered
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.orient import orientation
from snowsplat.util.safe_json import from_json, read_json

#: Thickness of a plane, in units of the median distance of the points from their median.
THICKNESS = 0.01
#: Planes that differ by more from the horizontal are walls and roofs.
STEEPEST = math.radians(30)
TRIALS = 3000
UP = np.array([0.0, -1.0, 0.0])


def angle(one: np.ndarray, two: np.ndarray) -> float:
    """Degrees between unit vectors."""
    return math.degrees(math.acos(min(1.0, max(-1.0, float(one @ two)))))


def largest_plane(points: np.ndarray) -> tuple[float, float]:
    """Degrees between up and its normal, and its share of the points (P, 3) of a level scene."""
    random = np.random.default_rng(0)
    points = points[random.permutation(len(points))[:5000]]
    middle = np.median(points, axis=0)
    thickness = THICKNESS * float(np.median(np.linalg.norm(points - middle, axis=1)))
    best = np.zeros(len(points), bool)
    for a, b, c in points[random.integers(0, len(points), (TRIALS, 3))]:
        normal = np.cross(b - a, c - a)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
        if abs(float(normal @ UP)) > math.cos(STEEPEST):
            inside = np.abs((points - a) @ normal) < thickness
            best = inside if inside.sum() > best.sum() else best
    if best.sum() < 3:
        return math.nan, 0.0
    normal = np.linalg.svd(points[best] - points[best].mean(axis=0), full_matrices=False)[2][2]
    return angle(normal * np.sign(normal @ UP), UP), float(best.mean())


def path(centres: np.ndarray, locations: Sequence[tuple[float, float, float] | None]) -> str:
    """Length over that of GPS and both slopes, of centres (N, 3) in the scene."""
    rows = [i for i, location in enumerate(locations) if location is not None]
    found = np.array([locations[i] for i in rows])
    places = east_north_up(found, middle_of(found))
    moved = centres[rows][:, [0, 2, 1]] * (1, 1, -1)  # y points down

    def length(positions: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1).sum())

    def slope(positions: np.ndarray) -> float:
        whole = positions[-1] - positions[0]
        return math.degrees(math.atan2(whole[2], math.hypot(whole[0], whole[1])))

    ratio = length(moved) / max(length(places), 1e-9)
    return f"path / GPS {ratio:.3f}, slopes {slope(moved):+.1f}° / {slope(places):+.1f}°"


def row(dataset: Path) -> str:
    """The row of a dataset."""
    result = read_json(dataset / "sfm.json")["stages"]["photos"]["result"]
    photos: list[Photo] = from_json(Gathered, result).photos
    model = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    oriented = orientation(model, photos)
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    rotations = np.array([image.cam_from_world().matrix()[:, :3] for image in images])
    scene = oriented.scene_from_sfm
    held = scene.rotation.numpy() @ level_of_cameras(rotations)[0]
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    tilt, share = largest_plane(scene.apply(torch.from_numpy(points)).numpy())
    centres = np.array([image.projection_center() for image in images])
    locations = {photo.name: photo.location for photo in photos}
    if oriented.placement.is_metric:
        moved = scene.apply(torch.from_numpy(centres)).numpy()
        scale = path(moved, [locations.get(image.name) for image in images])
    else:
        scale = "not metric"
    return (
        f"{dataset.name}: {len(images)} photos, level to {oriented.placement.level_error:.1f}°, "
        f"{angle(held, UP):.1f}° from the cameras alone, {tilt:.1f}° from the largest plane "
        f"({100 * share:.0f}%), {scale}\n    " + "\n    ".join(oriented.placement.lines())
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    for dataset in parser.parse_args().datasets:
        print(row(dataset))


if __name__ == "__main__":
    main()
