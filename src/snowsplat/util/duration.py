"""Durations as text."""

import math

from snowsplat.util.messages import Message, message


def duration(seconds: float) -> Message:
    """Text such as "5.1 s", "2 min 10 s" or "1 h 40 min"; "?" if the number is not finite."""
    if not math.isfinite(seconds):
        return Message("?")
    if seconds < 100:
        return message("{seconds} s", seconds=f"{seconds:.{1 if seconds < 10 else 0}f}")
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return message("{minutes} min {seconds} s", minutes=minutes, seconds=rest)
    return message("{hours} h {minutes} min", hours=minutes // 60, minutes=minutes % 60)
