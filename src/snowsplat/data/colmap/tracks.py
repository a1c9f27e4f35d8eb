"""The points of a COLMAP model, with the observations of some of them in its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from snowsplat.data.colmap.model import read_observations, read_point_file
from snowsplat.data.colmap.types import ColmapModel, PointFile
from snowsplat.data.dataset import Points, Tracks, usable_points

# Images whose observations are read, spread over the model.
_MOST_IMAGES = 100
# Share of the observations of tracks that must name the point of their track. If it is less, the
# points or the images were replaced.
_LEAST_VALID = 0.5


def points_with_tracks(model: ColmapModel, names: Mapping[int, str]) -> Points | None:
    """The points of a model, with `Points.tracks` if its images have their observations.

    Args:
        model: of which the points are read.
        names: of views, by the ids of the images that are used.

    Raises: UserError: a file is damaged.
    """
    if (found := read_point_file(model.folder)) is None:
        return None
    path, file = found
    points = usable_points(path, file.xyz, file.rgb)
    if points is None or len(points) < len(file.xyz):  # those left out would have other rows
        return points
    return replace(points, tracks=_tracks(model, names, file))


def _tracks(model: ColmapModel, names: Mapping[int, str], file: PointFile) -> Tracks | None:
    seen = file.tracks[np.isin(file.tracks[:, 1], list(names))]
    images = np.unique(seen[:, 1])
    images = images[:: -(-len(images) // _MOST_IMAGES) or 1]
    seen = seen[np.isin(seen[:, 1], images)]
    if not len(seen):
        return None
    rows = {int(image): seen[seen[:, 1] == image] for image in images}
    observed = read_observations(model, {image: track[:, 2] for image, track in rows.items()})
    used = (image for image in model.images if image.number in names)
    cameras = {image.number: model.cameras[image.camera_id] for image in used}
    rays, points, photos, valid = [], [], [], 0
    for number, (image, track) in enumerate(rows.items()):
        found = observed[image]
        known = found[:, 2] == file.ids[track[:, 0]]
        valid += int(known.sum())
        ray = cameras[image].unproject(found[known, :2])
        rays.append(ray)
        points.append(track[known, 0])
        photos.append(np.full(len(ray), number))
    if valid < _LEAST_VALID * len(seen):
        return None
    ray, point, photo = np.concatenate(rays), np.concatenate(points), np.concatenate(photos)
    usable = np.isfinite(ray).all(1)
    return Tracks([names[image] for image in rows], photo[usable], point[usable], ray[usable])
