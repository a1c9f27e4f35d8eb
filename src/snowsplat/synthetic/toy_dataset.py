"""A small procedural dataset with exact poses: for notebooks, first experiments, and tests.

The scene is analytic: coloured balls at the centre and, in the COLMAP formats, a large sphere
around everything. Rays are intersected in closed form, so poses, images and points are exact.
Colours vary slowly over the surfaces, so that a few hundred Gaussians can represent them.
"""

import json
import math
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import pinhole_of
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at

_SUPERSAMPLING = 4  # rays along each side of a pixel
_SURROUNDINGS = 6.0  # radius of the sphere around the scene
_RING = 3.0  # distance of the cameras from the middle

Format = Literal["colmap-bin", "colmap-txt", "blender"]


class _Scene:
    """Balls (centre, radius). The colour of a ball is a sum of a few waves of low frequency."""

    def __init__(self, seed: int, surroundings: bool) -> None:
        random = np.random.default_rng(seed)
        angles = 2 * np.pi * (np.arange(4) / 4 + random.random())
        ring = np.stack([0.75 * np.cos(angles), 0.75 * np.sin(angles), 0 * angles], axis=1)
        centres = np.concatenate([np.zeros((1, 3)), ring + random.normal(0, 0.1, ring.shape)])
        radii = np.concatenate([[0.6], random.uniform(0.2, 0.35, len(ring))])
        if surroundings:
            centres = np.concatenate([centres, np.zeros((1, 3))])
            radii = np.append(radii, _SURROUNDINGS)
        self.centres, self.radii = centres, radii
        count = len(self.radii)
        self._base = random.uniform(0.3, 0.7, (count, 3))
        # Three waves per ball, over its unit normal: 2 to 3 radians from pole to centre.
        self._directions = random.normal(size=(count, 3, 3))
        self._directions *= 2.5 / np.linalg.norm(self._directions, axis=1, keepdims=True)
        self._phases = random.uniform(0, 2 * np.pi, (count, 3, 3))

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (R,) of unit rays to the first hit (infinite: none), and its colour (R, 3)."""
        nearest = np.full(len(directions), np.inf)
        ball = np.zeros(len(directions), np.int64)
        for i, (centre, radius) in enumerate(zip(self.centres, self.radii, strict=True)):
            # |o + s d − c|² = r²: the nearer root, or the farther one if the origin is inside.
            b = directions @ (centre - origin)
            c = ((centre - origin) ** 2).sum() - radius**2
            with np.errstate(invalid="ignore"):
                root = np.sqrt(b * b - c)
            distance = b - root if c > 0 else b + root
            hit = (distance > 0) & (distance < nearest)  # False where the root is NaN
            nearest[hit], ball[hit] = distance[hit], i
        positions = origin + np.where(np.isfinite(nearest), nearest, 0.0)[:, None] * directions
        return nearest, self._colour(ball, positions)

    def _colour(self, ball: np.ndarray, positions: np.ndarray) -> np.ndarray:
        normals = (positions - self.centres[ball]) / self.radii[ball, None]
        waves = np.einsum("rk,rkwc->rwc", normals, self._directions[ball][:, :, :, None])
        return self._base[ball] + 0.1 * np.sin(waves + self._phases[ball]).sum(axis=1)


def _cameras(n: int, width: int, height: int) -> list[Camera]:
    """Cameras around the centre at three elevations, golden angles apart, world z up."""
    cameras = []
    focal = 0.9 * width
    for i in range(n):
        azimuth = i * math.pi * (3 - math.sqrt(5))
        elevation = math.radians((10, 30, 50)[i % 3])
        level = math.cos(elevation)
        place = [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)]
        position = torch.tensor(place, dtype=torch.float64)
        middle, up = torch.zeros_like(position), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        pose = look_at(_RING * position, middle, up)
        cameras.append(Camera(width, height, focal, focal, width / 2, height / 2, pose))
    return cameras


def _rays(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (R, 3), world frame, through positions (R, 2) in pixels."""
    pose = camera.world_from_cam.numpy()
    x = (pixels[:, 0] - camera.cx) / camera.fx
    y = (pixels[:, 1] - camera.cy) / camera.fy
    directions = np.stack([x, y, np.ones_like(x)], axis=1) @ pose[:, :3].T
    return pose[:, 3], directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _render(scene: _Scene, camera: Camera) -> np.ndarray:
    """(H, W, 4) uint8 RGBA, straight alpha."""
    n = _SUPERSAMPLING
    x = (np.arange(camera.width * n) + 0.5) / n
    y = (np.arange(camera.height * n) + 0.5) / n
    distance, colours = scene.hit(*_rays(camera, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)))
    covered = np.isfinite(distance).astype(np.float64)[:, None]
    rgba = np.concatenate([colours * covered, covered], axis=1)
    rgba = rgba.reshape(camera.height, n, camera.width, n, 4).mean(axis=(1, 3))
    rgba[..., :3] /= np.maximum(rgba[..., 3:], 1e-9)
    return np.rint(255 * rgba.clip(0, 1)).astype(np.uint8)


