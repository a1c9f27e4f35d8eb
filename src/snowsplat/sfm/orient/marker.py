"""Scale and planes of printed ArUco markers, whose side length is known.

A marker in several photos is a square with a pose and a side in the world of SfM: 7 unknowns, to
which its corners in the photos are fitted by robust least squares. All dictionaries are tried. A
pattern that looks like a marker in one photo is no square in the others, so it is not used. The
corners are those of S. Garrido-Jurado et al., "Automatic generation and detection of highly
reliable fiducial markers under occlusion", Pattern Recognition 2014, as OpenCV implements it.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from snowsplat.sfm.colmap.features.sift import read_grey
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.orient.up import CONTRADICTION, FEWEST, tangent
from snowsplat.util.messages import Message, message, plural

if TYPE_CHECKING:
    import pycolmap

# Larger ones contain the smaller ones of the same kind. With 1000 markers of 4x4 bits, many things
# would look like one of them.
_DICTIONARIES = (
    "DICT_4X4_250",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
)
_SIDE = 1600  # longer side of the photos in which markers are searched, pixels
# A view is wrong if its corners are farther from the square than this, in pixels of the search or
# as a share of the marker's side in the photo, whichever is larger.
_WRONG, _WRONG_SHARE = 2.0, 0.05
_MOST_WRONG = 0.4  # share of the views of a marker
_PIXEL = 0.3  # expected error of a corner, in pixels of the search
_STEPS = 30
# All edges of a print or a photo may be moved outwards, by ink, light and sharpening: this many
# pixels of the search, and this share of the side.
_COMMON_PIXELS, _COMMON = 0.1, 0.001
# To find an edge: the exponent of sRGB; the pixels on each side of it that are looked at, at most,
# at least, and as a share of the black border; and the least contrast.
_GAMMA, _REACH, _LEAST_REACH, _BORDER, _CONTRAST = 2.2, 4.0, 1.0, 0.45, 0.02
_LEAST_AGREEMENT = 0.01  # markers whose sides differ by a smaller share agree
# Corners of a marker in units of its side, clockwise from the upper left as OpenCV returns them.
_SQUARE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])


@dataclass(frozen=True)
class MarkerScale:
    """The scale that the markers tell, and how they lie."""

    metres_per_unit: float  # of the world of SfM
    error: float  # relative standard deviation
    name: Message  # as text for users: the markers and the number of photos
    normals: np.ndarray  # (M, 3) unit vectors in the world of SfM, away from the paper
    tilts: np.ndarray  # (M,) their standard deviations, radians


@dataclass(frozen=True)
class _Seen:
    """A marker in a photo."""

    rays: np.ndarray  # (4, 2) x / z and y / z of its corners
    cam_from_world: np.ndarray  # (3, 4)
    focal: float  # pixels of the search in a unit of ``rays``

    @property
    def size(self) -> float:
        """The mean side in pixels of the search."""
        sides = np.linalg.norm(self.rays - np.roll(self.rays, 1, axis=0), axis=1)
        return self.focal * float(sides.mean())


@dataclass(frozen=True)
class _Square:
    """A marker in the world of SfM."""

    side: float
    error: float  # relative standard deviation of the side
    photos: int
    pixels: float  # the median side in the photos
    normal: np.ndarray  # (3,) unit vector, away from the paper
    tilt: float  # its standard deviation, radians


def scale_of_markers(
    model: pycolmap.Reconstruction, photos: Sequence[Photo], folder: Path, side: float
) -> tuple[MarkerScale | None, list[Message]]:
    """The scale of a model and the planes of the markers, and doubts as text for users.

    Args:
        photos: those of the model; panoramas are not searched.
        folder: of the photos.
        side: of the black squares, in metres.
    """
    searched = {photo.name for photo in photos if not photo.panorama}
    images = [model.images[i] for i in model.reg_image_ids()]
    images = [image for image in images if image.name in searched]

    def search(image: pycolmap.Image) -> list[tuple[str, _Seen]]:
        camera = model.cameras[image.camera_id]
        return _find_markers(folder / image.name, camera, image.cam_from_world().matrix())

    # OpenCV releases the GIL.
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        found = [each for of_photo in pool.map(search, images) for each in of_photo]
    views: dict[str, list[_Seen]] = {}
    for name, seen in found:
        views.setdefault(name, []).append(seen)
    squares = {name: square for name, s in sorted(views.items()) if (square := _square(s))}
    if not squares:
        most = max(map(len, views.values()), default=0)
        why = message("no photo shows a marker")
        if 0 < most < FEWEST:
            why = plural("a marker is in {n} photo only", "a marker is in {n} photos only", n=most)
        elif most:
            why = message("no marker is a square in {n} photos", n=FEWEST)
        return None, [
            message(
                "the marker gives no scale: {why}; take more photos of it from near, or use "
                "snowsplat convert --scale-to with a known distance",
                why=why,
            )
        ]
    # People print from one dictionary. Other patterns may look like a marker of another one.
    kinds = Counter[str]()
    for name, square in squares.items():
        kinds[name.split()[0]] += square.photos
    kind = kinds.most_common(1)[0][0]
    return _combine({n: s for n, s in squares.items() if n.split()[0] == kind}, side)


def _combine(squares: dict[str, _Square], side: float) -> tuple[MarkerScale | None, list[Message]]:
    """One scale from all markers, weighted by their errors."""
    sides = np.array([square.side for square in squares.values()])
    errors = np.array([square.error for square in squares.values()])
    middle = np.exp(np.average(np.log(sides), weights=errors**-2))
    error = float(1 / np.sqrt((errors**-2).sum()))
    away = np.abs(np.log(sides / middle))
    doubts = []
    if (away > np.maximum(CONTRADICTION * np.hypot(errors, error), _LEAST_AGREEMENT)).any():
        ratio = 100 * (sides.max() / sides.min() - 1)
        doubts.append(
            message(
                "the markers disagree about the scale by {ratio:.1f}%: are all of them of one "
                "size?",
                ratio=float(ratio),
            )
        )
        error = max(error, float(away.max()))
    count = sum(square.photos for square in squares.values())
    what = message("the marker {name}", name=next(iter(squares)))
    if len(squares) > 1:
        what = message("{n} markers", n=len(squares))
    common = np.hypot(_COMMON, 2 * _COMMON_PIXELS / max(s.pixels for s in squares.values()))
    name = message(
        "{what} of {side:.4g} mm in {count} views", what=what, side=1000 * side, count=count
    )
    normals = np.array([square.normal for square in squares.values()])
    tilts = np.array([square.tilt for square in squares.values()])
    relative = float(np.hypot(error, common))
    return MarkerScale(side / float(middle), relative, name, normals, tilts), doubts


def _find_markers(
    path: Path, camera: pycolmap.Camera, cam_from_world: np.ndarray
) -> list[tuple[str, _Seen]]:
    """The markers in a photo, by dictionary and number."""
    grey, _ = read_grey(path, _SIDE)
    stretch = np.array([camera.width, camera.height]) / grey.shape[::-1]
    light = (grey.astype(np.float32) / 255) ** _GAMMA
    detector = cv2.aruco.DetectorParameters()
    found = []
    for name in _DICTIONARIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, detector).detectMarkers(grey)
        for square, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
            exact = _refine_corners(
                light, square.reshape(4, 2).astype(np.float64), dictionary.markerSize
            )
            if exact is None:
                continue
            # OpenCV counts from the centre of the first pixel, COLMAP from its corner.
            pixels = (exact + 0.5) * stretch
            rays = camera.cam_from_img(pixels)
            if rays is None or not np.isfinite(rays).all():
                continue
            focal = camera.mean_focal_length() / float(stretch.mean())
            kind = name.removeprefix("DICT_").removesuffix("_1000").removesuffix("_250")
            found.append((f"{kind} {number}", _Seen(np.asarray(rays), cam_from_world, focal)))
    return found


def _refine_corners(light: np.ndarray, corners: np.ndarray, bits: int) -> np.ndarray | None:
    """(4, 2) the corners of a marker where lines along its sides meet; None if they do not.

    A corner is rounded by blur, an edge is not moved by it. Across each side, the share of dark
    light in a profile tells where the edge is. ``light`` (H, W) is linear, ``corners`` are those of
    the detector; the marker has ``bits`` cells a side and a black border of one cell.
    """
    points, directions = [], []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        reach = min(_REACH, _BORDER * length / (bits + 2))
        if reach < _LEAST_REACH:
            return None
        along = (b - a) / length
        out = np.array([along[1], -along[0]])  # the corners are clockwise, y points down
        places = a + np.linspace(0.1, 0.9, max(8, int(length)))[:, None] * (b - a)
        for _ in range(2):
            offsets = np.linspace(-reach, reach, 33)
            grid = places[:, None] + offsets[:, None] * out
            x, y = grid.astype(np.float32).transpose(2, 0, 1)
            profile = cv2.remap(light, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            dark, bright = np.median(profile[:, :4]), np.median(profile[:, -4:])
            if not bright - dark > _CONTRAST:
                return None
            edges = reach * (1 - 2 * ((profile - dark) / (bright - dark)).mean(axis=1))
            middle = places + edges[:, None] * out
            used = np.abs(edges - np.median(edges)) < 0.5 * reach
            centre = middle[used].mean(axis=0)
            along = np.linalg.svd(middle[used] - centre)[2][0]
            out = np.array([along[1], -along[0]]) * np.sign(out @ (along[1], -along[0]))
            places = centre + ((places - centre) @ along)[:, None] * along
        points.append(centre)
        directions.append(along)
    found = []
    for i in range(4):
        # The corner i ends the side before it and begins its own.
        matrix = np.stack([directions[i - 1], -directions[i]], axis=1)
        if abs(np.linalg.det(matrix)) < 0.1:
            return None
        found.append(
            points[i - 1]
            + np.linalg.solve(matrix, points[i] - points[i - 1])[0] * directions[i - 1]
        )
    moved = np.linalg.norm(np.array(found) - corners, axis=1)
    return np.array(found) if moved.max() < 2 * _REACH else None


def _square(seen: list[_Seen]) -> _Square | None:
    """The square that most of the views show; None if there is none."""
    used = np.ones(len(seen), bool)
    fitted = None
    for _ in range(len(seen)):
        if used.sum() < FEWEST:
            return None
        chosen = [view for view, use in zip(seen, used, strict=True) if use]
        start = _start(chosen)
        fitted = start and _fit(chosen, *start)
        if fitted is None:
            return None
        side, covariance, normal, away = fitted
        limits = np.array([max(_WRONG, _WRONG_SHARE * view.size) for view in chosen])
        if (away <= limits).all():
            break
        # The worst one is left out, and the rest fitted again.
        used[np.flatnonzero(used)[(away / limits).argmax()]] = False
    if fitted is None or (~used).mean() > _MOST_WRONG:
        return None
    pixels = float(np.median([view.size for view, use in zip(seen, used, strict=True) if use]))
    plane = tangent(normal)
    tilt = math.sqrt(np.linalg.eigvalsh(plane @ covariance[:3, :3] @ plane.T)[1])
    return _Square(side, math.sqrt(covariance[6, 6]), int(used.sum()), pixels, normal, tilt)


def _start(seen: list[_Seen]) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Rotation (3, 3), centre (3,) and side of a square near the triangulated corners."""
    corners = []
    for corner in range(4):
        rows = np.concatenate(
            [
                (ray[:, None] * view.cam_from_world[2] - view.cam_from_world[:2]) * view.focal
                for view in seen
                for ray in [view.rays[corner]]
            ]
        )
        matrix, right = rows[:, :3], -rows[:, 3]
        point, _, rank, _ = np.linalg.lstsq(matrix, right, rcond=1e-9)
        if rank < 3:
            return None
        corners.append(point)
    points = np.array(corners)
    centre = points.mean(axis=0)
    u, _, vt = np.linalg.svd((points - centre).T @ _SQUARE)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    side = float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).mean())
    return (rotation, centre, side) if side > 0 else None


