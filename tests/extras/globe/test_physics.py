"""The motion of the Gaussians in a globe."""

import math

import numpy as np
import pytest

from snowsplat.extras.globe import physics
from snowsplat.extras.globe.dimensions import FLOOR, FLOOR_RADIUS, WALL
from snowsplat.extras.globe.physics import REMEMBER_SECONDS, SHAKE_SECONDS, Snow, shake_acceleration

STEP = 1 / 30


def snow(count: int = 1200) -> Snow:
    """Gaussians in a box on the floor."""
    random = np.random.default_rng(3)
    low, high = (-0.5, -0.4, -0.5), (0.5, FLOOR, 0.5)
    return Snow(random.uniform(low, high, (count, 3)).T)


def shake(snow: Snow) -> None:
    for i in range(math.ceil(SHAKE_SECONDS / STEP)):
        strength = shake_acceleration(i * STEP)
        snow.step(STEP, (0.94 * strength, 0.28 * strength, 0.2 * strength))


def run(snow: Snow, seconds: float) -> None:
    for _ in range(math.ceil(seconds / STEP)):
        snow.step(STEP)


def test_an_undisturbed_scene_stands():
    still = snow()
    run(still, 1.0)
    assert still.standing
    assert (still.position == still.home).all()
    # A soft push does not loosen it, and is forgotten.
    for _ in range(8):
        still.step(STEP, (2.0, 0.0, 0.0))
        run(still, 8.0)
    assert still.standing
    assert (still.position == still.home).all()


def test_a_weak_shake_loosens_only_some_from_the_top():
    shaken = snow()
    for _ in range(10):
        shaken.step(STEP, (14.0, 0.0, 0.0))
    moved = (shaken.position != shaken.home).any(0)
    assert 0.1 < moved.mean() < 0.9
    assert shaken.home[1, moved].mean() < shaken.home[1, ~moved].mean() - 0.1  # y is down


def test_a_shake_fills_the_globe_with_flakes():
    shaken = snow()
    shake(shaken)
    run(shaken, 0.7)
    assert (shaken.position != shaken.home).any(0).all()
    assert shaken.morph.min() > 0.5
    # In each octant of the glass there are flakes.
    octant = (shaken.position > 0).T @ np.array([1, 2, 4])
    assert np.bincount(octant, minlength=8).min() > 0.02 * len(octant)


def test_nobody_leaves_the_glass():
    shaken = snow()
    for _ in range(3):
        shake(shaken)
        run(shaken, 1.0)
        assert np.linalg.norm(shaken.position, axis=0).max() < WALL + 1e-5
        assert shaken.position[1].max() < FLOOR + 1e-5
    shaken.remember()
    for _ in range(math.ceil(REMEMBER_SECONDS / STEP)):
        shaken.step(STEP)
        assert np.linalg.norm(shaken.position, axis=0).max() < WALL + 1e-5


def test_the_energy_decreases_in_still_liquid():
    """Kinetic and potential energy of each flake, with gravity g = k w, while it falls."""
    falling = snow()
    shake(falling)
    falling.strength = 0.0
    falling._phase[:] = 0.0
    circles = physics.CIRCLE[0]
    before = np.inf
    for _ in range(20):
        gravity = falling._drag * falling._fall
        kinetic = 0.5 * np.square(falling.velocity).sum(0)
        energy = (kinetic - gravity * falling.position[1]).mean()
        # Circling moves a flake by at most circles · step along the gravity.
        assert energy < before + circles * STEP * gravity.mean()
        before = energy
        falling.step(STEP)
    run(falling, 12.0)
    assert falling.resting.mean() > 0.99
    assert np.abs(falling.velocity[:, falling.resting]).max() == 0


def test_flakes_pile_up():
    fallen = snow()
    shake(fallen)
    run(fallen, 14.0)
    assert fallen.resting.mean() > 0.99
    y = fallen.position[1, fallen.resting]
    assert y.min() > FLOOR - physics.HIGHEST - 1e-5
    assert np.quantile(y, 0.05) < FLOOR - 0.02  # they lie on each other
    assert np.hypot(fallen.position[0], fallen.position[2]).max() < FLOOR_RADIUS + 0.15
    heights = fallen.pile()
    assert abs(heights.sum() / (math.pi * len(heights) ** 2 / 4) / physics.PILE_DEPTH - 1) < 0.2


def test_remember_ends_exactly_at_home():
    shaken = snow()
    shake(shaken)
    run(shaken, 3.0)
    shaken.remember()
    run(shaken, 0.62 * REMEMBER_SECONDS)
    distance = np.linalg.norm(shaken.position - shaken.home, axis=0)
    assert distance.mean() > 0.05  # on the way
    assert (distance == 0).mean() > 0.01  # already there
    run(shaken, 0.5 * REMEMBER_SECONDS)
    assert shaken.standing
    for values in (shaken.velocity, shaken.angle, shaken.morph, shaken.resting):
        assert not values.any()
    assert (shaken.position == shaken.home).all()


def test_another_shake_interrupts_the_flight_home():
    shaken = snow()
    shake(shaken)
    shaken.remember()
    run(shaken, 1.0)
    shake(shaken)
    assert shaken.remembering is None
    run(shaken, REMEMBER_SECONDS)
    assert not shaken.standing


def test_the_flow_keeps_its_volume_and_does_not_cross_the_glass():
    flow = physics.flow_grid(0.7).astype(float)
    cells = physics.FLOW_CELLS
    spacing = 2 / (cells - 1)
    ticks = np.linspace(-1, 1, cells)
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    inside = (x * x + y * y + z * z < 0.75**2) & (y < FLOOR - 0.2)
    divergence = sum(np.gradient(flow[axis], spacing, axis=2 - axis) for axis in range(3))
    gradients = [np.gradient(flow[a], spacing, axis=b) for a in range(3) for b in range(3)]
    # Finite differences on a coarse grid are not exact.
    assert divergence[inside].std() < 0.15 * np.std([g[inside] for g in gradients])
    # On the glass, the normal velocity is small. The corners of the cells there are on both sides.
    random = np.random.default_rng(0)
    normal = random.normal(size=(3, 500))
    normal /= np.linalg.norm(normal, axis=0)
    normal = normal[:, normal[1] < FLOOR - 0.1]
    u = snow(2).flow((0.99 * normal).astype(np.float32))
    assert np.abs((u * normal).sum(0)).mean() < 0.35 * np.linalg.norm(u, axis=0).mean()


def test_a_step_may_not_be_long():
    with pytest.raises(ValueError, match="at most"):
        snow(3).step(0.1)
