"""Durations as text."""

import math


def duration(seconds: float) -> str:
    """Text such as "5.1 s", "2 min 10 s" or "1 h 40 min"; "?" if the number is not finite."""
    if not math.isfinite(seconds):
        return "?"
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