def _fit(
    seen: list[_Seen], rotation: np.ndarray, centre: np.ndarray, side: float
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray] | None:
    """Side, covariance (7, 7), normal (3,), and (N,) the largest distance of a corner in each view,
    in pixels.

    Gauss-Newton on the reprojection errors, by rotation vector (radians), centre and log of the
    side; the covariance has the same order.
    """
    poses = np.array([view.cam_from_world for view in seen])
    measured = np.array([view.rays for view in seen])
    focal = np.array([view.focal for view in seen])[:, None, None]
    weights = np.ones((len(seen), 4))
    hessian = np.eye(7)
    for step in range(_STEPS):
        own = side * _SQUARE @ rotation.T  # (4, 3) from the centre
        points = np.einsum("nij,kj->nki", poses[:, :, :3], own + centre) + poses[:, None, :, 3]
        depth = points[..., 2:]
        if not (depth > 1e-9 * side).all():
            return None
        away = focal * (points[..., :2] / depth - measured)  # (N, 4, 2) pixels
        if step:
            weights = 1 / np.maximum(1, np.linalg.norm(away, axis=2) / (2 * _PIXEL))
        # Derivatives of the points: (4, 3, 7), then of the pixels: (N, 4, 2, 7).
        cross = np.zeros((4, 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = own[:, 2], -own[:, 1], own[:, 0]
        cross -= cross.transpose(0, 2, 1)
        moves = np.concatenate([cross, np.tile(np.eye(3), (4, 1, 1)), own[:, :, None]], axis=2)
        inside = np.einsum("nij,kjp->nkip", poses[:, :, :3], moves)
        ratio = (points[..., :2] / depth)[..., None]
        jacobian = (
            focal[..., None] * (inside[:, :, :2] - ratio * inside[:, :, 2:]) / depth[..., None]
        )
        hessian = np.einsum("nkip,nk,nkiq->pq", jacobian, weights, jacobian)
        slope = np.einsum("nkip,nk,nki->p", jacobian, weights, away)
        try:
            change = -np.linalg.solve(hessian, slope)
        except np.linalg.LinAlgError:
            return None
        rotation = cv2.Rodrigues(change[:3])[0] @ rotation
        centre = centre + change[3:6]
        side *= float(np.exp(np.clip(change[6], -0.5, 0.5)))
        if np.abs(change[[0, 1, 2, 6]]).max() < 1e-9:
            break
    distances = np.linalg.norm(away, axis=2)
    spread = max(_PIXEL, float(np.sqrt((weights * distances**2).sum() / weights.sum() / 2)))
    # The corners of one photo err together with its pose, so a photo counts as one corner.
    covariance = 4 * spread**2 * np.linalg.pinv(hessian)
    return side, covariance, -rotation[:, 2], distances.max(axis=1)
