"""Renders photos with known poses along a path around the scene; JPEG files like a phone's.

The camera is that of a phone, with lens distortion: COLMAP's OPENCV with a single focal length.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import invert_rigid, look_at
from snowsplat.sfm.progress import Report, silent
from snowsplat.synthetic.scene import Scene
from snowsplat.synthetic.still_life import still_life
from snowsplat.util.files import atomic_path
from snowsplat.util.srgb import from_linear

RAYS = 2  # along each side of a pixel
_TILE = 64  # pixels along each side; the rays of a tile hit few shapes
_FOCAL_35MM = 28  # in EXIF, mm; typical of a phone
_FOCAL_TRUE = 1.013  # the true focal length divided by the one in EXIF, which is inexact
_DISTORTION = (-0.062, 0.021, 0.00015, -0.0001)  # of COLMAP's model OPENCV: k1, k2, p1, p2
_WALK_RADIUS = 1.42  # metres, around the centre of the table
_WALK_HEIGHTS = (0.46, 0.92)  # metres above the table, first and second round
_FULL_WELL = 15000.0  # electrons of a white pixel; the shot noise is their square root
_READ_NOISE = 6.0  # electrons
_JPEG_QUALITY = 92
_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Truth:
    """The true lens and poses of the photos."""

    lens: CentredLens
    poses: dict[str, Tensor]  # photo name -> cam_from_world (3, 4) float64, metres, z up

    def write(self, folder: Path) -> None:
        """Write a COLMAP text model without points."""
        lens = lens_of(self.lens.model, self.lens.width, self.lens.height, self.lens.params)
        write_posed(folder, [(name, lens, pose) for name, pose in self.poses.items()], text=True)


def write_synthetic_photos(
    folder: Path | str,
    n_views: int = 40,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
    report: Report = silent,
) -> Truth:
    """Render photos ``IMG_0001.jpg`` … of a still life into ``folder``, in two rounds around it.

    Equal arguments produce equal photos. Existing photos are kept. ``seed``: of scene and path.
    """
    lens = phone_lens(width, height)
    return take_photos(folder, lambda: still_life(seed), lens, walk(n_views, seed), seed, report)


def phone_lens(
    width: int, height: int, distortion: tuple[float, float, float, float] = _DISTORTION
) -> Lens:
    """A wide-angle lens like a phone's. Its focal length differs slightly from that in EXIF.

    ``distortion``: k1, k2, p1, p2 of COLMAP's model OPENCV.
    """
    focal = _FOCAL_TRUE * _FOCAL_35MM * math.hypot(width, height) / math.hypot(36, 24)
    return Lens(width, height, focal, distortion)


def take_photos(
    folder: Path | str,
    build: Callable[[], Scene],
    lens: CentredLens,
    poses: Sequence[Tensor],
    seed: int = 0,
    report: Report = silent,
    shoot: Callable[[Scene, int, np.random.Generator], np.ndarray] | None = None,
) -> Truth:
    """Render photos ``IMG_0001.jpg`` … of a scene into ``folder``; existing photos are kept.

    Args:
        build: makes the scene; called only if a photo is missing.
        poses: ``cam_from_world`` (3, 4) float64 of each photo, metres.
        seed: seed of the noise of the image sensor.
        report: progress callback.
        shoot: takes the photo of a scene with this index, with this noise; default: `photograph`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"IMG_{number:04d}.jpg" for number in range(1, len(poses) + 1)]
    truth = Truth(lens, dict(zip(names, poses, strict=True)))
    missing = [i for i, name in enumerate(names) if not (folder / name).exists()]
    if not missing:
        return truth
    report(0, len(missing), "building the scene")
    scene = build()

    def take(i: int) -> None:
        random = np.random.default_rng([seed, i])
        pixels = shoot(scene, i, random) if shoot else photograph(scene, lens, poses[i], random)
        with atomic_path(folder / names[i]) as temporary:
            _save(temporary, pixels, lens)

    # numpy releases the GIL, so threads run in parallel.
    with ThreadPoolExecutor(2) as pool:
        for done, _ in enumerate(pool.map(take, missing), 1):
            report(done, len(missing), "photos")
    return truth


def walk(count: int, seed: int) -> list[Tensor]:
    """``cam_from_world`` of a hand-held camera: a low round, then a higher one."""
    random = np.random.default_rng([seed, count])
    poses = []
    for i in range(count):
        second = 2 * i >= count
        # The angles of the second round are between those of the first.
        angle = 2 * math.pi * (2 * i + second) / count
        angle += random.normal(0, 0.02)
        radius = _WALK_RADIUS * (1 + random.normal(0, 0.03))
        height = _WALK_HEIGHTS[second] + random.normal(0, 0.025)
        position = np.array([radius * math.cos(angle), radius * math.sin(angle), height])
        target = np.array([0, 0, 0.08]) + random.normal(0, 0.05, 3)
        pose = look_at(
            torch.from_numpy(position),
            torch.from_numpy(target),
            torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),
        )
        poses.append(roll(pose, random.normal(0, 0.06)))
    return poses


