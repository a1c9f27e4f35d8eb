"""A line chart as SVG, without a plotting library."""

import math
from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
WIDTH, HEIGHT = 720, 440
LEFT, RIGHT, TOP, BOTTOM = 60, 700, 40, 390


def line_chart(
    curves: Mapping[str, Sequence[tuple[float, float]]], title: str, x_label: str, y_label: str
) -> str:
    """SVG of named curves of (x, y); x > 0 on a logarithmic axis. Needs at least one point."""
    points = [point for curve in curves.values() for point in curve]
    x_low, x_high = _decades([x for x, _ in points])
    step = _tick_step(min(y for _, y in points), max(y for _, y in points))
    y_low = step * math.floor(min(y for _, y in points) / step)
    y_high = step * math.floor(max(y for _, y in points) / step) + step

    def at(x: float, y: float) -> tuple[float, float]:
        right = (math.log10(x) - x_low) / (x_high - x_low)
        return LEFT + right * (RIGHT - LEFT), BOTTOM - (y - y_low) / (y_high - y_low) * (
            BOTTOM - TOP
        )

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        _text(WIDTH / 2, 22, title, size=15),
        _text((LEFT + RIGHT) / 2, HEIGHT - 12, x_label),
        f'<g transform="rotate(-90 16 {(TOP + BOTTOM) / 2})">'
        + _text(16, (TOP + BOTTOM) / 2, y_label)
        + "</g>",
    ]
    for decade in range(math.floor(x_low), math.ceil(x_high) + 1):
        for digit in range(1, 10):
            x = digit * 10.0**decade
            if not x_low - 1e-9 <= math.log10(x) <= x_high + 1e-9:
                continue
            across, _ = at(x, y_low)
            parts.append(_line(across, TOP, across, BOTTOM, "#bbb" if digit == 1 else "#eee"))
            if digit in (1, 2, 5):
                parts.append(_text(across, BOTTOM + 16, f"{x:g}"))
    for i in range(round((y_high - y_low) / step) + 1):
        y = y_low + i * step
        _, down = at(10.0**x_low, y)
        parts.append(_line(LEFT, down, RIGHT, down, "#ddd"))
        parts.append(_text(LEFT - 6, down + 4, f"{y:g}", anchor="end"))
    for i, (name, curve) in enumerate(curves.items()):
        color = COLORS[i % len(COLORS)]
        path = " ".join("{:.1f},{:.1f}".format(*at(x, y)) for x, y in curve)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        for x, y in curve:
            across, down = at(x, y)
            parts.append(f'<circle cx="{across:.1f}" cy="{down:.1f}" r="3" fill="{color}"/>')
        legend = BOTTOM - 12 - 18 * (len(curves) - 1 - i)
        parts.append(_text(RIGHT - 10, legend, name, anchor="end", color=color))
    return "\n".join([*parts, "</svg>", ""])


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Limits of a logarithmic axis: 1, 2 or 5 times a power of ten."""
    stops = [math.log10(m * 10.0**e) for e in range(-6, 10) for m in (1, 2, 5)]
    low, high = math.log10(min(values)), math.log10(max(values))
    return max(s for s in stops if s <= low), min(s for s in stops if s > high)


def _tick_step(low: float, high: float) -> float:
    """1, 2 or 5 times a power of ten, for about six steps in the range."""
    rough = max(high - low, 1e-3) / 6
    scale = 10.0 ** math.floor(math.log10(rough))
    return next(m * scale for m in (1, 2, 5, 10) if m * scale >= rough)


def _line(x0: float, y0: float, x1: float, y1: float, color: str) -> str:
    return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{color}"/>'


def _text(
    x: float, y: float, text: str, *, anchor: str = "middle", size: int = 12, color: str = "black"
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}" '
        f'fill="{color}">{escape(text)}</text>'
    )
