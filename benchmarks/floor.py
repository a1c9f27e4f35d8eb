"""A floor for blending: the time that its arithmetic takes if nothing else does.

Counted from `native/cpu/blend.cpp` for 3 channels, in vector operations a step (a vector of W
pixels, one splat). Loads, broadcasts, mask logic and branches go through other ports of the
processor and are not counted; neither is what comes once for a whole (tile, splat): the rows'
quadratics, the test which blocks are touched, the final fold over lanes. AVX2 and narrower sets
need more operations for the same step (masks, 2^x, no FMA in the baseline); that counts against
them.

    floor a pair = OPERATIONS / (W · lane use) / (operations a clock · clock)

The share of the floor that is reached, floor / measured, says how far the rest (instances, idle
ports, cache misses) is from free. It assumes two vector operations a clock, which the common cores
of servers and desktops do; a core with more pipes (AMD Zen 5) can come nearer to its floor than 1.
The clock is what the system names, or `--ghz`: clouds rarely tell the true one.
"""

from __future__ import annotations

FORWARD = {
    "log₂α = (A X + p₁) X + p₀": 2,
    "2^x: fraction, polynomial of degree 4, scale": 6,
    "α ≥ 1/255": 1,
    "min with 0.99": 1,
    "weight α T": 1,
    "next T": 1,
    "T ≥ 1e-4": 1,
    "three colours": 3,
}
BACKWARD = {
    "log₂α": 2,
    "2^x": 6,
    "α ≥ 1/255": 1,
    "min with 0.99, and whether it acts": 2,
    "weight, next T": 2,
    "T ≥ 1e-4": 1,
    "g · c": 3,
    "sums of weight · g": 3,
    "light of this splat, of those behind": 2,
    "1 / (1 − α), times α S": 3,
    "q": 1,
    "moments q, q dy, q dy²": 4,
}
OPERATIONS = sum(FORWARD.values()) + sum(BACKWARD.values())
OPERATIONS_A_CLOCK = 2.0


def floor_ns(lanes: int, lane_use: float, ghz: float) -> float:
    """Nanoseconds a pair, forward and backward together, on one core."""
    return OPERATIONS / (lanes * lane_use) / (OPERATIONS_A_CLOCK * ghz)


def system_ghz() -> float:
    """The highest clock that /proc/cpuinfo names now; 3 where there is none."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            clocks = [float(line.split(":")[1]) for line in file if line.startswith("cpu MHz")]
    except OSError:
        clocks = []
    return max(clocks) / 1000 if clocks else 3.0