def _sample_points(
    scene: _Scene, cameras: list[Camera], count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, list[list[tuple[int, int]]]]:
    """Points on visible surfaces: xyz (P, 3), rgb (P, 3) uint8, and their tracks."""
    xyz, rgb, tracks = [], [], []
    for number, camera in enumerate(cameras, 1):
        share = count // len(cameras) + (number <= count % len(cameras))
        pixels = random.uniform(0, (camera.width, camera.height), (share, 2))
        origin, directions = _rays(camera, pixels)
        distance, colours = scene.hit(origin, directions)
        seen = np.isfinite(distance)
        xyz.append(origin + distance[seen, None] * directions[seen])
        rgb.append(np.rint(255 * colours[seen]).astype(np.uint8))
        # Random lengths, so that readers are tested with records of different lengths.
        lengths = random.integers(1, 6, seen.sum())
        tracks += [[(number, i) for i in range(length)] for length in lengths]
    return np.concatenate(xyz), np.concatenate(rgb), tracks


def write_toy_dataset(
    folder: Path | str,
    format: Format = "colmap-bin",
    n_views: int = 12,
    width: int = 64,
    height: int = 48,
    seed: int = 0,
    n_points: int = 1500,
) -> Path:
    """Write a dataset of a procedural scene into ``folder``; equal arguments write equal files.

    "colmap-bin" and "colmap-txt": ``sparse/0`` with ``n_points`` points, and ``images``. "blender":
    ``transforms_train.json`` and ``transforms_test.json`` (every 8th view), RGBA images with a
    transparent background, no points.

    Returns the folder.
    """
    folder = Path(folder)
    scene = _Scene(seed, surroundings=format != "blender")
    cameras = _cameras(n_views, width, height)
    if format == "blender":
        _write_blender(folder, scene, cameras)
    else:
        points = _sample_points(scene, cameras, n_points, np.random.default_rng(seed))
        (folder / "images").mkdir(parents=True, exist_ok=True)
        posed = []
        for i, camera in enumerate(cameras):
            name = f"view_{i:02d}.png"
            Image.fromarray(_render(scene, camera)[..., :3]).save(folder / "images" / name)
            posed.append((name, pinhole_of(camera), camera.cam_from_world))
        write_posed(folder / "sparse" / "0", posed, *points, text=format == "colmap-txt")
    return folder


def _write_blender(folder: Path, scene: _Scene, cameras: list[Camera]) -> None:
    angle = 2 * math.atan(0.5 * cameras[0].width / cameras[0].fx)
    for split in ("train", "test"):
        folder.joinpath(split).mkdir(parents=True, exist_ok=True)
        frames = []
        for i, camera in enumerate(cameras):
            if (i % 8 == 0) != (split == "test"):
                continue
            Image.fromarray(_render(scene, camera)).save(folder / split / f"r_{i}.png")
            matrix = torch.eye(4, dtype=torch.float64)
            matrix[:3] = camera.world_from_cam
            matrix[:3, 1:3] *= -1  # from OpenCV's camera axes to OpenGL's
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()})
        content = json.dumps({"camera_angle_x": angle, "frames": frames}, indent=1)
        folder.joinpath(f"transforms_{split}.json").write_text(content, encoding="utf-8")
