"""`track_fit`: are the points where the observations that came with them say?

Programs that reconstruct a scene write where each photo shows each point. For a model as it was
written, the typical distance to the projected point is below 2 pixels. It is more if poses, points
or intrinsics were changed later, each in another way, or lost digits.

The photos may have been changed later, too, together with the intrinsics: scaled, cropped or
undistorted. Then the observations are those of other pictures. As these were made by the same
camera, one smooth function maps the projected points to the observations, for all its photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snowsplat.data.dataset import Points, View
from snowsplat.data.judge.finding import Finding
from snowsplat.data.judge.rig import Rig

# Distance relative to the longer side of the photo: 10 pixels of 1000. Programs discard
# observations that are more than 4 to 16 pixels away; the typical distance is far less.
_OFF = 0.01
# Observations that a photo needs to be judged, and photos.
_FEWEST, _FEWEST_PHOTOS = 10, 3
# A model with fewer photos off is as good as its program made it.
_SHARE_OFF = 0.1
# A function that maps the points to the observations leaves at most this share of the distances.
_LEFT = 1 / 3
# Its linear part is a diagonal matrix, up to this: no photo is turned.
_TURNED = 0.1
# A point is fixed if it moves by less, relative to the size of the photo. To scale a photo keeps
# its corner, and to remove distortion keeps the principal point.
_FIXED = 0.02
# Share of observations outside of the photos if these were cropped.
_CROPPED = 0.01
# A factor to the focal length by which calibrations do not differ, and the distance that is left.
_FOCAL, _EXACT = 1.1, 0.003
_ITERATIONS = 10


@dataclass(frozen=True)
class TrackFit:
    """Points that are not where they were observed.

    Attributes:
        photos: number of photos with enough observations.
        off: number of those with a typical distance of more than 1% of the longer side.
        distance: the typical distance in those, relative to the longer side; infinite if most
            points are behind the cameras.
        focal: the focal length divided by the right one, if this explains the distances.
    """

    photos: int
    off: int
    distance: float
    focal: float | None = None

    def finding(self, *, impossible: bool) -> Finding:
        """What is wrong, for the user."""
        if self.focal is not None:
            text = (
                f"the focal length is {self.focal:.2f} of the one that the points were computed "
                "with; use cameras, images and points of one model"
            )
            return Finding("focal length", text)
        place = (
            "behind the camera"
            if np.isinf(self.distance)
            else f"{self.distance:.1%} of the size of the photo away from where it was observed"
        )
        text = (
            f"poses and points do not fit each other: in {self.off} of {self.photos} photos, a "
            f"typical point is {place}; they were changed, or lost digits, after the "
            "reconstruction; export both again, in one frame near the origin"
        )
        return Finding("poses", text, impossible)


@dataclass(frozen=True)
class _Photo:
    """Points in front of a camera, projected and observed (N, 2), relative to the principal point
    and to the size of the photo."""

    typical: float  # distance relative to the longer side; infinite if most points are behind
    projected: np.ndarray
    observed: np.ndarray


def track_fit(views: Sequence[View], rig: Rig, points: Points | None) -> TrackFit | None:
    """None: the cameras fit the observations, or these are too few.

    Args:
        views: the views of the dataset.
        rig: their cameras.
        points: with or without tracks.
    """
    tracks = None if points is None else points.tracks
    if points is None or tracks is None:
        return None
    number = {view.name: i for i, view in enumerate(views)}
    xyz = points.xyz.numpy().astype(np.float64)[tracks.point]
    cameras: dict[bytes, tuple[np.ndarray, list[_Photo]]] = {}
    for photo, name in enumerate(tracks.photos):
        chosen = np.flatnonzero(tracks.photo == photo)
        if (view := number.get(name)) is None or len(chosen) < _FEWEST:
            continue
        where, depth = rig.project(view, xyz[chosen])
        projected, observed = where - rig.centre[view], tracks.ray[chosen] * rig.focal[view]
        distance = np.linalg.norm((projected - observed) * rig.aspect[view], axis=1)
        front = depth > 0
        typical = float(np.median(np.where(front, distance, np.inf)))
        key = np.concatenate([rig.focal[view], rig.centre[view], rig.aspect[view]]).tobytes()
        _, photos = cameras.setdefault(key, (rig.centre[view], []))
        photos.append(_Photo(typical, projected[front], observed[front]))
    count = sum(len(photos) for _, photos in cameras.values())
    if count < _FEWEST_PHOTOS:
        return None
    off: list[float] = []
    focal: list[float] = []
    for centre, photos in cameras.values():
        wrong = [photo.typical for photo in photos if not photo.typical <= _OFF]
        if np.isinf(wrong).any():
            off += wrong
        elif wrong and (factor := _focal(photos)) is not None:
            focal += [factor] * len(wrong)
        elif wrong and not _other_pictures(photos, centre):
            off += wrong
    if len(off) > _SHARE_OFF * count:
        return TrackFit(count, len(off), float(np.median(off)))
    if len(focal) > _SHARE_OFF * count:
        return TrackFit(count, len(focal), 0.0, float(np.median(focal)))
    return None


def _focal(photos: Sequence[_Photo]) -> float | None:
    """The focal length of a camera divided by the right one, if only this is wrong."""
    projected = np.concatenate([photo.projected for photo in photos])
    observed = np.concatenate([photo.observed for photo in photos])
    ((scale,),), left = _robust_fit(projected.reshape(-1, 1), observed.reshape(-1, 1))
    wrong = scale > 0 and not 1 / _FOCAL <= scale <= _FOCAL
    return 1 / float(scale) if wrong and left < _EXACT else None


def _other_pictures(photos: Sequence[_Photo], centre: np.ndarray) -> bool:
    """Whether the observations are those of photos of another size, part or distortion.

    Args:
        photos: of one camera.
        centre: (2,) its principal point, relative to the size of the photo.
    """
    projected = np.concatenate([photo.projected for photo in photos])
    observed = np.concatenate([photo.observed for photo in photos])
    r2 = (projected**2).sum(1, keepdims=True)
    basis = np.hstack([np.ones_like(r2), projected, r2 * projected, r2**2 * projected])
    coefficients, left = _robust_fit(basis, observed)
    before = float(np.median(np.linalg.norm(projected - observed, axis=1)))
    linear, shift = coefficients[1:3], coefficients[0]
    diagonal = linear.diagonal()
    turned = np.abs(linear - np.diag(diagonal)).max() > _TURNED * np.abs(diagonal).max()
    if left > _LEFT * before or diagonal.min() <= 0 or turned:
        return False
    corner = shift - centre * (diagonal - 1)  # where the function moves the upper left corner
    inside = ((observed > -centre) & (observed < 1 - centre)).all(1)
    return bool(
        np.abs(shift).max() < _FIXED or np.abs(corner).max() < _FIXED or np.mean(~inside) > _CROPPED
    )


def _robust_fit(basis: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """The coefficients (B, C) with which the basis (N, B) fits values (N, C), most of which are
    right; and the median distance that is left."""
    weights = np.ones((len(values), 1))
    for _ in range(_ITERATIONS):
        coefficients = np.linalg.lstsq(weights * basis, weights * values, rcond=None)[0]
        rest = np.linalg.norm(values - basis @ coefficients, axis=1, keepdims=True)
        # Geman and McClure's weight is the square of this; it is applied to both sides.
        scale = max(2 * float(np.median(rest)), 1e-6)
        weights = 1 / (1 + (rest / scale) ** 2)
    return coefficients, float(np.median(rest))
