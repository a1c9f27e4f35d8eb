"""A walk past points, of which one group occurs twice, and a model that confuses the two groups.

The cameras 0 … 15 stand on a line, 1.5 units apart. The cameras from 9 on belong to the far part.
In the folded model, the far part is shifted, so that its group of points coincides with the group
of the near part. No photos are needed: the database contains features and verified matches.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.ingest.photo import Photo

from . import walks
from .walks import FOCAL, HEIGHT, WIDTH

COUNT, FAR = 16, range(9, 16)
STEP, SHIFT = 1.5, np.array([18.0, 0.0, 0.0])
TWINS = 100
NEIGHBOURS = 4  # a camera is matched with this number of following ones


@dataclass(frozen=True)
class Walk(walks.Walk):
    """The true scene, and which features and matches the photos have."""

    xyz: np.ndarray  # (P, 3) points
    twins: np.ndarray  # (T, 2) pairs of points that look alike, the near point first
    rotations: list[pycolmap.Rotation3d]  # of the cameras, from the world
    seen: list[np.ndarray]  # for each camera, the points of its features


def walk(points: int = 4000) -> Walk:
    """With fewer points, the mapper may confuse the two groups, too."""
    random = np.random.default_rng(0)
    low, high = [-7, -2.5, 4], [STEP * COUNT + 6, 2.5, 8]
    twin = random.uniform([1, -2.5, 4], [5, 2.5, 8], (TWINS, 3))
    xyz = np.concatenate([twin, twin + SHIFT, random.uniform(low, high, (points, 3))])
    count = np.arange(COUNT)
    centres = np.stack([STEP * count, 0.4 * np.sin(2 * count), 0.3 * np.cos(3 * count)], 1)
    twins = np.stack([np.arange(TWINS), np.arange(TWINS) + TWINS], 1)
    # The cameras look along +z and turn a little: without a rotation, the focal length is unknown.
    turns = 0.25 * np.stack([np.sin(3 * count), np.cos(2 * count), 0 * count], 1)
    rotations = [pycolmap.Rotation3d(turn) for turn in turns]
    seen, pixels = [], []
    for centre, rotation in zip(centres, rotations, strict=True):
        local = (xyz - centre) @ rotation.matrix().T
        pixel = FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        inside = (local[:, 2] > 0) & ((pixel > 0) & (pixel < [WIDTH, HEIGHT])).all(1)
        seen.append(np.flatnonzero(inside))
        pixels.append(pixel[inside] + random.normal(0, 0.2, (inside.sum(), 2)))
    matches = {}
    for i in range(COUNT):
        for j in range(i + 1, COUNT):
            if j - i <= NEIGHBOURS:
                _, one, two = np.intersect1d(seen[i], seen[j], return_indices=True)
            else:
                near, far = np.isin(twins[:, 0], seen[i]), np.isin(twins[:, 1], seen[j])
                both = twins[near & far]
                one, two = (
                    np.searchsorted(seen[i], both[:, 0]),
                    np.searchsorted(seen[j], both[:, 1]),
                )
            if len(one) >= 30:
                matches[i, j] = np.stack([one, two], 1).astype(np.uint32)
    return Walk(centres, pixels, matches, xyz, twins, rotations, seen)


def photos() -> list[Photo]:
    return walks.Walk(np.zeros((COUNT, 3)), [], {}).photos(FOCAL)


def write_database(path: Path, scene: Walk) -> Path:
    config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    return scene.write(path, FOCAL, Lens("SIMPLE_PINHOLE"), config)


def model(scene: Walk, folded: bool) -> pycolmap.Reconstruction:
    """The correct model, or the one in which the far cameras are shifted to the near twins."""
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, WIDTH, HEIGHT)
    found.add_camera_with_trivial_rig(camera)
    tracks: dict[tuple[int, bool], list[tuple[int, int]]] = {}
    twin_of = dict(scene.twins[:, ::-1].tolist())
    for i in range(COUNT):
        image = pycolmap.Image(f"{i:02}.png", scene.pixels[i], 1, i + 1)
        moved = folded and i in FAR
        centre = scene.centres[i] - SHIFT * moved
        rotation = scene.rotations[i]
        pose = pycolmap.Rigid3d(rotation, -rotation.matrix() @ centre)
        found.add_image_with_trivial_frame(image, pose)
        for feature, point in enumerate(scene.seen[i].tolist()):
            key = (twin_of[point], False) if moved and point in twin_of else (point, moved)
            tracks.setdefault(key, []).append((i + 1, feature))
    for (point, moved), track in tracks.items():
        if len(track) > 1:
            elements = [pycolmap.TrackElement(*element) for element in track]
            xyz = scene.xyz[point] - SHIFT * moved
            found.add_point3D(xyz, pycolmap.Track(elements))
    return found
