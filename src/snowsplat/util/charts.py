"""Line charts as SVG for reports, with round numbers on the axes, in the colours of the page."""

import math
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from snowsplat.util.html import svg_text
from snowsplat.util.messages import Message

# Size of the chart in SVG units.
_WIDTH = 520
_HEIGHT = 236
# Margins around the plot area in SVG units; tick labels and the x label are in them.
_LEFT = 58
_RIGHT = 14
_TOP = 10
_BOTTOM = 40
# Approximate number of ticks per axis.
_TICKS_X = 6
_TICKS_Y = 5

#: CSS for pages and notebooks with charts; the colours are the variables of `theme.css`.
STYLE = (Path(__file__).parent / "report" / "charts.css").read_text(encoding="utf-8")

_Points = Sequence[tuple[float, float]]


def chart(
    points: _Points,
    *,
    x_label: Message | str,
    y_label: Message | str,
    raw: _Points = (),
    dots: bool = False,
    from_zero: bool = True,
) -> Markup:
    """An SVG element with a curve, for pages with `STYLE`; "" if no point is finite.

    Args:
        points: (x, y) with ascending x. Points that are not finite are skipped.
        x_label: quantity and unit of the x axis.
        y_label: quantity and unit of the y axis, for the title.
        raw: the points before smoothing. They are drawn as a faint curve behind.
        dots: draw a dot at each point.
        from_zero: start the y axis at 0.
    """
    points, raw = _finite(points), _finite(raw)
    if not points:
        return Markup()
    # The range of the y axis ignores the lowest and the highest 2% of the raw values. Otherwise a
    # single outlier would flatten the curve.
    ys = [y for _, y in points] + sorted(y for _, y in raw)[len(raw) // 50 : -(len(raw) // 50) - 1]
    x_ticks = ticks(min(0.0, points[0][0]), max(points[-1][0], 1e-9), _TICKS_X)
    y_ticks = ticks(0.0 if from_zero else min(ys), max(ys), _TICKS_Y)
    left, right = x_ticks[0], max(points[-1][0], 1e-9)
    low, high = min(y_ticks[0], *ys), max(y_ticks[-1], *ys)

    def at(x: float, y: float) -> tuple[float, float]:
        y = min(max(y, low), high)
        return (
            _LEFT + (x - left) / (right - left) * (_WIDTH - _LEFT - _RIGHT),
            _HEIGHT - _BOTTOM - (y - low) / (high - low) * (_HEIGHT - _TOP - _BOTTOM),
        )

    parts = []
    for tick, word in zip(y_ticks, tick_labels(y_ticks), strict=True):
        _, y = at(left, tick)
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{word}</text>')
    bottom = _HEIGHT - _BOTTOM
    for tick, word in zip(x_ticks, tick_labels(x_ticks), strict=True):
        if tick > right:
            continue
        x, _ = at(tick, low)
        parts.append(f'<path class="grid" d="M{x:.1f} {bottom}v4"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 17}" text-anchor="middle">{word}</text>')
    # The x label is at the end of the axis, below the tick labels.
    parts.append(
        f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 4}" '
        f'text-anchor="end">{svg_text(x_label)}</text>'
    )
    if raw:
        parts.append(f'<path class="raw" d="{_line([at(*point) for point in raw])}"/>')
    places = [at(*point) for point in points]
    if len(places) > 1:
        parts.append(f'<path class="curve" d="{_line(places)}"/>')
    if dots or len(places) == 1:
        parts += [f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>' for x, y in places]
    inner = "".join(parts)
    title = svg_text(y_label, "title")
    if not title.startswith("<"):
        title = Markup("<title>{}</title>").format(title)
    return Markup(
        f'<svg class="chart" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" '
        f'role="img">{title}{inner}</svg>'
    )


def ticks(low: float, high: float, count: int) -> list[float]:
    """About ``count`` round numbers at equal steps that cover the range ``low`` to ``high``."""
    span = high - low
    if not span > 1e-9 * max(abs(low), abs(high), 1e-9):
        span = abs(high) or 1.0
        low, high = low - span / 2, high + span / 2
    rough = span / max(1, count - 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, last + 1)]


def tick_labels(values: Sequence[float]) -> list[str]:
    """Labels of ticks, all with the number of decimals that the step needs.

    Values from 10,000 are shown in thousands (k), values from a million in millions (M).
    """
    largest = max(abs(value) for value in values)
    step = values[1] - values[0] if len(values) > 1 else largest
    for least, unit, word in ((1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if largest >= least:
            shown = [value / unit for value in values]
            places = _decimals(step / unit)
            return [f"{value:.{places}f}{word}" if value else "0" for value in shown]
    places = _decimals(step)
    return [f"{value:.{places}f}" if value else "0" for value in values]


def smoothed(points: _Points, window: int) -> list[tuple[float, float]]:
    """Smooth y by local linear regression.

    The weights decrease linearly over ``window`` points on each side. A moving average would be
    biased at the ends.
    """
    result = []
    for i, (x, _) in enumerate(points):
        first = max(0, i - window)
        near = points[first : i + window + 1]
        weights = [window + 1 - abs(first + k - i) for k in range(len(near))]
        total = sum(weights)
        mean_x = sum(w * px for w, (px, _) in zip(weights, near, strict=True)) / total
        mean_y = sum(w * py for w, (_, py) in zip(weights, near, strict=True)) / total
        spread = sum(w * (px - mean_x) ** 2 for w, (px, _) in zip(weights, near, strict=True))
        tilt = sum(
            w * (px - mean_x) * (py - mean_y) for w, (px, py) in zip(weights, near, strict=True)
        )
        result.append((x, mean_y + (tilt / spread * (x - mean_x) if spread > 0 else 0.0)))
    return result


def _decimals(step: float) -> int:
    for places in range(7):
        if abs(step * 10**places - round(step * 10**places)) < 1e-6 * step * 10**places:
            return places
    return 7


def _finite(points: _Points) -> list[tuple[float, float]]:
    return [(x, y) for x, y in points if math.isfinite(x) and math.isfinite(y)]


def _line(places: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
