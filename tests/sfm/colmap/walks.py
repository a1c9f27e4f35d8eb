"""Features and verified matches of a walk along a street or around a place; there are no photos."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from snowsplat.sfm.colmap.database import closing_database, open_database
from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.synthetic.photographer import Lens as PhoneLens

from ...scenes.lenses import FisheyeLens

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
CALIBRATED = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
ORDINARY = PhoneLens(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Walk:
    """What the photos see."""

    centres: np.ndarray  # (N, 3) of the cameras
    pixels: list[np.ndarray]  # for each camera, (features, 2)
    matches: dict[tuple[int, int], np.ndarray]  # (M, 2) features, of verified pairs i < j

    def photos(self, exif: float | None) -> list[Photo]:
        """``exif``: the focal length in EXIF, in pixels."""
        names = [f"{i:02}.png" for i in range(len(self.centres))]
        return [Photo(n, n, WIDTH, HEIGHT, focal=exif) for n in names]

    def write(self, path: Path, exif: float | None, lens: Lens, config=CALIBRATED) -> Path:
        """Write the photos, their features, and the verified matches, all of one kind."""
        open_database(path, self.photos(exif), lens, "none")
        with closing_database(path) as database:
            for i, positions in enumerate(self.pixels):
                database.write_keypoints(i + 1, positions.astype(np.float32))
            for (i, j), rows in self.matches.items():
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = config
                geometry.inlier_matches = rows
                database.write_two_view_geometry(i + 1, j + 1, geometry)
        return path


def forward(count: int = 12, step: float = 1.5) -> Walk:
    """Along a street between two rows of houses; the camera looks ahead."""
    random = np.random.default_rng(0)
    length = count * step + 40
    total = 1500
    side = random.choice([-1, 1], total) * random.uniform(5, 7, total)
    height, along = random.uniform((-4, 0), (1.6, length), (total, 2)).T
    xyz = np.stack([side, height, along], 1)
    sway = 0.02 * random.normal(size=(count, 3))
    centres = np.stack([0 * np.arange(count), 0 * np.arange(count), step * np.arange(count)], 1)
    return _walk(xyz, centres + 2 * sway, 0.5 * sway, random, reach=25.0)


def sideways(count: int = 12, points: int = 1500, lens: PhoneLens | FisheyeLens = ORDINARY) -> Walk:
    """Past a room, with turns: the photos determine the focal length."""
    random = np.random.default_rng(0)
    xyz = random.uniform([-6, -2.5, 4], [6, 2.5, 9], (points, 3))
    angle = np.linspace(-0.5, 0.5, count)
    centres = np.stack([6 * np.sin(angle), 0.3 * np.cos(5 * angle), 6 - 6 * np.cos(angle)], 1)
    turns = np.stack([0.1 * np.sin(9 * angle), angle, 0 * angle], 1)
    return _walk(xyz, centres, turns, random, reach=100.0, lens=lens)


def facing(count: int = 12) -> Walk:
    """Steps to all sides before a wall, without turns: fx and fy are hardly determined."""
    random = np.random.default_rng(2)
    xyz = random.uniform([-5, -4, 6], [5, 4, 9], (300, 3))
    centres = np.concatenate([random.uniform(-1.2, 1.2, (count, 2)), np.zeros((count, 1))], 1)
    walk = _walk(xyz, centres, 0.01 * random.normal(size=(count, 3)), random, reach=100.0)
    for pixels in walk.pixels:
        pixels += random.normal(0, 0.6, pixels.shape)
    return walk


def zoomed(walk: Walk, zooms: np.ndarray) -> Walk:
    """``walk`` with photos of other focal lengths: ``zooms`` (N,) times `FOCAL`."""
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    pixels = [middle + zoom * (p - middle) for p, zoom in zip(walk.pixels, zooms, strict=True)]
    inside = [((p > 0) & (p < [WIDTH, HEIGHT])).all(1) for p in pixels]
    matches = {
        (i, j): rows[inside[i][rows[:, 0]] & inside[j][rows[:, 1]]]
        for (i, j), rows in walk.matches.items()
    }
    return Walk(walk.centres, pixels, matches)


def _walk(
    xyz: np.ndarray,
    centres: np.ndarray,
    turns: np.ndarray,
    random: np.random.Generator,
    reach: float,
    lens: PhoneLens | FisheyeLens = ORDINARY,
) -> Walk:
    """``turns``: (N, 3) rotation vectors of the cameras; ``reach``: depth up to which they see."""
    seen, pixels = [], []
    for centre, turn in zip(centres, turns, strict=True):
        local = (xyz - centre) @ pycolmap.Rotation3d(turn).matrix().T
        pixel = lens.project(local.T).T
        inside = (local[:, 2] > 1) & ((pixel > 0) & (pixel < [WIDTH, HEIGHT])).all(1)
        inside &= local[:, 2] < reach
        seen.append(np.flatnonzero(inside))
        pixels.append(pixel[inside] + random.normal(0, 0.3, (inside.sum(), 2)))
    matches = {}
    for i in range(len(centres)):
        for j in range(i + 1, min(i + 5, len(centres))):
            _, one, two = np.intersect1d(seen[i], seen[j], return_indices=True)
            if len(one) >= 30:
                matches[i, j] = np.stack([one, two], 1).astype(np.uint32)
    return Walk(centres, pixels, matches)