def roll(cam_from_world: Tensor, angle: float) -> Tensor:
    """The camera rotated about its optical axis by ``angle`` in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    roll = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64)
    return roll @ cam_from_world


def photograph(
    scene: Scene, lens: CentredLens, cam_from_world: Tensor, random: np.random.Generator
) -> np.ndarray:
    """(H, W, 3) uint8 sRGB: the photo from a pose, see `develop`."""
    world_from_cam = invert_rigid(cam_from_world).numpy()
    rotation, origin = np.split(world_from_cam.astype(np.float32), [3], axis=1)
    spread = 1 / (lens.focal * RAYS)
    light = np.empty((lens.height, lens.width, 3), np.float32)
    for rows, columns, rays in tiles(lens):
        shape = (3, rows.stop - rows.start, RAYS, columns.stop - columns.start, RAYS)
        # A sensor saturates: values above white are clipped before a pixel is averaged.
        seen = scene.radiance(origin, rotation @ rays, spread).clip(0, 1)
        light[rows, columns] = seen.reshape(shape).mean(axis=(2, 4)).transpose(1, 2, 0)
    return develop(light, random)


def develop(light: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """(H, W, 3) linear light -> uint8 sRGB, with the noise of a small image sensor."""
    electrons = _FULL_WELL * light
    electrons += np.sqrt(electrons + _READ_NOISE**2) * random.standard_normal(
        light.shape, np.float32
    )
    srgb = from_linear((electrons / _FULL_WELL).clip(0, 1))
    return np.rint(255 * srgb).astype(np.uint8)


@functools.lru_cache(1)
def tiles(lens: CentredLens) -> list[tuple[slice, slice, np.ndarray]]:
    """Tiles of the image: rows, columns, and the directions (3, R) of their rays."""
    tiles = []
    for top in range(0, lens.height, _TILE):
        for left in range(0, lens.width, _TILE):
            bottom, right = min(top + _TILE, lens.height), min(left + _TILE, lens.width)
            x = left + (np.arange((right - left) * RAYS) + 0.5) / RAYS
            y = top + (np.arange((bottom - top) * RAYS) + 0.5) / RAYS
            rays = lens.directions(np.stack(np.meshgrid(x, y)).reshape(2, -1))
            tiles.append((slice(top, bottom), slice(left, right), rays.astype(np.float32)))
    return tiles


def _save(path: Path, pixels: np.ndarray, lens: CentredLens) -> None:
    """Save a JPEG. Frames of an action camera, which has a fisheye lens, have no focal length."""
    image = Image.fromarray(pixels)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "snowsplat", "ray tracer"  # Make, Model
    exif[0x0112] = 1  # Orientation: as stored
    if isinstance(lens, Lens):
        exif.get_ifd(0x8769)[0xA405] = _FOCAL_35MM  # FocalLengthIn35mmFilm
    xmp = {"xmp": lens.xmp} if lens.xmp else {}
    image.save(path, format="JPEG", quality=_JPEG_QUALITY, exif=exif, **xmp)


@dataclass(frozen=True)
class CentredLens:
    """One focal length, the principal point at the centre, and four coefficients of distortion."""

    width: int
    height: int
    focal: float  # pixels, per radian at the centre
    distortion: tuple[float, float, float, float]  # as in COLMAP's model of the same name
    model: ClassVar[str]  # the name of COLMAP's model
    xmp: ClassVar[bytes | None] = None  # metadata of the photos

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (3, P) in the camera's frame, of pixel positions (2, P)."""
        raise NotImplementedError

    @property
    def params(self) -> tuple[float, ...]:
        """Parameters of COLMAP's model: fx, fy, cx, cy, then the distortion."""
        return (self.focal, self.focal, self.width / 2, self.height / 2, *self.distortion)

    @property
    def _middle(self) -> np.ndarray:
        return np.array([[self.width / 2], [self.height / 2]])


@dataclass(frozen=True)
class Lens(CentredLens):
    """Pixel coordinates as in `snowsplat.scene.camera.Camera`; principal point at the centre.

    A point (x, y, 1) in the camera's frame is at focal · d(x, y) from the image centre, where
    d(x, y) = (x, y) (1 + k1 r² + k2 r⁴) + (2 p1 xy + p2 (r² + 2x²), p1 (r² + 2y²) + 2 p2 xy).
    """

    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2
    model: ClassVar[str] = "OPENCV"

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel positions (2, P) of points (3, P) in the camera's frame, in front of it."""
        return self.focal * self._distorted(points[:2] / points[2]) + self._middle

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (3, P) in the camera's frame, of pixel positions (2, P).

        The inverse of `project`, by Newton's method. It converges to rounding error for weak
        distortion, such as that of a phone.
        """
        goal = (pixels - self._middle) / self.focal
        k1, k2, p1, p2 = self.distortion
        xy = goal.copy()
        for _ in range(_NEWTON_STEPS):
            x, y = xy
            r2 = x * x + y * y
            radial, growth = 1 + k1 * r2 + k2 * r2 * r2, 2 * k1 + 4 * k2 * r2
            xx = radial + x * x * growth + 2 * p1 * y + 6 * p2 * x
            yy = radial + y * y * growth + 6 * p1 * y + 2 * p2 * x
            xy_ = x * y * growth + 2 * p1 * x + 2 * p2 * y  # d(x, y) has a symmetric Jacobian
            ex, ey = self._distorted(xy) - goal
            determinant = xx * yy - xy_ * xy_
            xy = xy - np.stack([yy * ex - xy_ * ey, xx * ey - xy_ * ex]) / determinant
        rays = np.concatenate([xy, np.ones_like(xy[:1])])
        return rays / np.sqrt((rays * rays).sum(axis=0))

    def _distorted(self, xy: np.ndarray) -> np.ndarray:
        k1, k2, p1, p2 = self.distortion
        x, y = xy
        r2 = x * x + y * y
        bend = np.stack(
            [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )
        return xy * (1 + k1 * r2 + k2 * r2 * r2) + bend
