"""Moves the features of each point so that they show exactly the same place in all photos.

The position of a SIFT feature has an error of a few tenths of a pixel, more if its surface is seen
at different angles. The photos themselves are more accurate. So for each point, the patch of one
feature is the template, and the patches of its other features are aligned with it. The idea to
adjust the features before bundle adjustment is that of Lindenberger, Sarlin, Larsson and Pollefeys,
"Pixel-Perfect Structure-from-Motion with Featuremetric Refinement", ICCV 2021.

The patches of a point in two photos differ by the viewpoint and the exposure. `align_patches` finds
the affine transform between them by least squares matching (Gruen, "Adaptive least squares
correlation", 1985), with the inverse compositional algorithm of Baker and Matthews ("Lucas-Kanade
20 years on: a unifying framework", IJCV 2004).
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import closing_database
from snowsplat.sfm.colmap.features.sift import read_grey
from snowsplat.sfm.colmap.options import detection_size
from snowsplat.util import native_library
from snowsplat.util.native_layout import ALIGNMENT_RADIUS
from snowsplat.util.native_library import call_with_arrays, check_array

Floats = NDArray[np.floating[Any]]

_MARGIN = 6  # pixels on each side of the window, for displacement and distortion
#: Pixels along each side of a patch; the feature is in the middle of the central one.
SIDE = 2 * (ALIGNMENT_RADIUS + _MARGIN) + 1
# Standard deviation of the feature's Gaussian in pixels of its patch, unless this would enlarge the
# photo. Large features are sampled at a lower resolution, so the window covers most of them.
_SCALE_IN_PATCH = 1.5
_AT_ONCE = 256  # patches; the positions of their pixels fit into the cache of the processor


class Aligned(NamedTuple):
    """The transform between the two patches of each of N pairs.

    transform: (N, 2, 3) float32; maps (u, v, 1) in the first patch to the same place in the second
        one. Both positions are in pixels, from the centre of the patch, u to the right and v down.
    correlation: (N,) float32, -1 to 1: of the window of the first patch with the transformed second
        one; -1 if no transform was found.
    """

    transform: NDArray[np.float32]
    correlation: NDArray[np.float32]


def patch_axes(keypoints: Floats) -> Floats:
    """(N, 2, 2) the steps of the patches of ``keypoints`` (N, 6), in pixels of the photo.

    The columns are the steps from one pixel of a patch to the next one, along a row and along a
    column. Patches are turned like their features, so equal features have equal patches.
    """
    frames = keypoints[:, 2:].reshape(-1, 2, 2)
    scale = np.sqrt(np.abs(np.linalg.det(frames)))[:, None, None]
    return np.asarray(frames / scale * np.maximum(1.0, scale / _SCALE_IN_PATCH))


def cut_patches(grey: NDArray[np.uint8], positions: Floats, axes: Floats) -> NDArray[np.uint8]:
    """The patches (N, SIDE, SIDE) around ``positions`` (N, 2) in the photo ``grey`` (H, W).

    In ``positions``, the centre of the first pixel of the photo is (0.5, 0.5). ``axes`` (N, 2, 2)
    is that of `patch_axes`. If a step is 2 pixels or longer, the patch is taken from a reduced
    photo, to prevent aliasing. Outside of the photo, its border is repeated.
    """
    offset = np.arange(SIDE, dtype=np.float32) - SIDE // 2
    grid = np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)
    step = np.sqrt(np.abs(np.linalg.det(axes)))
    levels = np.floor(np.log2(np.maximum(1.0, step))).astype(int)
    patches = np.empty((len(positions), SIDE, SIDE), np.uint8)
    for level in range(levels.max(initial=0) + 1):
        if level:
            grey = np.asarray(cv2.pyrDown(grey), np.uint8)
        (chosen,) = np.nonzero(levels == level)
        for start in range(0, len(chosen), _AT_ONCE):
            rows = chosen[start : start + _AT_ONCE]
            # Pixel i of a reduced photo has its centre at that of pixel 2i of the larger one.
            centres = ((positions[rows] - 0.5) / 2**level).astype(np.float32)
            steps = (axes[rows] / 2**level).astype(np.float32)
            x, y = ((steps[:, k] @ grid.T + centres[:, k, None]).reshape(-1, SIDE) for k in (0, 1))
            cut = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            patches[rows] = cut.reshape(-1, SIDE, SIDE)
    return patches


def align_patches(patches: NDArray[np.uint8], pairs: NDArray[np.int32]) -> Aligned:
    """Align the second patch of each of ``pairs`` (N, 2) with the first one.

    ``pairs`` has indices of ``patches`` (M, SIDE, SIDE). A window of 15 x 15 pixels at the centre
    of the first patch is compared with the second one, with Gaussian weights.

    Raises:
        ValueError: a wrong shape or dtype, or an index that is out of range.
        UserError: the native library is missing or outdated.
    """
    check_array("patches", patches, (len(patches), SIDE, SIDE), np.uint8)
    check_array("pairs", pairs, (len(pairs), 2), np.int32)
    if pairs.size and not (pairs.min() >= 0 and pairs.max() < len(patches)):
        raise ValueError(f"pairs must be indices of {len(patches)} patches")
    aligned = Aligned(np.empty((len(pairs), 2, 3), np.float32), np.empty(len(pairs), np.float32))
    call_with_arrays(
        "align_patches",
        n=len(pairs),
        side=SIDE,
        patches=np.ascontiguousarray(patches),
        pairs=np.ascontiguousarray(pairs),
        transform=aligned.transform,
        correlation=aligned.correlation,
    )
    return aligned


# A feature is moved to its aligned position if both conditions hold. Otherwise it is not moved: if
# its match is false, the robust loss of the bundle adjustment reduces its effect.
_MIN_CORRELATION = 0.8
_MAX_SHIFT = 3.0  # pixels of the patch
# Number of features whose patches are in memory; each has 729 bytes. A photo is read again in each
# block that has features of it.
_BLOCK = 200_000


class _Features(NamedTuple):
    """The features that observe a point; the features of a point follow one another."""

    image: NDArray[np.int64]  # (N,) image ids
    row: NDArray[np.int64]  # (N,) indices of the features in their photos
    point: NDArray[np.int64]  # (N,) ascending, indices of the points


def align_features(
    model: pycolmap.Reconstruction, database: Path, images: Path, image_size: int, threads: int
) -> None:
    """Move the observations in ``model`` to their aligned positions. Poses and points are kept.

    Args:
        database: has the features.
        images: the folder of the photos.
        image_size: that of the detection of the features; see `detection_size`.

    Raises:
        OSError: a photo is missing.
        UserError: the native library is missing or outdated.
    """
    native_library.set_num_threads(threads)
    features = _features_of(model)
    with closing_database(database) as source:
        keypoints = {int(i): source.read_keypoints(int(i)) for i in np.unique(features.image)}
    for block in _blocks(features):
        names = {int(i): model.image(int(i)).name for i in np.unique(block.image)}
        lenses = {i: model.cameras[model.image(i).camera_id] for i in names}
        sizes = {i: detection_size(image_size, lens.is_spherical()) for i, lens in lenses.items()}
        patches = _Patches.cut(block, names, keypoints, images, sizes, threads)
        positions, good = patches.align(block)
        points = {i: model.image(i).points2D for i in names}
        (moved,) = np.nonzero(good)
        for i, row, position in zip(
            block.image[moved].tolist(), block.row[moved].tolist(), positions[moved], strict=True
        ):
            points[i][row].xy = position


def _features_of(model: pycolmap.Reconstruction) -> _Features:
    points = [model.point3D(i).track.elements for i in sorted(model.points3D)]
    rows = [(e.image_id, e.point2D_idx, k) for k, track in enumerate(points) for e in track]
    return _Features(*np.array(rows, np.int64).reshape(-1, 3).T)


def _blocks(features: _Features) -> Iterator[_Features]:
    """Parts of ``features`` with about `_BLOCK` features each, without dividing points."""
    starts = np.searchsorted(features.point, np.unique(features.point))
    block = starts[features.point] // _BLOCK
    for rows in np.split(np.arange(len(block)), np.flatnonzero(np.diff(block)) + 1):
        if len(rows):
            image, row, point = (column[rows] for column in features)
            yield _Features(image, row, point - point[0])


class _Patches(NamedTuple):
    """The patches of features."""

    patches: NDArray[np.uint8]  # (N, SIDE, SIDE)
    positions: Floats  # (N, 2) of the features, in pixels of the photos in ``images``
    axes: Floats  # (N, 2, 2) of the patches, in the same unit

    @staticmethod
    def cut(
        features: _Features,
        names: dict[int, str],
        keypoints: dict[int, Floats],
        images: Path,
        sizes: dict[int, int],
        threads: int,
    ) -> _Patches:
        count = len(features.image)
        result = _Patches(
            np.empty((count, SIDE, SIDE), np.uint8), np.empty((count, 2)), np.empty((count, 2, 2))
        )

        def cut_from(image: int) -> None:
            (chosen,) = np.nonzero(features.image == image)
            found = np.asarray(keypoints[image], np.float64)[features.row[chosen]]
            grey, size = read_grey(images / names[image], sizes[image])
            ratio = np.array(size) / grey.shape[::-1]
            found[:, :2] /= ratio
            found[:, 2:] /= ratio.mean()
            axes = patch_axes(found)
            result.patches[chosen] = cut_patches(grey, found[:, :2], axes)
            result.positions[chosen] = found[:, :2] * ratio
            result.axes[chosen] = axes * ratio[:, None]

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(cut_from, names))
        return result

    def align(self, features: _Features) -> tuple[Floats, NDArray[np.bool_]]:
        """The aligned positions (N, 2) in pixels of the photos, and (N,) which of them are good."""
        template = self._templates(features)
        (others,) = np.nonzero(template != np.arange(len(template)))
        pairs = np.stack([template[others], others], 1).astype(np.int32)
        transform, correlation = align_patches(self.patches, pairs)
        shift = transform[:, :, 2]
        positions, good = self.positions.copy(), np.ones(len(template), bool)
        positions[others] += (self.axes[others] @ shift[:, :, None])[:, :, 0]
        is_near = np.linalg.norm(shift, axis=1) <= _MAX_SHIFT
        good[others] = (correlation >= _MIN_CORRELATION) & is_near
        return positions, good

    def _templates(self, features: _Features) -> NDArray[np.int64]:
        """(N,) for each feature, the index of the feature that is the template of its point.

        Its size is closest to the (geometric) mean size of the features of the point: the surface
        is neither very near nor far away, and not foreshortened very much.
        """
        size = np.log(np.abs(np.linalg.det(self.axes)))
        mean = np.bincount(features.point, size) / np.bincount(features.point)
        order = np.lexsort((np.abs(size - mean[features.point]), features.point))
        first = order[np.searchsorted(features.point, np.arange(len(mean)))]
        return np.asarray(first[features.point])
