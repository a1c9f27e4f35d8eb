"""The pinhole views of a photo that a lens with distortion has made.

One view of the same focal length is enough for most lenses. A lens with a field of view of more
than 120°, and a panorama, become several views, which overlap and look in different directions:

    for view in lens_views(lens_of("FISHEYE", 4000, 4000, (1270, 1270, 2000, 2000))):
        view.name, view.rotation                # "front", "left" …; view_from_lens
        pixels = undistort_image(photo, view)   # see `resample`
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.pinhole import pinhole_of
from snowsplat.data.lens.positions import Positions, node_grid
from snowsplat.util.errors import Problem

# Radians: a pinhole image of a wider field has too many pixels near its border.
_WIDEST = math.radians(120.0)
# Radians, of each of several views, and how far neighbours overlap.
_VIEW_ANGLE, _OVERLAP = math.radians(96.0), math.radians(6.0)
# Directions around the optical axis, and angles to the axis, in which the field is measured.
_DIRECTIONS, _ANGLES = 72, 720
# Where the photo is compressed by more than this in the radial direction, relative to its centre,
# the model is about to fold.
_FOLD = 0.05
# The longest side of a view, in units of the longer side of the photo; as in COLMAP.
_LARGEST = 2.0
# Share of the field that views must cover.
_COVERED = 0.995
# Pixels: the error of positions from `strips`.
_POSITION_ERROR = 0.05
# Nodes are kept for so many views: 0.1 to 5 MB each.
_KEPT = 24


@dataclass(frozen=True)
class LensView:
    """A pinhole image that shows a part of the field of a lens.

    Attributes:
        lens: of the photo.
        name: unique among the views of the lens; empty if there is only one.
        width, height: in pixels, for a photo of the size of the lens.
        params: fx, fy, cx, cy in pixels.
        rotation: (3, 3) in rows, view_from_lens; None: the identity.
        circle: radius in pixels of the image circle around the principal point; None: unlimited.
        partial: some pixels show nothing of the photo; see `covered`.
        cropped: the model is valid only near the centre, so the outer part is cut off.
    """

    lens: Lens
    name: str
    width: int
    height: int
    params: tuple[float, float, float, float]
    rotation: tuple[tuple[float, ...], ...] | None = None
    circle: float | None = None
    partial: bool = False
    cropped: bool = False

    @property
    def is_photo(self) -> bool:
        """Whether the view is the whole photo, as the lens has no distortion."""
        return self.rotation is None and self.lens.is_pinhole

    @property
    def wraps(self) -> bool:
        """Whether the left border of the photo continues at its right border."""
        return self.lens.kind.panoramic

    def positions(self, width: int, height: int) -> Iterator[tuple[slice, Positions]]:
        """Rows of this view at the size ``width`` × ``height``, and the positions of their pixels
        in the photo, in pixels of the lens; NaN where there are none.

        In a panorama, a column x and a column x + lens.width are the same.
        """
        if not self._shows_pole:
            yield slice(0, height), Positions.between(_nodes(self), width, height)
            return
        # Longitude cannot be interpolated at a pole.
        for first in range(0, height, 64):
            rows = slice(first, min(first + 64, height))
            x = (np.arange(width, dtype=np.float32) + 0.5) * np.float32(self.width / width)
            y = (np.arange(*rows.indices(height), dtype=np.float32) + 0.5) * np.float32(
                self.height / height
            )
            yield rows, Positions.exact(self.lens.project(self.rays(x, y)))

    @property
    def _shows_pole(self) -> bool:
        """Whether the view shows the zenith or the nadir of a panorama."""
        if not self.wraps:
            return False
        fx, fy, cx, cy = self.params
        x, y, z = np.eye(3)[1] if self.rotation is None else np.array(self.rotation)[:, 1]
        across, down = max(cx, self.width - cx) / fx, max(cy, self.height - cy) / fy
        return bool(abs(x) <= across * abs(z) and abs(y) <= down * abs(z))

    def strips(self, width: int, height: int) -> Iterator[tuple[slice, np.ndarray]]:
        """As `positions`, in arrays (H, W, 2) float32."""
        for rows, positions in self.positions(width, height):
            for part, position in positions.strips():
                yield slice(rows.start + part.start, rows.start + part.stop), position

    def rays(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(len(y), len(x), 3): directions in the frame of the lens of pixels of this view."""
        fx, fy, cx, cy = self.params
        across, down = np.meshgrid((x - cx) / fx, (y - cy) / fy)
        rays = np.stack([across, down, np.ones_like(across)], -1)
        return rays if self.rotation is None else rays @ np.array(self.rotation, rays.dtype)

    def photo_z(self, width: int, height: int) -> np.ndarray:
        """(height, width): z in the frame of the photo of the points at z = 1 of the view."""
        x, y = (np.arange(size) + 0.5 for size in (width, height))
        return self.rays(x * (self.width / width), y * (self.height / height))[..., 2]

    def covered(self, position: np.ndarray) -> np.ndarray:
        """(H, W) bool: whether positions from `strips` are in the photo and in its circle."""
        if not self.partial or self.wraps:
            return np.ones(position.shape[:2], bool)
        x, y = position[..., 0], position[..., 1]
        least, right, bottom = -_POSITION_ERROR, self.lens.width, self.lens.height
        inside = (x >= least) & (x <= right - least) & (y >= least) & (y <= bottom - least)
        if self.circle is not None:
            _, _, cx, cy = self.lens.intrinsics
            inside &= (x - cx) ** 2 + (y - cy) ** 2 <= self.circle**2
        return inside


