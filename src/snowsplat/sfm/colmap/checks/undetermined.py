"""Finds the photos whose positions the points of a model do not determine.

If a group of photos has points in common with one other photo only, the group may have any size: it
may grow or shrink about that photo, with the same reprojection errors. No point contradicts it, so
its positions are wrong, and nothing else tells.

The errors of the positions are those of bundle adjustment with known rotations, which are better
determined than positions. A point X is seen from the centre C in the direction u, at the distance
z, with a focal length of f pixels and a standard deviation of σ pixels (from the residuals). If
both move, the observation changes by

    f / (σ z) (1 − u uᵀ) (dX − dC),

in units of σ. Without the points (Schur complement), the normal matrix of all centres remains. Its
kernel is the frame of the world, which observations do not determine: an origin and a scale. In the
frame of the photos K, the covariance is T C Tᵀ with T = 1 − G G_K⁺, where C is that of any frame, G
has the motions of the frame as columns, and G_K⁺ is the pseudo-inverse of its rows of K (Baarda,
"S-transformations and criterion matrices", 1973). K are the photos of the largest group in which
all positions are determined.
"""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.scene.epipolar import Floats
from snowsplat.sfm.colmap.lenses.lens import pixels_per_radian
from snowsplat.sfm.colmap.lenses.posterior import OVERDISPERSION

# The error of a determined position is less than the median distance of the photos from their
# middle. Measured: at most 0.18 of it in 240 right models of 27 captures; 10 to 1100 in groups that
# have a wrong size.
_DETERMINED = 1.0
# Larger models are not examined. The time grows with the cube of the number: 0.7 s for 400 photos.
_MOST_PHOTOS = 1000
# Precision of what no observation determines, relative to the largest one of all positions, and to
# that of a point: above the errors of rounding.
_LEAST, _LEAST_OF_POINT = 1e-14, 1e-12


def undetermined_photos(model: pycolmap.Reconstruction) -> dict[int, float]:
    """The photos whose positions have errors above their extent; none of more than `_MOST_PHOTOS`.

    Returns: image id -> standard deviation of the position, in units of the median distance of the
        photos from their middle.
    """
    ids = sorted(model.reg_image_ids())
    points = [each for each in model.points3D.values() if each.track.length() > 1]
    if not 3 <= len(ids) <= _MOST_PHOTOS or not points:
        return {}
    centres = np.array([model.image(i).projection_center() for i in ids])
    middle = np.median(centres, 0)
    centres -= middle
    frame = np.zeros((len(ids), 3, 4))
    frame[:, :, :3], frame[:, :, 3] = np.eye(3), centres
    index = {image_id: row for row, image_id in enumerate(ids)}
    tracks = [[index[e.image_id] for e in point.track.elements] for point in points]
    focal = np.array([pixels_per_radian(model.camera(model.image(i).camera_id)) for i in ids])
    noise = max(1e-9, float(np.sqrt(np.mean([point.error**2 for point in points]) / 2)))
    xyz = np.array([point.xyz for point in points]) - middle
    covariance = _covariance(_normal_matrix(centres, focal / noise, xyz, tracks), frame)
    size = float(np.median(np.linalg.norm(centres, axis=1)))
    errors, group = _largest_group(covariance, frame, _DETERMINED * size / OVERDISPERSION)
    errors *= OVERDISPERSION / size
    return {i: float(errors[row]) for row, i in enumerate(ids) if not group[row]}


def _normal_matrix(
    centres: Floats, precision: Floats, xyz: Floats, tracks: list[list[int]]
) -> Floats:
    """(3N, 3N) of the ``centres`` (N, 3).

    Args:
        precision: (N,) f / σ of each photo, per radian.
        xyz: (P, 3) points.
        tracks: the photos of each point.
    """
    lengths = np.array([len(track) for track in tracks])
    photo = np.concatenate(tracks).astype(np.intp)
    point = np.repeat(np.arange(len(tracks)), lengths)
    ray = xyz[point] - centres[photo]
    depth = np.linalg.norm(ray, axis=1)
    depth = np.maximum(depth, 1e-12 * depth.max())
    ray /= depth[:, None]
    slope = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    # (1 − u uᵀ) is its own square, so this is the normal matrix of each observation.
    slope *= ((precision[photo] / depth) ** 2)[:, None, None]
    of_points = np.zeros((len(tracks), 3, 3))
    np.add.at(of_points, point, slope)
    of_points += _LEAST_OF_POINT * np.einsum("nii->n", of_points)[:, None, None] * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(of_points))  # LᵀL is the inverse of these
    factors = slope @ root[point].transpose(0, 2, 1)
    count = len(centres)
    blocks = np.zeros((count * count, 3, 3))
    np.add.at(blocks, photo * (count + 1), slope)
    for length in np.unique(lengths).tolist():
        rows = np.flatnonzero(lengths == length)
        which = np.searchsorted(point, rows)[:, None] + np.arange(length)
        for one in range(length):
            for other in range(length):
                a, b = which[:, one], which[:, other]
                product = factors[a] @ factors[b].transpose(0, 2, 1)
                np.subtract.at(blocks, photo[a] * count + photo[b], product)
    return blocks.reshape(count, count, 3, 3).transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def _covariance(normal: Floats, frame: Floats) -> Floats:
    """(N, 3, N, 3) of the centres, in the frame in which all of them are fixed on average."""
    fixed, _ = np.linalg.qr(frame.reshape(len(normal), -1))
    inside = np.eye(len(normal)) - fixed @ fixed.T
    values, vectors = np.linalg.eigh(inside @ normal @ inside)
    # The frame has the four smallest values, which are zero: it is taken out again.
    made = inside @ (vectors / values.clip(_LEAST * values[-1])) @ vectors.T @ inside
    return np.asarray(made.reshape(len(frame), 3, len(frame), 3))


def _errors(covariance: Floats, frame: Floats, photos: NDArray[np.intp]) -> Floats:
    """(N,) standard deviations of the positions, in the frame of ``photos``."""
    rows = np.linalg.pinv(frame[photos].reshape(-1, 4))
    with_photos = covariance[:, :, photos].reshape(len(frame), 3, -1)
    of_photos = covariance[photos][:, :, photos].reshape(3 * len(photos), -1)
    cross = np.einsum("nik,gk,nig->n", with_photos, rows, frame, optimize=True)
    moved = np.einsum("nig,gh,nih->n", frame, rows @ of_photos @ rows.T, frame, optimize=True)
    variance = np.einsum("nini->n", covariance) - 2 * cross + moved
    return np.asarray(np.sqrt(np.maximum(variance, 0)))


def _largest_group(
    covariance: Floats, frame: Floats, limit: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """The errors of all positions in the frame of the largest group of photos whose errors, in the
    frame of two of them, are at most ``limit``; and whether those of each photo are so then."""
    group = np.ones(len(frame), bool)
    errors = _errors(covariance, frame, np.arange(len(frame)))
    if (errors <= limit).all():
        return errors, group
    # A frame is fixed by two photos: each one, and others near it and far away.
    most = 0
    for photo, centre in enumerate(frame[:, :, 3]):
        order = np.argsort(np.linalg.norm(frame[:, :, 3] - centre, axis=1), kind="stable")
        for other in {int(order[1]), int(order[len(order) // 2]), int(order[-1])} - {photo}:
            found = _errors(covariance, frame, np.array([photo, other])) <= limit
            if found.sum() > most:
                most, group = int(found.sum()), found
    errors = _errors(covariance, frame, np.flatnonzero(group))
    return errors, errors <= limit
