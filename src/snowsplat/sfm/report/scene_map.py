"""Cameras and points of a dataset as SVG drawings from above and from the side, at one scale.

The frame is that of `orient`: y points down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from snowsplat.util.html import svg_text
from snowsplat.util.messages import Message, message
from snowsplat.util.theme import colours

_AMBER, _BLUE, _NIGHT = (colours()[name] for name in ("amber", "blue", "night"))
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


@dataclass(frozen=True)
class _Projection:
    """An orthographic projection of the scene."""

    title: str
    right: np.ndarray  # (3,) world direction that points to the right of the drawing
    down: np.ndarray  # (3,) world direction that points down in the drawing


_NO_MARKS = np.empty((0, 3))
_Project = Callable[[np.ndarray], np.ndarray]  # (n, 3) world to (n, 2) of the drawing

_X, _Y, _Z = np.eye(3)
_PROJECTIONS = (_Projection("From above", _X, -_Z), _Projection("From the side", _Z, _Y))


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
    extents = [
        np.abs((high - low) @ np.stack([projection.right, projection.down], 1))
        for projection in _PROJECTIONS
    ]
    room = np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN
    scale = min(float((room / extent).min()) for extent in extents)
    depth = _frustum_depth(centres, high - low)
    what = photos, xyz[shown], rgb[shown], marks, (low + high) / 2
    return [
        _draw(projection, *what, extent * scale, scale, depth, unit)
        for projection, extent in zip(_PROJECTIONS, extents, strict=True)
    ]


def _box(centres: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) of what is drawn, without outliers and distant points."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    if len(xyz):
        reach = _REACH * _usual_distance(centres, xyz)
        points_low, points_high = np.quantile(xyz, [0.02, 0.98], axis=0)
        low = np.minimum(low, np.maximum(points_low, low - reach))
        high = np.maximum(high, np.minimum(points_high, high + reach))
    margin = 0.04 * (float((high - low).max()) or 1.0)
    return low - margin, high + margin


def _usual_distance(centres: np.ndarray, xyz: np.ndarray) -> float:
    """The median distance of the points (P, 3) from the nearest camera."""
    some = xyz[:: -(-len(xyz) // _POINTS_SAMPLED)]
    nearest = np.full(len(some), np.inf)
    for centre in centres:
        nearest = np.minimum(nearest, np.linalg.norm(some - centre, axis=1))
    return float(np.median(nearest))


def _frustum_depth(centres: np.ndarray, size: np.ndarray) -> float:
    """A depth at which frustums show the viewing direction but do not overlap much."""
    large = 0.06 * float(size.max())
    if len(centres) < 2:
        return large
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    return float(np.clip(1.5 * np.median(steps), 0.4 * large, large))


def _draw(
    projection: _Projection,
    photos: Sequence[PlacedPhoto],
    xyz: np.ndarray,
    rgb: np.ndarray,
    marks: np.ndarray,
    middle: np.ndarray,
    extent: np.ndarray,
    scale: float,
    depth: float,
    unit: Message | str,
) -> Drawing:
    width, height = (float(value) + 2 * _MARGIN for value in extent)
    axes = np.stack([projection.right, projection.down], 1)

    def project(points: np.ndarray) -> np.ndarray:
        return (points - middle) @ axes * scale + (width / 2, height / 2)

    parts = [
        '<svg class="map" xmlns="http://www.w3.org/2000/svg" role="img" '
        f'aria-label="{projection.title}" viewBox="0 0 {width:.0f} {height:.0f}">',
        f'<rect width="{width:.0f}" height="{height:.0f}" rx="6" fill="#1f242c"/>',
        *_points(project(xyz), rgb),
        *_paths(photos, project),
        f'<g fill="{_AMBER}" fill-opacity="0.12" stroke="{_AMBER}" stroke-width="0.7" '
        'stroke-linejoin="round">',
    ]
    for i, photo in enumerate(photos):
        a, b, c, d = (_svg_position(xy) for xy in project(photo.corners(depth)))
        eye = _svg_position(project(photo.centre[None])[0])
        first = ' stroke="#ffffff" stroke-width="1.6"' if i == 0 else ""
        parts.append(
            f'<path{first} d="M{a}L{b}L{c}L{d}ZM{a}L{eye}L{b}M{c}L{eye}L{d}">'
            f"<title>{escape(photo.name)}</title></path>"
        )
    bar = _scale_bar(height, scale, unit)
    svg = Markup("\n".join([*parts, "</g>", *_marks(project(marks)), bar, "</svg>"]))
    return Drawing(svg, round(width))


def _points(xy: np.ndarray, rgb: np.ndarray) -> list[str]:
    """The points, one path for each colour. Dark colours are lightened: the background is dark."""
    shades = np.rint(rgb.astype(np.float64) * ((_SHADES - 1) / 255)).astype(np.int64)
    lines = []
    for shade in np.unique(shades, axis=0):
        here = xy[(shades == shade).all(axis=1)]
        red, green, blue = (int(v) for v in np.rint(45 + shade * (210 / (_SHADES - 1))))
        dots = "".join(f"M{_svg_position(position)}h0" for position in here)
        lines.append(f'<path stroke="#{red:02x}{green:02x}{blue:02x}" d="{dots}"/>')
    opening = '<g fill="none" stroke-width="1.7" stroke-linecap="round" stroke-opacity="0.85">'
    return [opening, *lines, "</g>"]


def _paths(photos: Sequence[PlacedPhoto], project: _Project) -> list[str]:
    """The camera path of each video."""
    lines = []
    for sequence in dict.fromkeys(photo.sequence for photo in photos):
        if sequence is None:
            continue
        centres = np.array([photo.centre for photo in photos if photo.sequence == sequence])
        way = " ".join(_svg_position(xy) for xy in project(centres))
        lines.append(
            f'<polyline fill="none" stroke="{_BLUE}" stroke-width="1" points="{way}">'
            f"<title>{escape(sequence)}</title></polyline>"
        )
    return lines


def _marks(xy: np.ndarray) -> list[str]:
    """Numbered discs, counted from 1."""
    return [
        f'<g><circle cx="{x:.1f}" cy="{y:.1f}" r="9" fill="{_BLUE}"/>'
        f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle" fill="{_NIGHT}" font-size="12" '
        f'font-weight="600" font-family="sans-serif">{number}</text></g>'
        for number, (x, y) in enumerate(xy, 1)
    ]


def _scale_bar(height: float, scale: float, unit: Message | str) -> str:
    power = 10.0 ** math.floor(math.log10(25 / scale))
    length = next(digit * power for digit in (1, 2, 5, 10) if digit * power * scale > 25)
    y, x = height - 10, 12.0
    start = _svg_position((x, y))
    words = svg_text(message("{length:g} {unit}", length=length, unit=unit))
    return (
        f'<path d="M{start}h{length * scale:.1f}" stroke="#aab4c0" stroke-width="2"/>'
        f'<text x="{x:.0f}" y="{y - 6:.0f}" fill="#aab4c0" font-size="11" '
        f'font-family="sans-serif">{words}</text>'
    )


def _svg_position(xy: Sequence[float] | np.ndarray) -> str:
    return f"{xy[0]:.1f} {xy[1]:.1f}"
