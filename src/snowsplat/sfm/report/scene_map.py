"""Cameras and points of a dataset as SVG drawings from above and from the side, at one scale.

The frame is that of `orient`: y points down.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from markupsafe import Markup

from snowsplat.util.html import colours, render_page, svg_text
from snowsplat.util.messages import Message, message

_WIDTH = 520  # of the largest drawing, in SVG units
_HEIGHT = 400
_MARGIN = 16
_MAX_POINTS = 6000  # per drawing; with more points, the file is larger but the drawing not clearer
_REACH = 3.0  # points farther outside are not drawn, in units of the usual distance to a camera
_POINTS_SAMPLED = 2000  # for the usual distance
_SHADES = 12  # levels of red, green and blue: all points of one colour become one SVG path


@dataclass(frozen=True)
class PlacedPhoto:
    """A photo with its pose: the data that a drawing shows."""

    name: str
    sequence: str | None  # photos of one sequence are joined by a line, in the given order
    cam_from_world: np.ndarray  # (3, 4)
    half_width: float  # of the image, divided by the focal length
    half_height: float

    @property
    def centre(self) -> np.ndarray:
        """(3,) world."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    def corners(self, depth: float) -> np.ndarray:
        """(4, 3) world positions of the image corners at a depth, in order around the image."""
        x, y = self.half_width, self.half_height
        rays = depth * np.array([(-x, -y, 1), (x, -y, 1), (x, y, 1), (-x, y, 1)])
        return (rays - self.cam_from_world[:, 3]) @ self.cam_from_world[:, :3]


_NO_MARKS = np.empty((0, 3))
_X, _Y, _Z = np.eye(3)
# The projections of the drawings: their titles, and the world directions that point to the right
# and down in them.
_PROJECTIONS = (("From above", _X, -_Z), ("From the side", _Z, _Y))


@dataclass(frozen=True)
class Drawing:
    """An SVG element and its width in SVG units; all drawings of a scene have the same scale."""

    svg: Markup
    width: int


def draw_scene(
    photos: Sequence[PlacedPhoto],
    xyz: np.ndarray,
    rgb: np.ndarray,
    marks: np.ndarray = _NO_MARKS,
    unit: Message | str = "units",
) -> list[Drawing]:
    """One drawing for each projection, of points (P, 3) and their colours (P, 3) uint8.

    All cameras are drawn, and numbered ``marks`` (K, 3). Points are drawn if they are near the
    cameras and not outliers. ``unit`` is the unit of length, which the scale bars name.
    """
    centres = np.array([photo.centre for photo in photos]).reshape(-1, 3)
    low, high = _box(np.concatenate([centres, marks]), xyz)
    inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
    shown = np.flatnonzero(inside)
    # Random points, because evenly chosen ones could follow a pattern in the order of the points.
    shown = shown[np.random.default_rng(0).permutation(len(shown))[:_MAX_POINTS]]
    extents = [np.abs((high - low) @ np.stack(axes, 1)) for _, *axes in _PROJECTIONS]
    room = np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN
    scale = min(float((room / extent).min()) for extent in extents)
    depth = _frustum_depth(centres, high - low)
    power = 10.0 ** math.floor(math.log10(25 / scale))
    length = next(digit * power for digit in (1, 2, 5, 10) if digit * power * scale > 25)
    middle, drawings = (low + high) / 2, []
    for (title, *axes), extent in zip(_PROJECTIONS, extents, strict=True):
        width, height = (round(side) for side in extent * scale + 2 * _MARGIN)
        across = scale * np.stack(axes, 1)
        place = partial(_positions, across, extent * scale / 2 + _MARGIN - middle @ across)
        svg = render_page(
            "sfm/report/scene_map.html.j2",
            title=title,
            width=width,
            height=height,
            points=[(colour, place(xyz[rows])) for colour, rows in _by_colour(shown, rgb)],
            paths=[(name, place(way)) for name, way in _paths(photos)],
            frusta=[(p.name, place(np.vstack([p.corners(depth), p.centre]))) for p in photos],
            marks=place(marks),
            bar=f"{length * scale:.1f}",
            length=svg_text(message("{length:g} {unit}", length=length, unit=unit)),
            colours=colours(),
        )
        drawings.append(Drawing(Markup(svg), width))
    return drawings


def _positions(across: np.ndarray, offset: np.ndarray, points: np.ndarray) -> list[str]:
    """The positions of ``points`` (n, 3) in a drawing; ``across`` (3, 2), ``offset`` (2,)."""
    return [f"{x:.1f} {y:.1f}" for x, y in points @ across + offset]


def _box(centres: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) of what is drawn, without outliers and distant points."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    if len(xyz):
        some = xyz[:: -(-len(xyz) // _POINTS_SAMPLED)]
        nearest = np.full(len(some), np.inf)
        for centre in centres:
            nearest = np.minimum(nearest, np.linalg.norm(some - centre, axis=1))
        reach = _REACH * float(np.median(nearest))
        points_low, points_high = np.quantile(xyz, [0.02, 0.98], axis=0)
        low = np.minimum(low, np.maximum(points_low, low - reach))
        high = np.maximum(high, np.minimum(points_high, high + reach))
    margin = 0.04 * (float((high - low).max()) or 1.0)
    return low - margin, high + margin


def _frustum_depth(centres: np.ndarray, size: np.ndarray) -> float:
    """A depth at which frustums show the viewing direction but do not overlap much."""
    large = 0.06 * float(size.max())
    if len(centres) < 2:
        return large
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    return float(np.clip(1.5 * np.median(steps), 0.4 * large, large))


def _by_colour(shown: np.ndarray, rgb: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """The points ``shown``, by colour. Dark colours are lightened: the background is dark."""
    shades = np.rint(rgb[shown].astype(np.float64) * ((_SHADES - 1) / 255)).astype(np.int64)
    for shade in np.unique(shades, axis=0):
        red, green, blue = (int(v) for v in np.rint(45 + shade * (210 / (_SHADES - 1))))
        yield f"#{red:02x}{green:02x}{blue:02x}", shown[(shades == shade).all(axis=1)]


def _paths(photos: Sequence[PlacedPhoto]) -> Iterator[tuple[str, np.ndarray]]:
    """The camera path of each video (n, 3)."""
    for name in dict.fromkeys(photo.sequence for photo in photos):
        if name is not None:
            yield name, np.array([photo.centre for photo in photos if photo.sequence == name])
