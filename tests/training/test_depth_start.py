"""The start from depth maps of the dataset: kinds of values, alignment, masks, unusable maps."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.decode import ImageSource
from snowsplat.data.image_loader import ImageLoader
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, transform_points
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.starts import depth_points
from snowsplat.training.starts.init import initial_gaussians
from snowsplat.util.errors import SettingError, UserError

SIZE, FOCAL = 96, 120.0
COUNT = 800


def rays(camera: Camera) -> Tensor:
    """(H, W, 3) float64, in the camera frame, with z = 1."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    u, v = (x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy
    return torch.stack([u, v, torch.ones(x.shape)], dim=-1).to(torch.float64)


def z_of_sphere(camera: Camera) -> Tensor:
    """(H, W) float64: camera z of the unit sphere at the origin; NaN beside it."""
    ray = rays(camera)
    centre = -camera.cam_from_world.to(torch.float64)[:, 3]  # of the camera, in its own axes
    a, b = ray.square().sum(2), (ray * centre).sum(2)
    discriminant = b**2 - a * (centre @ centre - 1.0)
    z = (-b - discriminant.clamp(min=0.0).sqrt()) / a
    return torch.where(discriminant > 0, z, torch.nan)


def cameras() -> list[Camera]:
    """Six cameras, 10 degrees apart."""
    up, origin = torch.tensor([0.0, -1.0, 0.0]).double(), torch.zeros(3).double()
    angles = [math.radians(10.0 * i) for i in range(6)]
    centres = [torch.tensor([3 * math.cos(a), -0.5, 3 * math.sin(a)]).double() for a in angles]
    size = (SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2)
    return [Camera(*size, look_at(centre, origin, up)) for centre in centres]


def points_of(maps: list[Tensor]) -> Points:
    """Every 7th pixel of the sphere in every second view, as structure from motion finds points."""
    found = []
    for camera, z in zip(cameras()[::2], maps[::2], strict=True):
        cam = (rays(camera) * z[..., None]).reshape(-1, 3)
        world = transform_points(camera.world_from_cam.double(), cam[cam.isfinite().all(1)])
        found.append(world[::7].float())
    xyz = torch.cat(found)
    return Points(xyz, torch.zeros(xyz.shape, dtype=torch.uint8))


def write(path: Path, kind: str, z: Tensor, i: int) -> Path:
    """A depth map file: of another unit, and with an own scale and shift, for each kind."""
    camera = cameras()[i]
    if kind == "png in mm":
        path = path.with_suffix(".png")
        Image.fromarray((1000 * z).nan_to_num(0.0).round().numpy().astype(np.uint16)).save(path)
        return path
    path = path.with_suffix(".npy")
    if kind == "distance":
        z = (0.3 + 0.1 * i) * z * rays(camera).norm(dim=2)
    elif kind == "disparity":
        z = (2.0 + i) / z + 0.3 * i + 0.5
    np.save(path, z.float().numpy())
    return path


def dataset(folder: Path, kind: str = "png in mm") -> Dataset:
    maps = [z_of_sphere(camera) for camera in cameras()]
    views = []
    for i, (camera, z) in enumerate(zip(cameras(), maps, strict=True)):
        photo = folder / f"{i}.png"
        Image.fromarray(np.full((SIZE, SIZE, 3), 40 * i, np.uint8)).save(photo)
        depth = write(folder / f"depth{i}", kind, z, i)
        views.append(View(f"{i}", camera, ImageSource(photo, SIZE, SIZE), depth=depth))
    return Dataset(views, [], points_of(maps), 3.0)


def found(data: Dataset) -> Points:
    return depth_points(data, ImageLoader(data.train), COUNT, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("kind", ["png in mm", "distance", "disparity"])
def test_points_lie_on_the_surface(tmp_path: Path, kind: str) -> None:
    points = found(dataset(tmp_path, kind))
    assert COUNT / 2 < len(points) <= COUNT
    error = (points.xyz.norm(dim=1) - 1.0).abs()
    assert float(error.median()) < 0.005
    assert float(error.max()) < 0.05
    # Each point has the grey value of the photos that show it.
    assert int(points.rgb.min()) >= 0
    assert int(points.rgb.max()) <= 200
    assert len(points.rgb.unique()) > 4


def test_without_points_the_maps_are_z_in_world_units(tmp_path: Path) -> None:
    data = replace(dataset(tmp_path, "z"), points=None)
    error = (found(data).xyz.norm(dim=1) - 1.0).abs()
    assert float(error.max()) < 0.03


def test_without_points_maps_may_have_a_unit(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    views = [replace(view, depth_unit=1e-3) for view in data.train]
    error = (found(replace(data, train=views, points=None)).xyz.norm(dim=1) - 1.0).abs()
    assert float(error.max()) < 0.03


def test_depths_of_no_confidence_are_not_used(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    confidence = np.full((SIZE, SIZE), 255, np.uint8)
    confidence[: SIZE // 2] = 0
    Image.fromarray(confidence).save(tmp_path / "confidence.png")
    file = tmp_path / "confidence.png"
    points = found(replace(data, train=[replace(v, depth_confidence=file) for v in data.train]))
    camera = cameras()[2]
    all_rows, rows = (camera.project(p.xyz)[0][:, 1] for p in (found(data), points))
    assert int((all_rows < SIZE / 2 - 8).sum()) > 50
    assert int((rows < SIZE / 2 - 8).sum()) == 0
    assert len(points) > 100


def test_the_first_gaussians_are_at_the_points(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    config = replace(TrainConfig(), init="depth", initial_points=COUNT)
    gaussians = initial_gaussians(
        *(data, config, ImageLoader(data.train), torch.Generator().manual_seed(0)),
        torch.device("cpu"),
    )
    assert float((gaussians.means.norm(dim=1) - 1.0).abs().max()) < 0.05


def test_masked_pixels_are_not_used(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    mask = np.full((SIZE, SIZE), 255, np.uint8)
    mask[: SIZE // 2] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    source = ImageSource(tmp_path / "mask.png", SIZE, SIZE)
    masked = replace(data, train=[replace(view, mask=source) for view in data.train])
    points = found(masked)
    camera = cameras()[2]
    all_rows, rows = (camera.project(p.xyz)[0][:, 1] for p in (found(data), points))
    assert int((all_rows < SIZE / 2 - 8).sum()) > 50
    assert int((rows < SIZE / 2 - 8).sum()) == 0
    assert len(points) > 100


def test_a_map_that_contradicts_the_points_is_not_used(tmp_path: Path, caplog) -> None:
    data = dataset(tmp_path)
    noise = np.random.default_rng(0).uniform(1, 60000, (SIZE, SIZE)).astype(np.uint16)
    Image.fromarray(noise).save(data.train[0].depth)
    with caplog.at_level(logging.WARNING):
        points = found(data)
    assert caplog.messages == ["1 depth maps do not agree with the points; not used"]
    assert float((points.xyz.norm(dim=1) - 1.0).abs().max()) < 0.05
    for view in data.train:
        Image.fromarray(noise).save(view.depth)
    with pytest.raises(UserError, match="no depth map agrees with the points"):
        found(data)


def test_a_dataset_without_usable_maps(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    without = replace(data, train=[replace(view, depth=None) for view in data.train])
    with pytest.raises(SettingError, match="depths/IMG.png"):
        found(without)
    Image.fromarray(np.ones((SIZE, SIZE // 2), np.uint16)).save(data.train[1].depth)
    with pytest.raises(UserError, match="48x96 pixels, but its photo has 96x96"):
        found(data)
    data.train[1].depth.write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"depth1\.png: cannot be read as a depth map"):
        found(data)