def pinhole_view(lens: Lens) -> LensView:
    """The only view of a lens that is not wide; raises the errors of `pinhole_of`."""
    pinhole = pinhole_of(lens)
    size = pinhole.width, pinhole.height
    return LensView(lens, "", *size, pinhole.params, cropped=pinhole.cropped)


def look(yaw: float, pitch: float) -> np.ndarray:
    """(3, 3) view_from_lens of a view whose axis is turned right by ``yaw`` and up by ``pitch``.

    Angles in radians. The horizon of the lens stays level.
    """
    axis = np.array(
        [math.sin(yaw) * math.cos(pitch), -math.sin(pitch), math.cos(yaw) * math.cos(pitch)]
    )
    right = np.array([math.cos(yaw), 0.0, -math.sin(yaw)])
    return np.stack([right, np.cross(axis, right), axis])


def rotated_view(
    lens: Lens,
    name: str,
    rotation: np.ndarray,
    half_angles: tuple[float, float],
    circle: float | None = None,
) -> LensView:
    """The view of a lens in a direction, with the resolution of the centre of the photo.

    Args:
        lens: of the photo.
        name: of the view.
        rotation: (3, 3), view_from_lens.
        half_angles: radians between the axis and the middle of the right and of the lower border.
        circle: see `LensView`.

    Raises: ValueError: the view would be more than twice as large as the photo.
    """
    focal = _central_scale(lens)
    half_width, half_height = (focal * math.tan(angle) for angle in half_angles)
    if max(half_width, half_height) > 0.5 * _LARGEST * max(lens.width, lens.height):
        raise Problem("its pixels are compressed too much near the centre")
    width, height = (max(1, math.ceil(2 * half)) for half in (half_width, half_height))
    rows = tuple(tuple(float(value) for value in row) for row in rotation)
    view = LensView(
        lens, name, width, height, (focal, focal, width / 2, height / 2), rows, circle, True
    )
    x, y = np.linspace(0, width, 65), np.linspace(0, height, 65)
    return dataclasses.replace(view, partial=not view.covered(_positions(view, x, y)).all())


