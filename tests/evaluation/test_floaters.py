"""Floaters before a wall, and Gaussians behind it."""

import pytest
import torch

from snowsplat.evaluation.floaters import clean, coverage
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at

WALL = 40 * 40
FLOATER, HIDDEN, BEHIND = WALL, WALL + 1, WALL + 2


@pytest.fixture
def scene() -> Gaussians:
    """An opaque wall at z = 4, a half transparent floater at z = 2, and one Gaussian behind the
    wall and one behind the cameras."""
    u = torch.linspace(-3.0, 3.0, 40)
    wall = torch.stack([*torch.meshgrid(u, u, indexing="ij"), torch.full((40, 40), 4.0)], dim=2)
    others = torch.tensor([[0.2, 0.1, 2.0], [0.0, 0.0, 6.0], [0.0, 0.0, -9.0]])
    means = torch.cat([wall.reshape(-1, 3), others])
    n = len(means)
    scales = torch.tensor([0.2, 0.2, 0.01]).log().repeat(n, 1)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    opacities = torch.full((n,), 5.0)
    opacities[FLOATER] = 0.0
    generator = torch.Generator().manual_seed(0)
    colors = torch.randn(n, 1, 3, generator=generator)
    return Gaussians(means, scales, quats, opacities, colors, torch.zeros(n, 0, 3))


@pytest.fixture
def cameras() -> list[Camera]:
    places = [(-0.5, 0.0, 0.0), (0.0, 0.3, 0.0), (0.5, 0.0, 0.0)]
    ahead, up = (0.0, 0.0, 4.0), (0.0, -1.0, 0.0)
    poses = [look_at(*map(torch.tensor, (place, ahead, up))) for place in places]
    return [Camera(120, 90, 100.0, 100.0, 60.0, 45.0, pose) for pose in poses]


def test_position_relative_to_the_wall(scene, cameras):
    found = coverage(scene, cameras)
    assert found.floaters.nonzero()[:, 0].tolist() == [FLOATER]
    assert found.position[FLOATER] == pytest.approx(0.5, abs=0.05)  # at half the depth of the wall
    seen = found.weight[:WALL] > 1.0
    assert int(seen.sum()) > WALL // 2
    assert (found.position[:WALL][seen] - 1.0).abs().max() < 0.1
    useless = found.useless.nonzero()[:, 0].tolist()
    assert {HIDDEN, BEHIND} <= set(useless)
    assert FLOATER not in useless


def test_weights_are_those_of_the_image(scene, cameras):
    """The weights of all Gaussians add up to the opacity of the image."""
    from snowsplat.scene.render import render

    found = coverage(scene, cameras)
    alpha = sum(float(render(scene, camera).alpha.sum()) for camera in cameras)
    assert float(found.weight.sum()) == pytest.approx(alpha, rel=1e-4)


def test_the_quality_decides(scene, cameras):
    floats = scene.means[FLOATER]

    def has_floater(gaussians: Gaussians) -> bool:
        return bool((gaussians.means == floats).all(1).any())

    def prefers_it(gaussians: Gaussians) -> float:
        return float(has_floater(gaussians))

    cleaned = clean(scene, cameras, lambda gaussians: -prefers_it(gaussians))
    assert not has_floater(cleaned)
    assert len(cleaned) < len(scene) - 2
    assert has_floater(clean(scene, cameras, prefers_it))
    assert not has_floater(clean(scene, cameras, prefers_it, enough=-1.0))


def test_no_gaussians_and_no_floaters(scene, cameras):
    assert len(clean(scene.select(torch.zeros(0, dtype=torch.long)), cameras, lambda _: 0.0)) == 0
    wall = scene.select(torch.arange(WALL))
    cleaned = clean(wall, cameras, lambda _: 0.0)
    assert len(cleaned) == int((~coverage(wall, cameras).useless).sum())
