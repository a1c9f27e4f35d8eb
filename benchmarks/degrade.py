"""Copies a dataset and changes its training photos, or their poses, at random.

    python benchmarks/degrade.py fox_small /tmp/degraded --exposure 1 --white-balance 0.1 --seed 3
    python benchmarks/degrade.py fox_small /tmp/moved --rotation 0.3 --translation 0.005
    python benchmarks/recipes.py default:exposure=off default --datasets /tmp --captures degraded

The held-out photos (every 8th, or the test split of the dataset) are copied unchanged, so that they
measure how much the changes of the other photos harm the scene. The light of a photo is multiplied
by 2^u, u uniform in ±EXPOSURE, and that of red and blue by another factor, uniform in
1 ± WHITE_BALANCE. Values above white are clipped. The points of a COLMAP dataset get their colours
from the changed photos, as structure from motion would find them.

With --rotation and --translation, the camera of a photo is rotated by an angle and moved by a
distance, both with a random direction. The distance is a share of the extent of the cameras.
"""

from __future__ import annotations

import argparse
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import torch
from PIL import Image
from torch import Tensor

from snowsplat import Dataset, load_dataset
from snowsplat.data.colmap.model import read_model, read_points, write_model
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.training.starts.point_colors import point_colors


def in_light(values: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """uint8 sRGB values (..., 3) whose light is multiplied by (3,) factors."""
    encoded = values / 255.0
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    light = np.minimum(light * factors, 1.0)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * encoded).astype(np.uint8)


def degrade(path: Path, factors: np.ndarray) -> None:
    """Change an image file in place; its transparency is kept."""
    with Image.open(path) as image:
        kind = image.format
        pixels = np.array(image.convert("RGBA" if "A" in image.mode else "RGB"))
    pixels[..., :3] = in_light(pixels[..., :3], factors)
    path.chmod(0o644)
    Image.fromarray(pixels).save(path, format=kind, quality=97, subsampling=0)


def recolor(dataset: Dataset, model: Path) -> None:
    """Set the colours of the points to the mean over the training photos that show them."""
    reconstruction = pycolmap.Reconstruction(model)
    ids = sorted(reconstruction.point3D_ids())
    xyz = torch.from_numpy(np.stack([reconstruction.point3D(i).xyz for i in ids])).float()
    total, count = torch.zeros(len(ids), 3), torch.zeros(len(ids), 1)
    with ImageLoader(dataset.train) as images:
        for view in dataset.train:
            colors, known = point_colors(view, images, xyz, torch.zeros(3))
            total += known[:, None] * colors
            count += known[:, None]
    colors = (255.0 * total / count.clamp_min(1.0)).round().numpy().astype(np.uint8)
    for i, color in zip(ids, colors, strict=True):
        reconstruction.point3D(i).color = color
    for file in model.iterdir():
        file.chmod(0o644)
    reconstruction.write(model)


def disturbed_pose(
    cam_from_world: Tensor, generator: torch.Generator, degrees: float, distance: float
) -> Tensor:
    """(3, 4): a pose (3, 4) float64 rotated and moved in random directions."""
    directions = torch.randn(2, 3, dtype=torch.float64, generator=generator)
    axis, way = torch.nn.functional.normalize(directions, dim=1)
    half = math.radians(degrees) / 2
    turn = rotation_from_quat(torch.cat([torch.tensor([math.cos(half)]), math.sin(half) * axis]))
    rotation, shift = cam_from_world[:, :3], cam_from_world[:, 3]
    centre = -rotation.T @ shift + distance * way
    turned = turn @ rotation
    return torch.cat([turned, -(turned @ centre)[:, None]], 1)


def move_cameras(dataset: Dataset, model: Path, degrees: float, share: float, seed: int) -> None:
    """Rotate and move the cameras of the training photos in a COLMAP model; tracks are dropped."""
    generator = torch.Generator().manual_seed(seed)
    trained = {view.name for view in dataset.train}
    colmap, points = read_model(model), read_points(model)
    images = []
    for image in colmap.images:
        quat, shift = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
        pose = torch.cat([rotation_from_quat(quat), shift[:, None]], 1)
        pose = disturbed_pose(pose, generator, degrees, share * dataset.extent)
        if image.name in trained:
            quat = quat_from_rotation(pose[:, :3])
            image = replace(image, pose=(*quat.tolist(), *pose[:, 3].tolist()))
        images.append(image)
    assert points is not None
    write_model(model, colmap.cameras, images, points.xyz.numpy(), points.rgb.numpy())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("output", type=Path, help="a new folder")
    parser.add_argument("--exposure", type=float, default=0.0, metavar="EV")
    parser.add_argument("--white-balance", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--rotation", type=float, default=0.0, metavar="DEGREES")
    parser.add_argument("--translation", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--seed", type=int, default=0)
    flags = parser.parse_args()
    shutil.copytree(flags.dataset, flags.output, copy_function=shutil.copyfile)
    for folder in (flags.output, *flags.output.rglob("*/")):
        folder.chmod(0o755)
    dataset = load_dataset(flags.output, hold_out=8)
    model = flags.output / "sparse" / "0"
    if flags.exposure or flags.white_balance:
        generator = np.random.default_rng(flags.seed)
        for view in dataset.train:
            factors = np.full(3, 2.0 ** generator.uniform(-flags.exposure, flags.exposure))
            balance = generator.uniform(1 - flags.white_balance, 1 + flags.white_balance, 2)
            factors[[0, 2]] *= balance
            degrade(view.image.path, factors)
            print(f"{view.name}: {np.log2(factors).round(2)} EV")
        if model.is_dir():
            recolor(load_dataset(flags.output, hold_out=8), model)
    if flags.rotation or flags.translation:
        move_cameras(dataset, model, flags.rotation, flags.translation, flags.seed)


if __name__ == "__main__":
    main()
