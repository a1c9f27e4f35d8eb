"""Dense initialisation: source views, depth maps by plane sweep, fusion into points."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import max_pool2d

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource, load_views
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.pipeline.mesh import _photos, confirm_by_photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.surface import depth as surface_depth
from snowsplat.training.settings import TrainConfig, changed
from snowsplat.training.starts import swept_points
from snowsplat.training.starts.depth_map import DepthMap
from snowsplat.training.starts.fusion import confirmed_pixels, merge_points
from snowsplat.training.starts.init import initial_gaussians
from snowsplat.training.starts.plane_sweep import depth_maps
from snowsplat.training.starts.source_views import source_views
from snowsplat.util.errors import SettingError

WIDTH, HEIGHT = 96, 72
#: The plane z = 4 + 0.3 x, in the world frame.
SLOPE, DISTANCE = 0.3, 4.0


def camera_at(x: float, y: float = 0.0) -> Camera:
    """A camera in the plane z = 0 that looks at the middle of the textured plane."""
    position = torch.tensor([x, y, 0.0], dtype=torch.float64)
    target = torch.tensor([0.0, 0.0, DISTANCE], dtype=torch.float64)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return Camera(
        WIDTH, HEIGHT, 90.0, 90.0, WIDTH / 2, HEIGHT / 2, look_at(position, target, -down)
    )


POSITIONS = ((-0.8, 0.0), (-0.4, 0.2), (0.0, 0.0), (0.4, -0.2), (0.8, 0.0))
CAMERAS = [camera_at(x, y) for x, y in POSITIONS]


def true_points(camera: Camera) -> Tensor:
    """(H, W, 3) float64: where the ray of each pixel meets the plane."""
    y, x = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    right, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    cam = torch.stack([right, down, torch.ones_like(x)], dim=2)
    pose = camera.world_from_cam
    ray, origin = cam.to(torch.float64) @ pose[:, :3].T, pose[:, 3]
    along = (DISTANCE + SLOPE * origin[0] - origin[2]) / (ray[..., 2] - SLOPE * ray[..., 0])
    return origin + along[..., None] * ray


def true_inverse_depth(camera: Camera) -> Tensor:
    """(H, W) float64."""
    points = true_points(camera).reshape(-1, 3)
    return (1.0 / camera.project(points)[1]).reshape(camera.height, camera.width)


def texture(points: Tensor) -> Tensor:
    """(…, 3) in 0..1, a sum of waves in x and y."""
    random = torch.Generator().manual_seed(3)
    value = torch.zeros(points.shape[:-1], dtype=torch.float64)
    for _ in range(24):
        angle, phase = (2 * math.pi * torch.rand(2, generator=random)).tolist()
        wave = 4.0 + 12.0 * float(torch.rand(1, generator=random))
        along = math.cos(angle) * points[..., 0] + math.sin(angle) * points[..., 1]
        value += torch.sin(wave * along + phase)
    value = (0.5 + value / 16.0).clamp(0.0, 1.0)
    return torch.stack([value, 0.8 * value, 0.5 + 0.0 * value], dim=-1)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Five photos of the plane, and 200 points on it."""
    folder = tmp_path_factory.mktemp("plane")
    views = []
    for i, camera in enumerate(CAMERAS):
        pixels = (255 * texture(true_points(camera))).round().to(torch.uint8)
        path = folder / f"{i}.png"
        Image.fromarray(pixels.numpy()).save(path)
        views.append(View(path.name, camera, ImageSource(path, WIDTH, HEIGHT)))
    xyz = true_points(CAMERAS[2]).reshape(-1, 3)[:: HEIGHT * WIDTH // 200].to(torch.float32)
    rgb = (255 * texture(xyz.to(torch.float64))).to(torch.uint8)
    return Dataset(views, [], Points(xyz, rgb), 1.0)


def photos(dataset: Dataset) -> ImageLoader:
    return ImageLoader(dataset.train, background=(0.0, 0.0, 0.0))


def maps_of(dataset: Dataset) -> tuple[list[DepthMap | None], list[list[int]]]:
    assert dataset.points is not None
    sources = source_views(CAMERAS, dataset.points.xyz, 4)
    return depth_maps(dataset.train, sources, photos(dataset), dataset.points.xyz), sources


def initialised(dataset: Dataset, config: TrainConfig, seed: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(seed)
    return initial_gaussians(dataset, config, photos(dataset), random, torch.device("cpu"))


def test_source_views_show_the_same_points_from_suitable_angles() -> None:
    points = torch.tensor([0.0, 0.0, DISTANCE]) + 0.5 * torch.rand(50, 3)
    same = camera_at(0.001)  # no parallax with the view at 0
    behind = replace(camera_at(0.1), cam_from_world=CAMERAS[2].cam_from_world.clone())
    behind.cam_from_world[2] *= -1.0
    behind.cam_from_world[0] *= -1.0
    aside = camera_at(6.0)  # more than 40 degrees from the others
    sources = source_views([*CAMERAS, same, behind, aside], points, 7)
    assert set(sources[2]) == {0, 1, 3, 4}
    assert 0 in sources[5]
    assert 2 not in sources[5]
    assert sources[6] == sources[7] == []
    assert [len(chosen) for chosen in source_views(CAMERAS, points, 2)] == [2] * 5


def test_depth_maps_of_a_plane(dataset: Dataset) -> None:
    maps, _ = maps_of(dataset)
    for depth_map in maps:
        assert depth_map is not None
        assert depth_map.inverse_depth.shape == (HEIGHT, WIDTH)
        known = depth_map.inverse_depth > 0
        assert float(known.float().mean()) > 0.6
        error = depth_map.inverse_depth / true_inverse_depth(depth_map.camera) - 1.0
        assert float(error[known].abs().median()) < 0.005
        assert float((error[known].abs() < 0.03).float().mean()) > 0.9


def test_depths_of_what_is_behind_the_points(dataset: Dataset) -> None:
    """An object before a room that has no points."""
    assert dataset.points is not None
    sources = source_views(CAMERAS, dataset.points.xyz, 4)
    maps = depth_maps(dataset.train, sources, photos(dataset), 0.5 * dataset.points.xyz)
    for depth_map in maps:
        assert depth_map is not None
        known = depth_map.inverse_depth > 0
        assert float(known.float().mean()) > 0.6
        error = depth_map.inverse_depth / true_inverse_depth(depth_map.camera) - 1.0
        assert float(error[known].abs().median()) < 0.005


def test_photos_correct_the_depths_of_a_mesh(dataset: Dataset) -> None:
    """Depths that are 4% too small, with a hole and a part without a surface."""
    maps, weight = [], torch.full((HEIGHT, WIDTH), 255, dtype=torch.uint8)
    for camera in CAMERAS:
        depth = (0.96 / true_inverse_depth(camera)).to(torch.float32)
        depth[:10], depth[-10:] = 0.0, math.inf
        maps.append(surface_depth.DepthMap(camera, depth, weight.clone()))
    found, far = copy.deepcopy(maps), copy.deepcopy(maps)
    confirm_by_photos(dataset.train, found, 100.0, lambda *_: None)
    for each, camera in zip(found, CAMERAS, strict=True):
        error = (each.depth * true_inverse_depth(camera) - 1.0).abs()
        confirmed = each.weight == 255
        assert float(confirmed[10:-10].float().mean()) > 0.5
        assert float(error[10:-10][confirmed[10:-10]].median()) < 0.005
        assert (each.weight[:-10][~confirmed[:-10]] == 64).all()
        assert each.depth[-10:].isinf().all()
        assert (each.weight[-10:] == 255).all()
        assert float((each.depth[:10] > 0).float().mean()) > 0.2
    confirm_by_photos(dataset.train, far, 1.0, lambda *_: None)
    assert all(torch.equal(a.depth, b.depth) for a, b in zip(far, maps, strict=True))


def test_photos_that_are_larger_than_their_maps_are_decoded_once(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[Path] = []

    def load(sources: Sequence[tuple[ImageSource, object]], background: object) -> object:
        decoded.append(sources[0][0].path)
        return load_views(sources, background)

    monkeypatch.setattr("snowsplat.data.photos.image_loader.load_views", load)
    monkeypatch.setattr("snowsplat.pipeline.mesh.LONGER_SIDE", 24)
    weight = torch.full((18, 24), 255, dtype=torch.uint8)
    small = [camera.scaled(24, 18) for camera in CAMERAS]
    maps = [
        surface_depth.DepthMap(camera, (1.0 / true_inverse_depth(camera)).float(), weight.clone())
        for camera in small
    ]
    confirm_by_photos(dataset.train, maps, 100.0, lambda *_: None)
    assert len(list(_photos(dataset.train, maps, torch.device("cpu"), lambda *_: None))) == 5
    assert sorted(decoded) == sorted(2 * [view.image.path for view in dataset.train])


def test_depths_next_to_confirmed_ones_lose_the_same_error(dataset: Dataset) -> None:
    weight = torch.full((HEIGHT, WIDTH), 255, dtype=torch.uint8)
    maps = [
        surface_depth.DepthMap(camera, (1.02 / true_inverse_depth(camera)).float(), weight.clone())
        for camera in CAMERAS
    ]
    confirm_by_photos(dataset.train, maps, 100.0, lambda *_: None)
    errors = []
    for each, camera in zip(maps, CAMERAS, strict=True):
        confirmed = each.weight == 255
        near = max_pool2d(confirmed.float()[None], 3, 1, 1)[0] > 0
        error = (each.depth * true_inverse_depth(camera) - 1.0).abs()
        errors.append(error[near & ~confirmed])
    assert len(torch.cat(errors)) > 100
    assert float(torch.cat(errors).median()) < 0.008


def test_views_without_sources_or_points_have_no_map(dataset: Dataset) -> None:
    assert dataset.points is not None
    alone = depth_maps(dataset.train, [[]] * 5, photos(dataset), dataset.points.xyz)
    assert alone == [None] * 5
    few = depth_maps(dataset.train, [[1]] * 5, photos(dataset), dataset.points.xyz[:3])
    assert few == [None] * 5


def test_masked_and_transparent_pixels_are_unknown(dataset: Dataset, tmp_path: Path) -> None:
    views = list(dataset.train)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :50] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    views[2] = replace(views[2], mask=ImageSource(tmp_path / "mask.png", WIDTH, HEIGHT))
    rgba = Image.open(views[1].image.path).convert("RGBA")
    rgba.putalpha(Image.fromarray(mask))
    rgba.save(tmp_path / "rgba.png")
    views[1] = replace(views[1], image=ImageSource(tmp_path / "rgba.png", WIDTH, HEIGHT))
    changed_dataset = replace(dataset, train=views)
    assert dataset.points is not None
    sources = source_views(CAMERAS, dataset.points.xyz, 4)
    images = ImageLoader(views)  # keeps alpha
    maps = depth_maps(changed_dataset.train, sources, images, dataset.points.xyz)
    for i in (1, 2):
        depth_map = maps[i]
        assert depth_map is not None
        assert not depth_map.inverse_depth[:, :50].any()
        assert depth_map.inverse_depth[:, 50:].any()


def test_only_depths_that_another_map_confirms_are_used(dataset: Dataset) -> None:
    maps, sources = maps_of(dataset)
    confirmed = confirmed_pixels(maps, sources, torch.device("cpu"))
    assert all(float(chosen.float().mean()) > 0.5 for chosen in confirmed)
    wrong = maps[2]
    assert wrong is not None
    inverse = wrong.inverse_depth.clone()
    inverse[:30] *= 1.1
    maps[2] = replace(wrong, inverse_depth=inverse)
    confirmed = confirmed_pixels(maps, sources, torch.device("cpu"))
    assert float(confirmed[2][:30].float().mean()) < 0.1
    assert float(confirmed[2][32:].float().mean()) > 0.5


def test_points_of_a_map() -> None:
    pose = torch.eye(4, dtype=torch.float64)[:3]
    pose[:, 3] = -50.0
    depth_map = DepthMap(Camera(2, 2, 1.0, 1.0, 1.0, 1.0, pose), torch.full((2, 2), 0.5))
    xyz = depth_map.points(torch.tensor([[True, True], [False, False]]))
    torch.testing.assert_close(xyz, 50.0 + torch.tensor([[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0]]))


def test_thinned_points_are_the_means_of_their_voxels() -> None:
    random = torch.Generator().manual_seed(2)
    near, far = torch.tensor([3.3, 3.3, 3.3]), torch.tensor([100.1, 100.1, 100.1])
    points = torch.cat([near + 0.1 * torch.rand(30, 3, generator=random), far.expand(20, 3)])
    colors = torch.arange(50, dtype=torch.uint8)[:, None].repeat(1, 3)
    widths = torch.cat([torch.full((30,), 0.01), torch.full((20,), 0.3)])
    two = merge_points(points, colors, widths, 2)
    order = two.xyz[:, 0].argsort()
    torch.testing.assert_close(two.xyz[order], torch.stack([points[:30].mean(0), far]))
    assert two.rgb[order, 0].tolist() == [14, 40]  # 14.5 is rounded to the even number; 39.5 too
    some = merge_points(points, colors, widths, 20)
    assert 5 < len(some) <= 20
    all_of_them = merge_points(points, colors, widths, 50)
    assert 20 < len(all_of_them) <= 31
    assert len(merge_points(points[:0], colors[:0], widths[:0], 9)) == 0


def test_dense_points_lie_on_the_surface(dataset: Dataset) -> None:
    points = swept_points(dataset, photos(dataset), 300, torch.Generator().manual_seed(0))
    assert 100 < len(points) <= 300
    distance = points.xyz[:, 2] - (DISTANCE + SLOPE * points.xyz[:, 0])
    assert float(distance.abs().median()) < 0.02
    expected = 255 * texture(points.xyz.to(torch.float64))
    assert float((points.rgb - expected).abs().median()) < 25


def test_initial_gaussians_with_swept_points(dataset: Dataset) -> None:
    assert dataset.points is not None
    config = changed(TrainConfig(), max_gaussians=1000, init="points+sweep", initial_points=0.4)
    first, same = (initialised(dataset, config) for _ in range(2))
    assert len(dataset.points) + 200 < len(first) <= len(dataset.points) + 400
    assert torch.equal(first.means, same.means)
    without = initialised(dataset, replace(config, init="points"))
    assert len(without) == len(dataset.points)


def test_a_dataset_without_points(dataset: Dataset) -> None:
    config = changed(TrainConfig(), max_gaussians=1000, init="points+sweep", initial_points=0.4)
    gaussians = initialised(replace(dataset, points=None), config)
    distance = gaussians.means[:, 2] - (DISTANCE + SLOPE * gaussians.means[:, 0])
    assert 100 < len(gaussians) <= 400
    assert float(distance.abs().median()) < 0.03


def test_dense_points_need_a_limit(dataset: Dataset) -> None:
    config = changed(TrainConfig(), init="points", initial_points=0.4)
    with pytest.raises(SettingError, match="max_gaussians"):
        initialised(replace(dataset, points=None), config)