def is_wide(lens: Lens) -> bool:
    """Whether a lens may have an image circle within the photo: it is a fisheye.

    Also a lens of another model whose field of view is more than 120°.
    """
    if lens.kind.panoramic or not all(map(math.isfinite, lens.params)):
        return False
    return lens.kind.angular or 2 * float(_field(lens, None).reach.max()) > _WIDEST


@lru_cache(256)
def lens_views(lens: Lens, circle: float | None = None) -> tuple[LensView, ...]:
    """The pinhole views that show what a lens shows: one, or several of a wide lens.

    Args:
        lens: of the photo.
        circle: see `LensView`.

    Raises: ValueError: the model is valid only in a small part of the photo.
    """
    if not all(map(math.isfinite, lens.params)):
        raise Problem("a parameter is not finite")
    field = _field(lens, circle)
    quarter = _DIRECTIONS // 4
    reach = [float(angle) for angle in field.reach[::quarter]]  # right, down, left, up
    across, down = reach[0] + reach[2], reach[1] + reach[3]
    if max(across, down) <= _WIDEST and circle is None:
        return (pinhole_view(lens),)
    rays = field.rays()
    with np.errstate(divide="ignore"):
        half_angles = np.abs(np.arctan(rays[:, :2] / rays[:, 2:])).max(0)
    if rays[:, 2].min() > 0 and 2 * half_angles.max() <= _WIDEST:
        return (rotated_view(lens, "", np.eye(3), tuple(half_angles), circle),)
    chosen = _layout(rays, max(reach[0], reach[2]), max(reach[1], reach[3]))
    halves = (_VIEW_ANGLE / 2, _VIEW_ANGLE / 2)
    return tuple(rotated_view(lens, name, look(*turn), halves, circle) for name, *turn in chosen)


@dataclass(frozen=True)
class _Field:
    """The directions that a lens shows.

    Attributes:
        limit: radians from the axis; the model has no pixels beyond, or folds.
        reach: (_DIRECTIONS,) the largest angle in the photo; from right, over down, left and up.
    """

    limit: float
    reach: np.ndarray

    def rays(self) -> np.ndarray:
        """(N, 3) unit directions, spread over the field."""
        turn = np.arange(_DIRECTIONS) * (2 * math.pi / _DIRECTIONS)
        return _directions(np.linspace(0, 1, 33)[1:] * self.reach[:, None], turn).reshape(-1, 3)


