"""Initialisation from points, as in section 5.1 of the paper, and at random."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.training.settings import TrainConfig, changed
from snowsplat.training.starts.init import initial_gaussians

CONFIG = TrainConfig(sh_degree=1, initial_opacity=0.2, initial_scale=0.5, initial_points=70)


def dataset_of(xyz: torch.Tensor | None) -> Dataset:
    pose = torch.eye(4, dtype=torch.float64)[:3]
    view = View("a", Camera(8, 6, 9.0, 9.0, 4.0, 3.0, pose), ImageSource(Path("a"), 8, 6))
    if xyz is None:
        return Dataset([view], [], None, 1.0)
    rgb = torch.arange(len(xyz), dtype=torch.uint8)[:, None].repeat(1, 3)
    return Dataset([view], [], Points(xyz, rgb), 1.0)


def initialised(dataset: Dataset, config: TrainConfig = CONFIG, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    images = ImageLoader(dataset.train)
    return initial_gaussians(dataset, config, images, generator, torch.device("cpu"))


def corners_of_a_cube() -> torch.Tensor:
    """Each has three nearest neighbours at a distance of 2."""
    ends = torch.tensor([0.0, 2.0])
    return torch.cartesian_prod(ends, ends, ends)


def test_gaussians_of_points() -> None:
    corners = corners_of_a_cube()
    gaussians = initialised(dataset_of(corners.flip(0)))
    assert len(gaussians) == 8
    torch.testing.assert_close(gaussians.scales, torch.full((8, 3), 0.5 * 2.0))
    torch.testing.assert_close(gaussians.opacities, torch.full((8,), 0.2))
    assert gaussians.sh_rest.shape == (8, 3, 3)
    assert not gaussians.sh_rest.any()


def test_colours_belong_to_their_points_in_morton_order() -> None:
    xyz = torch.rand(100, 3, generator=torch.Generator().manual_seed(5))
    gaussians = initialised(dataset_of(xyz))
    points = (255 * gaussians.base_colors[:, 0]).round().long()
    assert torch.equal(gaussians.means, xyz[points])
    assert torch.equal(morton_order(gaussians.means), torch.arange(100))
    assert not torch.equal(points, torch.arange(100))


@pytest.mark.parametrize(("limit", "count"), [(0, 100), (30, 30), (100, 100), (500, 100)])
def test_the_limit_chooses_points_at_random(limit: int, count: int) -> None:
    xyz = torch.rand(100, 3, generator=torch.Generator().manual_seed(5))
    config = changed(CONFIG, max_gaussians=limit)
    first, same, other = (initialised(dataset_of(xyz), config, seed) for seed in (1, 1, 2))
    assert len(first) == len(other) == count
    assert len(first.means.unique(dim=0)) == count
    assert torch.equal(first.means, same.means)
    assert torch.equal(first.means, other.means) == (count == 100)


@pytest.mark.parametrize(("limit", "count"), [(0, 70), (30, 30), (500, 70)])
def test_random_points(limit: int, count: int, tmp_path: Path) -> None:
    Image.new("RGB", (8, 6), (200, 100, 50)).save(tmp_path / "a.png")
    dataset = dataset_of(None)
    view = replace(dataset.train[0], image=ImageSource(tmp_path / "a.png", 8, 6))
    dataset = replace(dataset, train=[view])
    gaussians = initialised(dataset, changed(CONFIG, max_gaussians=limit))
    assert len(gaussians) == count
    assert (view.camera.project(gaussians.means)[1] > 0).all()
    torch.testing.assert_close(gaussians.opacities, torch.full((count,), 0.2))
    assert gaussians.sh_rest.shape == (count, 3, 3)
    assert torch.equal(morton_order(gaussians.means), torch.arange(count))
    larger = initialised(dataset, changed(CONFIG, max_gaussians=limit, initial_scale=1.0))
    torch.testing.assert_close(larger.scales, 2.0 * gaussians.scales)
