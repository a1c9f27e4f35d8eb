"""The motion of the Gaussians in the globe: they stand, whirl, fall as snow, and fly home.

The model is a liquid that moves, and flakes that it carries. All equations have exact solutions
over a time step, so that the motion is stable for long steps, too:

- The velocity v of a flake approaches that of the liquid, u, plus its terminal velocity w:
  dv/dt = −k (v − u − w). This is drag and gravity g = k w.
- The liquid moves with u = e · (V + ∇ × (b ψ)). V is a vortex around the vertical axis. The vector
  potential ψ is the sum of a ring, which moves the liquid up at the axis and down at the glass, and
  of waves Aⱼ sin(kⱼ·x + ωⱼ t + φⱼ). b is 0 at the glass and at the floor. Therefore u has no
  divergence and is parallel to these walls, and flakes are not concentrated anywhere (the idea of
  R. Bridson, J. Hourihan, M. Nordenstam, "Curl-noise for procedural fluid flow", SIGGRAPH 2007). u
  is computed on a grid and interpolated. Shaking increases the strength e, which decays
  exponentially.
- The glass is a wall at the distance `WALL`. It reverses the normal velocity times `BOUNCE`.
- Flakes pile up on the floor. The height of the pile is that of a grid, in which each cell counts
  the flakes that rest there. A flake slides down where the pile is steeper than `REPOSE`.
- A flake flies home on the cubic Hermite curve that reaches its home with velocity 0 in the
  remaining time τ. The rest of such a curve is again such a curve. No curve needs to be stored, and
  the flake arrives exactly.

The script of the page contains the same equations (`web/simulation.js`); it gets the `constants`
from here, and a test compares both. Lengths are in radii of the glass, times in
seconds. The frame is that of `snowsplat.extras.globe.dimensions`: y is down.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from snowsplat.extras.globe.dimensions import FLOOR, FLOOR_RADIUS, WALL

LONGEST_STEP = 1 / 30  # seconds

# Flakes: drag k (1/s) and terminal velocity w (1/s); each flake has values in these ranges.
DRAG = (5.0, 9.0)
FALL = (0.13, 0.31)
# Each flake also circles: the speed in still liquid, and its increase by the strength of the flow;
# the rates are in rad/s.
CIRCLE = (0.03, 0.45)
CIRCLE_RATE = (2.0, 5.0)
SPIN = 9.0  # radians per unit of length
# Radius of flakes: standard deviations are limited to this range while a Gaussian is snow.
FLAKE = (0.0022, 0.0058)
MORPH = 0.45  # seconds in which a Gaussian becomes a flake

# Liquid.
VORTEX = 0.75  # rad/s at the axis
RING = 0.85
WAVES = 5
FLOW_CELLS = 17  # along each side of the grid
DECAY = 1.7  # seconds in which the strength decreases to 1/e
STRONGEST = 2.0
# While the flow is stronger than this (another value in this range for each flake), it lifts flakes
# from the floor, with a velocity of HOP times the strength.
LIFT = (0.04, 0.28)
HOP = 3.0

# Shaking: an oscillating acceleration (units/s²) along a horizontal direction.
SHAKE_SECONDS = 1.1
SHAKE_FREQUENCY = 3.4  # Hz
SHAKE_ACCELERATION = 22.0
# Strength of the flow, and loosening of the Gaussians, per unit of |acceleration| · time.
STIR = 0.3
LOOSEN = 0.115
# A stronger acceleration (units/s²) interrupts the flight home.
INTERRUPTS = 3.0
# A Gaussian is loose when the loosening exceeds its hold.
HOLD = (0.12, 1.0)
# Share of the shaking that reaches the velocity of a loose flake.
SHARE = 0.2

BOUNCE = 0.35
PILE_CELLS = (6, 28)  # along each side of the grid, for few and for many flakes
FLAKES_PER_CELL = 45
PILE_DEPTH = 0.07  # mean depth of the pile if all flakes rest
HIGHEST = 0.3  # of the pile
REPOSE = 0.8  # slope
SLIDE = 0.35  # speed of sliding per slope

# Flying home: flakes start in this range of time, and each needs FLIGHT seconds.
STARTS = 1.5
FLIGHT = 1.9
LAUNCH = (0.2, 1.5)  # upward velocity at the start
LAUNCH_VORTEX = 1.2  # rad/s
REMEMBER_SECONDS = STARTS + FLIGHT


def _waves() -> np.ndarray:
    """(WAVES, 8): wave vector k, amplitude A perpendicular to k, frequency ω, phase φ."""
    random = np.random.default_rng(7)
    rows = []
    for j in range(WAVES):
        # Directions are evenly distributed on a half sphere: -k is the same wave.
        height, azimuth = (j + 0.5) / WAVES, j * math.pi * (3 - math.sqrt(5))
        across = math.sqrt(1 - height * height)
        length = 2.6 + 0.9 * j
        k = length * np.array([across * math.cos(azimuth), height, across * math.sin(azimuth)])
        side = np.cross(k, random.normal(size=3))
        amplitude = side / np.linalg.norm(side) * (1.9 / length)
        rows.append([*k, *amplitude, random.uniform(0.5, 1.5), random.uniform(0, 2 * math.pi)])
    return np.round(np.array(rows), 6)


WAVE = _waves().tolist()


def constants() -> dict[str, Any]:
    """The numbers of this module and the shape of the globe, for the script of the page."""
    return {name: value for name, value in globals().items() if name.isupper()}


def random_numbers(count: int, channel: int) -> np.ndarray:
    """(count,) float64 in [0, 1): the same numbers in the script of the page.

    A hash of the row and the channel: two rounds of multiplication and xorshift on 32 bits.
    """
    x = np.arange(count, dtype=np.uint32) * np.uint32(16) + np.uint32(channel)
    for factor in (0x7FEB352D, 0x846CA68B):
        x ^= x >> np.uint32(16)
        x *= np.uint32(factor)
    x ^= x >> np.uint32(16)
    return x / 4294967296.0


def shake_acceleration(seconds: float) -> float:
    """The acceleration of the globe during a shake, ``seconds`` after its start."""
    if not 0.0 <= seconds < SHAKE_SECONDS:
        return 0.0
    envelope = math.sin(math.pi * seconds / SHAKE_SECONDS)
    return SHAKE_ACCELERATION * envelope * math.sin(2 * math.pi * SHAKE_FREQUENCY * seconds)


def shake_offset(seconds: float) -> float:
    """The displacement of the globe, about that of `shake_acceleration`, without its drift."""
    return -shake_acceleration(seconds) / (2 * math.pi * SHAKE_FREQUENCY) ** 2


@dataclass
class Snow:
    """N Gaussians in motion. Coordinates are stored as three rows, x, y (down) and z."""

    home: np.ndarray  # (3, N) float32: where they stand
    position: np.ndarray = field(init=False)  # (3, N) float32
    velocity: np.ndarray = field(init=False)  # (3, N) float32, per second
    angle: np.ndarray = field(init=False)  # (N,) float32: radians around an axis of each flake
    # (N,) float32. 0: as in the scene; 1: a flake.
    morph: np.ndarray = field(init=False)
    resting: np.ndarray = field(init=False)  # (N,) bool: lies in the pile
    loosening: float = 0.0  # how much the scene was shaken
    strength: float = 0.0  # of the flow
    time: float = 0.0  # seconds since the start
    # Seconds since `remember`; None if the Gaussians do not fly home.
    remembering: float | None = None

    def __post_init__(self) -> None:
        self.home = np.ascontiguousarray(self.home, dtype=np.float32)
        count = self.home.shape[1]
        self.position, self.velocity = self.home.copy(), np.zeros_like(self.home)
        self.angle, self.morph = np.zeros((2, count), np.float32)
        self.resting = np.zeros(count, bool)
        cells = math.sqrt(count * 4 / math.pi / FLAKES_PER_CELL)
        self._cells = int(np.clip(cells, *PILE_CELLS))
        first, second, drag, fall, start, lift, rate, phase, height = (
            random_numbers(count, i) for i in range(9)
        )
        # The scene loosens from the top, and is built again from the floor.
        level = np.clip((FLOOR - self.home[1]) / (FLOOR + WALL), 0.0, 1.0)
        order = 0.55 * first + 0.45 * (1.0 - level)
        self._hold = _in_range(HOLD, order)
        self._drag = _in_range(DRAG, drag)
        self._fall = _in_range(FALL, fall)
        self._lift = _in_range(LIFT, lift)
        self._start = (STARTS * (0.35 * start + 0.65 * level)).astype(np.float32)
        self._rate = _in_range(CIRCLE_RATE, rate)
        self._phase = _in_range((0.0, 2 * math.pi), phase)
        self._launch = _in_range(LAUNCH, height)
        self._turn = np.where(second < 0.5, -SPIN, SPIN).astype(np.float32)

    @property
    def standing(self) -> bool:
        """Whether no Gaussian is loose."""
        return self.loosening <= HOLD[0]

    def remember(self) -> None:
        """All loose Gaussians begin to fly home. They are there after `REMEMBER_SECONDS`."""
        if not self.standing and self.remembering is None:
            self.remembering = 0.0

    def step(
        self, seconds: float, acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Advance by ``seconds``, during which the globe has this acceleration (units/s²).

        Raises: ValueError: the step is longer than `LONGEST_STEP`.
        """
        if not 0 < seconds <= LONGEST_STEP * 1.0001:
            raise ValueError(f"a step has at most {LONGEST_STEP:.4f} s, not {seconds}")
        pushed = math.hypot(*acceleration) * seconds
        decay = math.exp(-seconds / DECAY)
        self.strength = min(STRONGEST, self.strength * decay + STIR * pushed)
        self.loosening += LOOSEN * pushed
        self.time += seconds
        if self.standing:
            self.loosening *= decay  # a soft push has no effect later
            return
        if math.hypot(*acceleration) > INTERRUPTS:
            self.remembering = None
        flying = np.zeros(len(self.angle), bool)
        if self.remembering is not None:
            flying = self.remembering >= self._start
        loose = self.loosening > self._hold
        self._fall_step(seconds, loose & ~flying, acceleration)
        if self.remembering is not None:
            self._fly_step(seconds, loose & flying)
            self.remembering += seconds
            if self.remembering > REMEMBER_SECONDS:
                self.position[:], self.velocity[:] = self.home, 0
                self.angle[:], self.morph[:], self.resting[:] = 0, 0, False
                self.loosening, self.remembering = 0.0, None

    def flow(self, position: np.ndarray) -> np.ndarray:
        """(3, M): the velocity of the liquid at ``position`` (3, M) for the strength 1."""
        grid = flow_grid(self.time).reshape(3, -1)
        place = np.clip((position + 1) * ((FLOW_CELLS - 1) / 2), 0, FLOW_CELLS - 1.001)
        index = place.astype(np.int32)
        fx, fy, fz = place - index
        corner = (index[2] * FLOW_CELLS + index[1]) * FLOW_CELLS + index[0]
        u = np.zeros_like(position)
        for dz, wz in ((0, 1 - fz), (1, fz)):
            for dy, wy in ((0, wz * (1 - fy)), (1, wz * fy)):
                for dx, weight in ((0, wy * (1 - fx)), (1, wy * fx)):
                    at = corner + ((dz * FLOW_CELLS + dy) * FLOW_CELLS + dx)
                    u += weight * grid[:, at]
        return u

    def pile(self) -> np.ndarray:
        """(cells, cells) float32: the height of the pile in each cell, by row z and column x."""
        cells = self._cells
        places = (self.position[::2, self.resting] + FLOOR_RADIUS) * self._per_unit
        x, z = np.clip(places.astype(int), 0, cells - 1)
        counts = np.bincount(z * cells + x, minlength=cells * cells).astype(np.float32)
        # The mean height is PILE_DEPTH if all flakes rest on the disc.
        height = PILE_DEPTH * math.pi * (cells / 2) ** 2 / len(self.angle)
        return np.minimum(counts * height, HIGHEST).reshape(cells, cells)

    @property
    def _per_unit(self) -> float:
        return self._cells / (2 * FLOOR_RADIUS)

    def _fall_step(
        self, seconds: float, moves: np.ndarray, acceleration: tuple[float, float, float]
    ) -> None:
        lifted = self.strength > self._lift
        self.resting &= ~lifted
        heights = self.pile()
        rows = np.flatnonzero(moves & ~self.resting)
        if not len(rows):
            return
        x, v = self.position[:, rows], self.velocity[:, rows]
        target = np.float32(self.strength) * self.flow(x)
        target[1] += self._fall[rows]
        circle = self._phase[rows] + self._rate[rows] * np.float32(self.time % 1000.0)
        speed = np.float32(CIRCLE[0] + CIRCLE[1] * self.strength)
        target[0] += speed * np.cos(circle)
        target[1] -= speed * np.sin(2 * circle)
        target[2] += speed * np.sin(circle)
        v += (target - v) * -np.expm1(-seconds * self._drag[rows])
        v -= (np.array(acceleration, np.float32) * np.float32(SHARE * seconds))[:, None]
        x += v * np.float32(seconds)
        height, slope_x, slope_z = _sample(heights, x)
        sunk = x[1] - (FLOOR - height)
        touching = sunk > 0
        x[1] -= np.where(touching, sunk, 0)
        hops = touching & lifted[rows]
        v[1, hops] = -HOP * self.strength * (0.5 + self._lift[rows[hops]])
        steep = np.hypot(slope_x, slope_z) > REPOSE
        # The glass keeps the pile from sliding outwards.
        steep &= np.hypot(x[0], x[2]) < FLOOR_RADIUS - 1 / self._per_unit
        settles, slides = touching & ~hops & ~steep, touching & ~hops & steep
        v[:, settles] = 0
        v[:, slides] = np.stack([-SLIDE * slope_x, 0 * slope_x, -SLIDE * slope_z])[:, slides]
        self.resting[rows[settles]] = True
        _collide_with_glass(x, v)
        self.position[:, rows], self.velocity[:, rows] = x, v
        self.angle[rows] += self._turn[rows] * (np.sqrt((v * v).sum(0)) * np.float32(seconds))
        self.morph[rows] += (1.0 - self.morph[rows]) * np.float32(-math.expm1(-seconds / MORPH))

    def _fly_step(self, seconds: float, moves: np.ndarray) -> None:
        assert self.remembering is not None
        rows = np.flatnonzero(moves)
        x, v = self.position[:, rows], self.velocity[:, rows]
        since = np.float32(self.remembering) - self._start[rows]
        starts = since < seconds
        self.resting[rows] = False
        v[0, starts] -= LAUNCH_VORTEX * x[2, starts]
        v[1, starts] -= self._launch[rows[starts]]
        v[2, starts] += LAUNCH_VORTEX * x[0, starts]
        turn = np.float32(2 * math.pi)
        self.angle[rows[starts]] -= turn * np.rint(self.angle[rows[starts]] / turn)
        # The cubic Hermite curve from (x, v) to (home, 0) in the remaining time, at `seconds`.
        left = np.maximum(np.float32(FLIGHT) - since, np.float32(seconds))
        s = np.float32(seconds) / left
        way = self.home[:, rows] - x
        x += way * (s * s * (3 - 2 * s)) + v * (left * s * (1 - s) ** 2)
        v = way * (6 * s * (1 - s) / left) + v * ((1 - s) * (1 - 3 * s))
        _collide_with_glass(x, v)
        arrives = s >= 1
        x[:, arrives], v[:, arrives] = self.home[:, rows[arrives]], 0
        self.position[:, rows], self.velocity[:, rows] = x, v
        self.angle[rows] *= (1 - s) ** 2
        self.morph[rows] *= 1 - s