def _directions(angle: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """(D, N, 3) unit directions at ``angle`` (D, N) to the axis, on the sides ``turn`` (D,)."""
    sine = np.sin(angle)
    return np.stack(
        [sine * np.cos(turn)[:, None], sine * np.sin(turn)[:, None], np.cos(angle)], axis=-1
    )


@lru_cache(256)
def _field(lens: Lens, circle: float | None) -> _Field:
    if lens.kind.panoramic:
        return _Field(math.pi, np.full(_DIRECTIONS, math.pi))
    angle = np.linspace(0, math.pi, _ANGLES + 1)
    turn = np.arange(_DIRECTIONS) * (2 * math.pi / _DIRECTIONS)
    pixel = lens.project(_directions(np.broadcast_to(angle, (_DIRECTIONS, len(angle))), turn))
    fx, fy, cx, cy = lens.intrinsics
    radius = np.hypot((pixel[..., 0] - cx) / fx, (pixel[..., 1] - cy) / fy)
    growing = np.diff(radius) > _FOLD * radius[:, 1:2]
    # The first angle at which a direction ends; all directions end there, because a model that
    # has folded may return into the photo.
    ends = np.where(growing.all(1), _ANGLES, growing.argmin(1))
    limit = int(ends.min())
    x, y = pixel[..., 0], pixel[..., 1]
    inside = (x >= 0) & (x <= lens.width) & (y >= 0) & (y <= lens.height)
    if circle is not None:
        inside &= np.hypot(x - cx, y - cy) <= circle
    last = np.where(inside.all(1), _ANGLES, inside.argmin(1) - 1)
    return _Field(float(angle[limit]), angle[np.clip(last, 0, limit)])


def _central_scale(lens: Lens) -> float:
    """Pixels per radian at the centre of a photo; the larger one of both directions."""
    step = 1e-4
    rays = np.array([[step, 0.0, 1.0], [-step, 0.0, 1.0], [0.0, step, 1.0], [0.0, -step, 1.0]])
    pixel = lens.project(rays)
    scales = np.linalg.norm(pixel[::2] - pixel[1::2], axis=1) / (2 * step)
    scale = float(scales.max())
    if not 1.0 <= scale < 1e9:
        raise Problem("its focal length is not valid")
    return scale


_Turn = tuple[str, float, float]  # name, yaw and pitch in radians


def _layout(rays: np.ndarray, across: float, down: float) -> list[_Turn]:
    """The directions of the fewest views that cover ``rays`` (N, 3). ``across``, ``down``: the
    largest angles in the horizontal and in the vertical direction."""
    half = (_VIEW_ANGLE - _OVERLAP) / 2
    best: list[_Turn] = []
    for turns in _layouts(max(half / 2, across - half), max(half / 2, down - half)):
        best = turns
        if _share(rays, turns, half) >= _COVERED:
            break
    for turn in reversed(best):  # a part of a layout may cover a field that is not round
        fewer = [other for other in best if other is not turn]
        if fewer and _share(rays, fewer, half) >= _COVERED:
            best = fewer
    return best


def _layouts(across: float, down: float) -> Iterator[list[_Turn]]:
    """Layouts of two to six views. ``across``, ``down``: how far the outer views must turn."""
    front = ("front", 0.0, 0.0)
    yaw, pitch = min(across, math.pi / 2), min(down, math.pi / 2)
    sides = [("left", -yaw, 0.0), ("right", yaw, 0.0)]
    ends = [("up", 0.0, pitch), ("down", 0.0, -pitch)]
    yield sides
    yield ends
    yield [front, *sides]
    yield [front, *ends]
    for turn in map(math.radians, (25.0, 30.0, 35.0, 40.0, 45.0)):
        yield [
            (f"{vertical}_{horizontal}", x * turn, y * turn)
            for vertical, y in (("up", 1.0), ("down", -1.0))
            for horizontal, x in (("left", -1.0), ("right", 1.0))
        ]
    for turn in map(math.radians, range(50, 91, 5)):
        around = [("left", -turn, 0.0), ("right", turn, 0.0), ("up", 0.0, turn)]
        five = [front, *around, ("down", 0.0, -turn)]
        yield five
    yield [*five, ("back", math.pi, 0.0)]


def _share(rays: np.ndarray, turns: Sequence[_Turn], half: float) -> float:
    """The share of ``rays`` within the angle ``half`` of the axes of a view, in both directions."""
    seen = np.zeros(len(rays), bool)
    for _, yaw, pitch in turns:
        x, y, z = look(yaw, pitch) @ rays.T
        seen |= np.maximum(np.abs(x), np.abs(y)) <= z * math.tan(half)
    return float(seen.mean())


def _positions(view: LensView, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(len(y), len(x), 2): positions in the photo of pixels of a view; NaN where there are none."""
    rays = view.rays(x, y)
    position = view.lens.project(rays)
    if view.wraps:
        # Longitudes without a seam in the view, and not negative.
        middle = view.rays(np.array(view.params[2:3]), np.array(view.params[3:]))
        turn, axis = view.lens.width, view.lens.project(middle)[..., 0]
        position[..., 0] = axis + (position[..., 0] - axis + 0.5 * turn) % turn + 0.5 * turn
    elif view.partial:
        limit = _field(view.lens, view.circle).limit
        angle = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        position[angle > limit] = np.nan
    return position


@lru_cache(_KEPT)
def _nodes(view: LensView) -> np.ndarray:
    return node_grid(view.width, view.height, lambda x, y: _positions(view, x, y))
