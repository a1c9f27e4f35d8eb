"""Whether the photos of a camera have one focal length, or several.

Photos without EXIF may have been taken with different zooms, or by different devices that store
photos of the same size; and one can zoom while filming. With one focal length for all of them, the
model is bent, or a part of the photos has no pose. A photo with a zoom of 1.6 is then placed 1.6
times as near, so neither its pose nor its reprojection error shows the mistake.

Therefore each photo gets a focal length of its own, and bundle adjustment estimates all of them,
together with poses and points (`own_focals`). These estimates agree within 1% if the photos have
one focal length and determine it, also if the camera focuses while filming. If they form separate
groups, `group_by_zoom` gives each group a camera of its own. The groups are only a proposal: a flat
scene does not determine the focal length of each photo. Whether the groups are right is decided by
the `score` of the model that is estimated with them.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from snowsplat.sfm.colmap.lenses.lens import TOLERANCE, camera_ids, robust_adjustment, used_cameras
from snowsplat.sfm.ingest.photo import Photo

# Focal lengths of two groups differ by at least this factor. Smaller differences have little effect
# on the poses, and focusing has this effect, too.
_MIN_ZOOM = 1.05
# If the focal lengths of a group differ by more than this factor, the camera zoomed while filming,
# and each photo has a focal length of its own.
_MAX_ZOOM_IN_GROUP = 1.15
# Number of points of each photo with which its focal length is estimated.
_POINTS = 150
# A focal length that is estimated with fewer points is not used.
_MIN_POINTS = 30
# A point that only two photos see has a small error even if the focal length is wrong.
_MIN_PHOTOS_OF_POINT = 3
# Several focal lengths fit better if the errors are smaller by at least this share. More parameters
# always make them a bit smaller.
_MIN_GAIN = 0.1
_NAMED = 4  # focal lengths that are listed one by one


def may_differ(photos: Sequence[Photo]) -> bool:
    """Whether photos that share a camera may have different focal lengths.

    A camera of which EXIF has the focal lengths has only one: see `Photo.group`.
    """
    return any(photo.focal is None and not photo.panorama for photo in photos)


def separate(photos: Sequence[Photo]) -> list[Photo]:
    """``photos`` with a camera for each of them."""
    return [_in_group(photo, f"photo {number}") for number, photo in enumerate(photos)]


def own_focals(model: pycolmap.Reconstruction, threads: int) -> dict[int, float]:
    """The focal length of each photo, if the photos need not have the same one.

    Runs bundle adjustment with a camera for each photo, on a part of the points. ``model`` is not
    changed.

    Returns: image id -> focal length in pixels, of photos that have a pose and enough points.
    Empty: the focal lengths of ``model`` agree nearly as well with the matches.
    """
    part = _with_separate_cameras(model)
    part.update_point_3d_errors()
    before = part.compute_mean_reprojection_error()
    options = robust_adjustment(threads, TOLERANCE, before)
    # With a distortion for each photo, the focal lengths are less well determined.
    options.refine_extra_params = False
    pycolmap.bundle_adjustment(part, options)
    part.update_point_3d_errors()
    gain = 1 - part.compute_mean_reprojection_error() / before if before else 0.0
    return focals_of(part) if gain > _MIN_GAIN else {}


def focals_of(model: pycolmap.Reconstruction) -> dict[int, float]:
    """The focal length of the camera of each photo that has enough points, by image id."""
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {
        image.image_id: model.cameras[image.camera_id].mean_focal_length()
        for image in images
        if image.num_points3D >= _MIN_POINTS and not model.cameras[image.camera_id].is_spherical()
    }


def group_by_zoom(photos: Sequence[Photo], focals: Mapping[int, float]) -> list[Photo] | None:
    """``photos`` with a group for each zoom of their cameras; None: all cameras have one.

    Args:
        photos: the photo with the index i has the image id i + 1.
        focals: the focal lengths of photos in pixels, by image id. A photo that is not in it gets a
            camera of its own if its camera has several zooms.
    """
    cameras = camera_ids(photos)
    made = list(photos)
    for camera in sorted(set(cameras)):
        indices = [i for i, number in enumerate(cameras) if number == camera]
        known = [i for i in indices if i + 1 in focals and photos[i].focal is None]
        zooms = _clusters(np.array([np.log(focals[i + 1]) for i in known]))
        if len(set(zooms)) > 1:
            names = {i: f"photo {i}" for i in indices if photos[i].focal is None}
            names |= {i: f"zoom {zoom}" for i, zoom in zip(known, zooms, strict=True)}
            for i, name in names.items():
                made[i] = _in_group(photos[i], name)
    return None if made == list(photos) else made


def describe(model: pycolmap.Reconstruction) -> str:
    """The focal lengths of the cameras of ``model``, as text for users; empty: only one."""
    cameras = [model.cameras[i] for i in used_cameras(model)]
    cameras = [camera for camera in cameras if not camera.is_spherical()]
    distinct = sorted({round(camera.mean_focal_length()) for camera in cameras})
    if len(distinct) < 2:
        return ""
    if len(distinct) > _NAMED:
        return f"focal lengths from {distinct[0]} to {distinct[-1]} pixels"
    return f"focal lengths of {', '.join(map(str, distinct[:-1]))} and {distinct[-1]} pixels"


def _clusters(values: np.ndarray) -> list[int]:
    """The cluster of each of the logarithms of focal lengths ``values`` (N,)."""
    order = np.argsort(values, kind="stable")
    cuts = np.flatnonzero(np.diff(values[order]) > np.log(_MIN_ZOOM)) + 1
    numbers = np.zeros(len(values), int)
    count = 0
    for part in np.split(order, cuts):
        wide = len(part) > 0 and np.ptp(values[part]) > np.log(_MAX_ZOOM_IN_GROUP)
        numbers[part] = count + np.arange(len(part)) if wide else count
        count += len(part) if wide else 1
    return numbers.tolist()


def _with_separate_cameras(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with a camera for each photo, of the points that are in the most photos."""
    counts = dict.fromkeys(model.reg_image_ids(), 0)
    chosen = []
    features: dict[int, list[int]] = {i: [] for i in counts}  # of each photo, of the chosen points
    for point in sorted(model.points3D.values(), key=lambda point: -point.track.length()):
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        photos = {image_id for image_id, _ in elements}
        if len(photos) < _MIN_PHOTOS_OF_POINT or min(counts[i] for i in photos) >= _POINTS:
            continue
        track = pycolmap.Track()
        for image_id, feature in elements:
            track.add_element(image_id, len(features[image_id]))
            features[image_id].append(feature)
        chosen.append((point, track))
        for i in photos:
            counts[i] += 1
    made = pycolmap.Reconstruction()
    for image_id, rows in features.items():
        image = model.image(image_id)
        camera = pycolmap.Camera(model.cameras[image.camera_id].todict() | {"camera_id": image_id})
        made.add_camera_with_trivial_rig(camera)
        copied = pycolmap.Image(name=image.name, camera_id=image_id, image_id=image_id)
        points = image.points2D
        copied.points2D = pycolmap.Point2DList([pycolmap.Point2D(points[row].xy) for row in rows])
        made.add_image_with_trivial_frame(copied, image.cam_from_world())
    for point, track in chosen:
        made.add_point3D(point.xyz, track, point.color)
    return made


def _in_group(photo: Photo, name: str) -> Photo:
    return dataclasses.replace(photo, group=f"{photo.group} {name}")
