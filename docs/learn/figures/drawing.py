"""`Drawing`: a small SVG writer for the figures of the course.

Each colour is an attribute, for light surroundings, and a class, which the style of the file
changes in dark ones. The background has a colour, too: where only the page around the image is
dark, the text remains readable. On the site, the figures are elements of the pages
(`docs/extensions/plain_markdown.py`); docs/static/site.css changes their colours with the theme.

Panels are at most 340 units wide. So they are shown at their full size on a phone, too.
"""

import base64
import io
import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.util.charts import tick_labels, ticks

FOLDER = Path(__file__).parent
# For light and for dark surroundings, as in docs/static/site.css.
COLOURS = {
    "ink": ("#1f2933", "#e3e6ea"),
    "soft": ("#667080", "#98a2af"),
    "line": ("#d3d8df", "#3b424c"),
    "blue": ("#2563b8", "#6fb0f7"),
    "orange": ("#d4600c", "#ffa355"),
    "green": ("#15824f", "#52cf9a"),
    "violet": ("#7a4cc2", "#bb9df6"),
    "red": ("#c02a48", "#ff7d92"),
    "page": ("#ffffff", "#15181c"),
}
STYLE = "".join(
    f".f-{name}{{fill:{dark}}}.s-{name}{{stroke:{dark}}}" for name, (_, dark) in COLOURS.items()
)
Point = Sequence[float]


