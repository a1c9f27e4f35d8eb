"""The verified matches of two photos, and how far they are from where the poses of a model say."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.data.lens.models import lens_of
from snowsplat.scene.epipolar import Floats, distances_of_matches
from snowsplat.sfm.colmap.database import closing_database, verified_pairs
from snowsplat.sfm.colmap.lenses.lens import is_fisheye, pixels_per_radian

Ints = NDArray[np.integer[Any]]


@dataclass(frozen=True)
class PairMatches:
    """Of two photos: image ids, and the positions (M, 2) of the matched features in pixels.
    ``features``: (M, 2) the indices of these features in their photos."""

    first: int
    second: int
    in_first: Floats
    in_second: Floats
    features: Ints

    def rays(self, model: pycolmap.Reconstruction) -> tuple[Floats, Floats]:
        """`rays_of` the matches in the cameras of ``model``."""
        one, two = (model.camera(model.image(i).camera_id) for i in (self.first, self.second))
        return rays_of(one, self.in_first), rays_of(two, self.in_second)

    def distances(self, model: pycolmap.Reconstruction) -> tuple[Floats, float]:
        """(M,) Sampson distances from the epipolar lines of the poses in pixels, infinite for rays
        that do not meet in front of both cameras; and the longer side of the photos in pixels."""
        images = model.image(self.first), model.image(self.second)
        one, two = (model.camera(image.camera_id) for image in images)
        pose = images[1].cam_from_world() * images[0].cam_from_world().inverse()
        focal = (pixels_per_radian(one) + pixels_per_radian(two)) / 2
        rotation, translation = pose.rotation.matrix(), pose.translation
        distance = focal * distances_of_matches(rotation, translation, *self.rays(model))
        return distance, (max(one.width, one.height) + max(two.width, two.height)) / 2


def read_matches(database: Path) -> list[PairMatches]:
    """The verified matches of all pairs of photos, sorted by their image ids."""
    made = []
    with closing_database(database) as source:
        pixels: dict[int, Floats] = {}
        for pair in sorted(verified_pairs(database), key=lambda pair: (pair.first, pair.second)):
            both = pair.first, pair.second
            for i in both:
                if i not in pixels:
                    pixels[i] = source.read_keypoints(i)[:, :2].astype(np.float64)
            rows = source.read_two_view_geometry(*both).inlier_matches
            one, two = (pixels[i][rows[:, k]] for k, i in enumerate(both))
            made.append(PairMatches(*both, one, two, rows))
    return made


def rays_of(camera: pycolmap.Camera, pixels: Floats) -> Floats:
    """The positions (N, 2) of ``pixels`` (N, 2) in the normalised image plane of a camera.

    For a fisheye lens or a panorama, unit vectors (N, 3): its pixels are angles, up to 90° or more
    to its axis, where COLMAP's are wrong. NaN where the model is not defined.
    """
    if not (is_fisheye(camera.model_name) or camera.is_spherical()):
        return np.asarray(camera.cam_from_img(pixels))
    return lens_of(camera.model_name, camera.width, camera.height, camera.params).directions(pixels)