def flow_grid(time: float) -> np.ndarray:
    """(3, cells z, cells y, cells x) float32: the flow of strength 1 on a grid over [−1, 1]³."""
    ticks = np.linspace(-1, 1, FLOW_CELLS)
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    potential = np.stack([-RING * z, 0 * y, RING * x])
    curl = np.stack([0 * x, np.full_like(x, -2 * RING), 0 * z])
    for kx, ky, kz, ax, ay, az, frequency, phase in WAVE:
        angle = kx * x + ky * y + kz * z + (frequency * time + phase)
        potential += np.sin(angle) * np.array([ax, ay, az])[:, None, None, None]
        across = np.cross([kx, ky, kz], [ax, ay, az])
        curl += np.cos(angle) * across[:, None, None, None]
    # b = (1 − |x|²) (FLOOR − y), with b = 0 outside.
    glass, floor = np.maximum(1 - (x * x + y * y + z * z), 0), np.maximum(FLOOR - y, 0)
    slope = np.stack([-2 * x * floor, -2 * y * floor - glass, -2 * z * floor]) * (glass * floor > 0)
    u = np.cross(slope, potential, axis=0) + glass * floor * curl
    return (u + np.stack([-VORTEX * z, 0 * y, VORTEX * x])).astype(np.float32)