class Drawing:
    """One panel: a plot area with data coordinates, inside margins.

    x and y are the ranges of the data; y goes up, unless ``y[0] > y[1]``. With ``equal``, a unit is
    equally long on both axes: the larger of the two ranges is kept, and the other one is extended.
    """

    def __init__(
        self,
        width: float = 320,
        height: float = 240,
        *,
        x: tuple[float, float] = (0, 1),
        y: tuple[float, float] = (0, 1),
        equal: bool = False,
        margins: tuple[float, float, float, float] = (8, 8, 8, 8),
    ) -> None:
        self.width, self.height = width, height
        self.left, self.top, right, bottom = margins
        self.right, self.bottom = width - right, height - bottom
        if equal:
            per_x = (self.right - self.left) / abs(x[1] - x[0])
            per_y = (self.bottom - self.top) / abs(y[1] - y[0])
            if per_x > per_y:
                x = _extended(x, per_x / per_y)
            else:
                y = _extended(y, per_y / per_x)
        self.x, self.y = x, y
        self.parts: list[str] = []

    # Coordinates

    def at(self, point: Point) -> tuple[float, float]:
        """SVG coordinates of a point in data coordinates."""
        u = (point[0] - self.x[0]) / (self.x[1] - self.x[0])
        v = (point[1] - self.y[0]) / (self.y[1] - self.y[0])
        return (
            self.left + u * (self.right - self.left),
            self.bottom - v * (self.bottom - self.top),
        )

    # Shapes

    def line(
        self,
        points: Iterable[Point],
        colour: str = "ink",
        width: float = 1.8,
        *,
        dash: str = "",
        opacity: float = 1.0,
        closed: bool = False,
        fill: str = "",
        fill_opacity: float = 0.15,
    ) -> None:
        """A polyline, or a polygon with an optional fill."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in map(self.at, points))
        self._path(path + "Z" * closed, colour, width, dash, opacity, fill, fill_opacity)

    def ellipse(
        self,
        mean: Point,
        covariance: np.ndarray,
        k: float = 1.0,
        colour: str = "blue",
        width: float = 1.8,
        **style: float | str,
    ) -> None:
        """The level set (x − mean)ᵀ Σ⁻¹ (x − mean) = k² of a 2D Gaussian."""
        angle = np.linspace(0, 2 * np.pi, 73)[:-1]
        values, vectors = np.linalg.eigh(np.asarray(covariance, float))
        axes = vectors * np.sqrt(values.clip(0))
        points = np.asarray(mean) + k * np.stack([np.cos(angle), np.sin(angle)], 1) @ axes.T
        self.line(points, colour, width, closed=True, **style)

    def dot(self, point: Point, colour: str = "ink", radius: float = 3.2) -> None:
        x, y = self.at(point)
        self._add(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" {_style(fill=colour)}/>')

    def arrow(self, start: Point, end: Point, colour: str = "ink", width: float = 1.8) -> None:
        (x0, y0), (x1, y1) = self.at(start), self.at(end)
        length = math.hypot(x1 - x0, y1 - y0)
        if length < 1e-6:
            return
        dx, dy = (x1 - x0) / length, (y1 - y0) / length
        bx, by = x1 - 8 * dx, y1 - 8 * dy
        self._path(f"M{x0:.1f} {y0:.1f}L{bx:.1f} {by:.1f}", colour, width, "", 1, "", 0)
        head = [(x1, y1), (bx - 3.6 * dy, by + 3.6 * dx), (bx + 3.6 * dy, by - 3.6 * dx)]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in head)
        self._add(f'<polygon points="{points}" {_style(fill=colour)}/>')

    def text(
        self,
        point: Point,
        words: str,
        colour: str = "ink",
        *,
        anchor: str = "middle",
        size: float = 13,
        dx: float = 0,
        dy: float = 0,
        bold: bool = False,
    ) -> None:
        """Text at a point in data coordinates, moved by (dx, dy) in SVG units."""
        x, y = self.at(point)
        weight = ' font-weight="600"' if bold else ""
        self._add(
            f'<text x="{x + dx:.1f}" y="{y + dy:.1f}" text-anchor="{anchor}" font-size="{size}"'
            f"{weight} {_style(fill=colour)}>{escape(words)}</text>"
        )

    def rectangle(
        self,
        low: Point,
        high: Point,
        colour: str = "",
        *,
        fill: str = "",
        fill_opacity: float = 1.0,
        width: float = 1.2,
        rgb: Sequence[float] | None = None,
    ) -> None:
        """A rectangle between two corners; ``rgb`` (0..1) is a fixed fill colour."""
        (x0, y0), (x1, y1) = self.at(low), self.at(high)
        box = f'x="{min(x0, x1):.1f}" y="{min(y0, y1):.1f}"'
        box += f' width="{abs(x1 - x0):.1f}" height="{abs(y1 - y0):.1f}"'
        if rgb is not None:
            style = f'fill="{_hex(rgb)}"'
        else:
            style = _style(fill=fill, stroke=colour, fill_opacity=fill_opacity)
            style += f' stroke-width="{width:g}"'
        self._add(f"<rect {box} {style}/>")

    def polygon_rgb(
        self, points: Iterable[Point], rgb: Sequence[float], opacity: float = 1
    ) -> None:
        """A polygon in a fixed colour (0..1), for surfaces."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in map(self.at, points)) + "Z"
        colour = _hex(rgb)
        self._add(
            f'<path d="{path}" fill="{colour}" stroke="{colour}" stroke-width=".4"'
            f' opacity="{opacity:g}"/>'
        )

    def picture(
        self,
        image: np.ndarray,
        low: Point,
        high: Point,
        *,
        quality: int = 82,
        pixelated: bool = False,
    ) -> None:
        """An image (H, W, 3) in 0..1 or uint8, between two opposite corners, upright."""
        if image.dtype != np.uint8:
            image = np.rint(255 * image.clip(0, 1)).astype(np.uint8)
        data = io.BytesIO()
        # Without loss, because enlarged pixels would show the errors of compression.
        Image.fromarray(image).save(data, "WEBP", quality=quality, lossless=pixelated, method=6)
        uri = "data:image/webp;base64," + base64.b64encode(data.getvalue()).decode()
        (x0, y0), (x1, y1) = self.at(low), self.at(high)
        style = ' style="image-rendering:pixelated"' if pixelated else ""
        self._add(
            f'<image x="{min(x0, x1):.1f}" y="{min(y0, y1):.1f}" width="{abs(x1 - x0):.1f}"'
            f' height="{abs(y1 - y0):.1f}" preserveAspectRatio="none" href="{uri}"{style}/>'
        )

    # Axes

    def axes(
        self,
        x_label: str = "",
        y_label: str = "",
        *,
        counts: tuple[int, int] = (5, 5),
        x_ticks: Sequence[tuple[float, str]] | None = None,
        y_ticks: Sequence[tuple[float, str]] | None = None,
    ) -> None:
        """Grid lines with tick labels. The names are at the end of the x axis and above the y axis.

        The margins of the drawing must leave space: about 44 on the left, 38 below, 22 above.
        """
        for value, word in y_ticks if y_ticks is not None else _ticks(self.y, counts[1]):
            _, y = self.at((self.x[0], value))
            self._path(f"M{self.left:.1f} {y:.1f}H{self.right:.1f}", "line", 1, "", 1, "", 0)
            self.text((self.x[0], value), word, "soft", anchor="end", size=12, dx=-6, dy=4)
        for value, word in x_ticks if x_ticks is not None else _ticks(self.x, counts[0]):
            x, _ = self.at((value, self.y[0]))
            self._path(f"M{x:.1f} {self.bottom:.1f}v4", "soft", 1, "", 1, "", 0)
            # A digit is about 7 units wide.
            over = max(0.0, x + 3.6 * len(word.replace(" ", "")) - self.width)
            self.text((value, self.y[0]), word, "soft", size=12, dx=-over, dy=17)
        self._path(f"M{self.left:.1f} {self.bottom:.1f}H{self.right:.1f}", "soft", 1, "", 1, "", 0)
        if x_label:
            self.text((self.x[1], self.y[0]), x_label, "soft", anchor="end", size=12, dy=33)
        if y_label:
            x, y = 2 - self.left, self.top - 9 - self.top
            self.text((self.x[0], self.y[1]), y_label, "soft", anchor="start", size=12, dx=x, dy=y)

    def title(self, words: str) -> None:
        """A title above the plot area, in the middle; needs a margin of 24."""
        x, y = (self.x[0] + self.x[1]) / 2, self.y[1]
        self.text((x, y), words, dy=-9, bold=True)

    # Output

    def save(self, name: str, description: str) -> None:
        """Write the panel to ``name``.svg; ``description`` is read by screen readers."""
        svg = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width:g}"'
            f' height="{self.height:g}" viewBox="0 0 {self.width:g} {self.height:g}" role="img"'
            f' font-family="sans-serif"><title>{escape(description)}</title>'
            f"<style>@media (prefers-color-scheme:dark){{{STYLE}}}</style>"
            f'<rect width="100%" height="100%" rx="6" {_style(fill="page")}/>'
        )
        text = svg + "\n".join(["", *self.parts, "</svg>"]) + "\n"
        (FOLDER / f"{name}.svg").write_text(text, encoding="utf-8")

    def _path(
        self,
        path: str,
        colour: str,
        width: float,
        dash: str,
        opacity: float,
        fill: str,
        fill_opacity: float,
    ) -> None:
        style = _style(fill=fill, stroke=colour, fill_opacity=fill_opacity)
        style += f' stroke-width="{width:g}" stroke-linejoin="round"'
        style += f' stroke-dasharray="{dash}"' if dash else ""
        style += f' stroke-opacity="{opacity:g}"' if opacity < 1 else ""
        self._add(f'<path d="{path}" {style}/>')

    def _add(self, part: str) -> None:
        self.parts.append(part)


def _style(*, fill: str = "", stroke: str = "", fill_opacity: float = 1.0) -> str:
    """The attributes of a fill and a stroke in named colours."""
    classes = [f"{kind}-{colour}" for kind, colour in (("f", fill), ("s", stroke)) if colour]
    style = f'fill="{COLOURS[fill][0] if fill else "none"}"'
    if fill and fill_opacity < 1:
        style += f' fill-opacity="{fill_opacity:g}"'
    if stroke:
        style += f' stroke="{COLOURS[stroke][0]}"'
    return f'{style} class="{" ".join(classes)}"'


def _hex(rgb: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * min(max(float(c), 0), 1)):02x}" for c in rgb)


def _extended(interval: tuple[float, float], factor: float) -> tuple[float, float]:
    middle, half = (interval[0] + interval[1]) / 2, (interval[1] - interval[0]) / 2
    return middle - factor * half, middle + factor * half


def _ticks(interval: tuple[float, float], count: int) -> list[tuple[float, str]]:
    low, high = sorted(interval)
    values = ticks(low, high, count)
    labels = tick_labels(values)
    margin = 1e-6 * (high - low)
    return [
        (value, label)
        for value, label in zip(values, labels, strict=True)
        if low - margin <= value <= high + margin
    ]
