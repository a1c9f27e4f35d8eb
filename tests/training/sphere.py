"""A sphere in six photos of one grey each, with its depth maps in files."""

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from snowsplat import TrainConfig, Trainer
from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, transform_points

SIZE, FOCAL = 96, 120.0


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


def resumed_with_the_same_bits(data: Dataset, config: TrainConfig, at: int, until: int) -> Trainer:
    """A training that is resumed after step ``at`` has the state of one that is not, ``until``."""
    whole, first = Trainer(data, config), Trainer(data, config)
    whole.run(until=until)
    first.run(until=at)
    state = {name: tensor.clone() for name, tensor in first.state_tensors().items()}
    second = Trainer(data, config, state=state)
    second.step = first.step
    second.run(until=until)
    for name, tensor in second.state_tensors().items():
        assert torch.equal(tensor, whole.state_tensors()[name]), name
    return second