def _in_range(limits: tuple[float, float], share: np.ndarray) -> np.ndarray:
    return (limits[0] + (limits[1] - limits[0]) * share).astype(np.float32)


def _collide_with_glass(x: np.ndarray, v: np.ndarray) -> None:
    """Move flakes (3, M) that are outside of the glass back to it, and reflect them."""
    out = np.flatnonzero((x * x).sum(0) > WALL * WALL)
    normal = x[:, out] / np.sqrt((x[:, out] ** 2).sum(0))
    x[:, out] = normal * np.float32(WALL)
    speed = (v[:, out] * normal).sum(0)
    v[:, out] -= normal * (np.maximum(speed, 0) * np.float32(1 + BOUNCE))


def _sample(heights: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bilinear interpolation of the pile at x (3, M): the height, and its slope along x and z."""
    cells = len(heights)
    per_unit = cells / (2 * FLOOR_RADIUS)
    fx, fz = (
        np.clip((x[axis] + FLOOR_RADIUS) * per_unit - 0.5, 0, cells - 1.001) for axis in (0, 2)
    )
    ix, iz = fx.astype(np.int64), fz.astype(np.int64)
    fx, fz = fx - ix, fz - iz
    a, b = heights[iz, ix], heights[iz, ix + 1]
    c, d = heights[iz + 1, ix], heights[iz + 1, ix + 1]
    low, high = a + (b - a) * fx, c + (d - c) * fx
    slope_x = ((b - a) * (1 - fz) + (d - c) * fz) * per_unit
    return low + (high - low) * fz, slope_x, (high - low) * per_unit
