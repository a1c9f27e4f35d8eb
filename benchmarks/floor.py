"""A lower bound for the time of blending: that of its arithmetic alone.

The operations are counted in `native/cpu/rasterize.cpp` for 3 channels, as vector operations per
step (a vector of W pixels, one splat). Loads, broadcasts, mask logic and branches use other ports
of the processor and are not counted. The work per (tile, splat) is not counted either: the
quadratics of the rows, the test of which blocks are touched, the final sum over lanes. AVX2 and
narrower instruction sets need more operations per step (masks, 2^x, no FMA in the baseline); these
are not part of the bound.

    floor per pair = OPERATIONS / (W · lane use) / (operations per clock · clock)

The ratio floor / measured shows the cost of everything else (instances, idle ports, cache misses).
Two vector operations per clock are assumed, as on common server and desktop cores. A core with more
ports (AMD Zen 5) can reach a ratio above 1. The clock is that reported by the system, or `--ghz`:
virtual machines rarely report the true one.
"""

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
OPERATIONS_PER_CLOCK = 2.0


def floor_ns(lanes: int, lane_use: float, ghz: float) -> float:
    """Nanoseconds per pair, forward and backward together, on one core."""
    return OPERATIONS / (lanes * lane_use) / (OPERATIONS_PER_CLOCK * ghz)


def system_ghz() -> float:
    """The highest clock that /proc/cpuinfo reports, in GHz; 3 if it reports none."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            clocks = [float(line.split(":")[1]) for line in file if line.startswith("cpu MHz")]
    except OSError:
        clocks = []
    return max(clocks) / 1000 if clocks else 3.0
