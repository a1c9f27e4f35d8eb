"""The starts that need no points: random rays; the choice of starts."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at, morton_order, transform_points
from snowsplat.training.settings import TrainConfig, changed
from snowsplat.training.starts import random_points
from snowsplat.training.starts.init import initial_count, initial_gaussians, starts_at_random

SIZE = 64
RADIUS = 1.0
CONFIG = TrainConfig(sh_degree=1, initial_opacity=0.2, initial_scale=0.5, initial_points=70)


def texture(points: Tensor) -> Tensor:
    """(…, 3) in 0..1: smooth colours of positions on the unit sphere."""
    return 0.55 + 0.4 * torch.sin(4.0 * points + torch.tensor([0.0, 1.0, 2.0]))


def sphere_in(camera: Camera) -> tuple[Tensor, Tensor]:
    """The colours (H, W, 3) of the textured unit sphere in a view, and where it is (H, W)."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    cam = torch.stack(
        [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, torch.ones(x.shape)],
        dim=-1,
    ).to(torch.float64)
    start = camera.position.to(torch.float64)
    ends = transform_points(camera.world_from_cam.to(torch.float64), cam.reshape(-1, 3))
    ray = torch.nn.functional.normalize(ends - start, dim=1)
    along = -(ray @ start)
    discriminant = along**2 - (start @ start - RADIUS**2)
    hit = start + (along - discriminant.clamp(min=0.0).sqrt())[:, None] * ray
    shown = (discriminant > 0).reshape(y.shape)
    return texture(hit.to(torch.float32)).reshape(*y.shape, 3) * shown[..., None], shown


def cameras() -> list[Camera]:
    """Sixteen cameras around the sphere, at two heights."""
    angles = torch.linspace(0.0, 2.0 * math.pi, 17, dtype=torch.float64)[:16]
    heights = torch.tensor([-1.2, 1.5], dtype=torch.float64).repeat(8)
    centres = torch.stack([3.0 * angles.cos(), heights, 3.0 * angles.sin()], dim=1)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    origin = torch.zeros(3, dtype=torch.float64)
    return [
        Camera(SIZE, SIZE, 75.0, 75.0, SIZE / 2, SIZE / 2, look_at(centre, origin, up))
        for centre in centres
    ]


def written(folder: Path, transparent: bool) -> Dataset:
    views = []
    for i, camera in enumerate(cameras()):
        colors, shown = sphere_in(camera)
        channels = [255.0 * colors] + [255.0 * shown[..., None]] * transparent
        pixels = torch.cat(channels, dim=2).round().numpy().astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"{i}.png")
        views.append(View(f"{i}", camera, ImageSource(folder / f"{i}.png", SIZE, SIZE)))
    return Dataset(views, [], None, 3.5)


@pytest.fixture(scope="module", params=[True, False], ids=["transparent", "opaque"])
def sphere(request, tmp_path_factory) -> Dataset:
    """Photos of the textured sphere, before a transparent or a black background."""
    return written(tmp_path_factory.mktemp("sphere"), request.param)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_random_points_have_the_colours_of_their_rays(tmp_path: Path) -> None:
    """A photo whose left half is red; the points of a single view project to their colour."""
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :32, 0], pixels[:, 32:, 2] = 200, 100
    Image.fromarray(pixels).save(tmp_path / "a.png")
    camera = Camera(64, 48, 50.0, 50.0, 30.0, 25.0, torch.eye(4, dtype=torch.float64)[:3])
    view = View("a", camera, ImageSource(tmp_path / "a.png", 64, 48))
    dataset = Dataset([view], [], None, 1.0)
    points = random_points(dataset, ImageLoader([view]), 500, generator())
    assert len(points) == 500
    pixel, depth = camera.project(points.xyz)
    assert (depth > 0).all()
    assert float(depth.max() / depth.min()) > 5
    left = pixel[:, 0] < 32
    assert torch.equal(points.rgb[:, 0] == 200, left)
    assert torch.equal(points.rgb[:, 2] == 100, ~left)
    assert 180 < int(left.sum()) < 320


def test_random_points_are_in_several_views(sphere: Dataset) -> None:
    points = random_points(sphere, ImageLoader(sphere.train), 400, generator())
    number = torch.zeros(400)
    for view in sphere.train:
        pixel, depth = view.camera.project(points.xyz)
        number += (depth > 0) & ((pixel >= 0) & (pixel < SIZE)).all(1)
    assert (number >= 2).all()
    opaque = points.rgb.to(torch.int32).amax(1) > 20
    transparent = Image.open(sphere.train[0].image.path).mode == "RGBA"
    assert bool(opaque.all()) == transparent  # transparent pixels are not used


def test_the_same_seed_gives_the_same_points(sphere: Dataset) -> None:
    threads = torch.get_num_threads()
    images = ImageLoader(sphere.train)
    few = replace(sphere, train=sphere.train[::4])
    clouds = []
    try:
        for n, seed in ((1, 0), (3, 0), (1, 1)):
            torch.set_num_threads(n)
            clouds.append(random_points(few, images, 300, generator(seed)))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(clouds[0].xyz, clouds[1].xyz)
    assert torch.equal(clouds[0].rgb, clouds[1].rgb)
    assert not torch.equal(clouds[0].xyz, clouds[2].xyz)


def test_starts_are_joined(sphere: Dataset) -> None:
    points = Points(torch.rand(30, 3), torch.zeros(30, 3, dtype=torch.uint8))
    dataset = replace(sphere, points=points)
    config = changed(TrainConfig(), init="points+random", initial_points=0.25, max_gaussians=200)
    images = ImageLoader(dataset.train)
    gaussians = initial_gaussians(dataset, config, images, generator(), torch.device("cpu"))
    assert len(gaussians) == 30 + 50 == initial_count(dataset, config)
    assert not starts_at_random(dataset, config)
    assert starts_at_random(dataset, replace(config, init="random"))
    assert starts_at_random(replace(dataset, points=None), config)
    assert initial_count(replace(dataset, points=None), replace(config, init="points")) == 50


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
