"""A stone head in a museum: the photos have a large aperture, and visitors are behind the head.

What `snowsplat train` may take for granted is not so here: the background is blurred, other people
are in each photo, the floor and a glass case reflect. Each of these can be switched off.

Metres; z is up, and the floor is z = 0. The head is above the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import compose_rigid, invert_rigid, look_at
from snowsplat.sfm.progress import Report, silent
from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.lens import Lens
from snowsplat.synthetic.light import Lamp
from snowsplat.synthetic.photographer import roll, take_photos
from snowsplat.synthetic.scene import Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid, Frustum, Ring

from .depth import depth_map
from .glass import GlassScene
from .passer_by import figure
from .shutter import Shutter, shooting
from .street_dataset import DATASET_FROM_SCENE

_HALL, _HEIGHT = (11.0, 9.0), 4.0
_LAMP = Lamp(middle=(0.8, -0.6, 3.9), size=(3.0, 2.5), power=9.0, ambient=0.55)
_EYES = 1.45  # height of the middle of the head
_AWAY = 1.45  # of the camera from the head
_ARC = math.radians(230)
_FOCAL = 1.5  # times the width of a photo
_APERTURE = 0.04
_VISITORS, _BEHIND = 3, (2.0, 4.2)  # number of them in a photo, and how far behind the head
_STRIDE = 0.12  # metres of a visitor in an exposure
_STONE, _VEIN = (0.74, 0.70, 0.62), (0.42, 0.36, 0.32)
#: A pixel is a feature if its photo changes there by this much, in 0..255 per pixel.
_CONTRAST = 10.0
#: Error of the position of a feature in pixels, and its share of the diameter of the blur.
_SHARP_ERROR, _BLUR_SHARE = 0.3, 0.15
_BASELINE = 0.35  # metres between two photos from which a point is triangulated


@dataclass(frozen=True)
class Museum:
    """What is difficult in the photos."""

    defocus: bool = True
    people: bool = True
    gloss: bool = True  # of the floor, and a glass case


def write_museum_dataset(
    folder: Path | str,
    kind: Museum,
    n_views: int = 53,
    width: int = 400,
    height: int = 300,
    seed: int = 0,
    points_per_view: int = 150,
    report: Report = silent,
) -> Path:
    """Photograph the head on an arc, and write a dataset with a COLMAP model with the true poses.

    Its points are where structure from motion finds features: many on the head, few and inexact
    ones in the blurred background, and none on people. Equal arguments produce equal files;
    existing photos are kept.

    Returns:
        the folder.
    """
    folder = Path(folder)
    lens = Lens(width, height, _FOCAL * width, (0.0, 0.0, 0.0, 0.0))
    poses = arc(n_views, seed)
    scene = hall(kind.gloss, seed)
    passing = {i: visitors(pose, i, seed) for i, pose in enumerate(poses) if kind.people}
    shutter = Shutter(_APERTURE if kind.defocus else 0.0, _AWAY, (_STRIDE, 0.0, 0.0))
    used = shutter if kind.defocus or kind.people else None
    shoot = shooting(lens, poses, passing, used)
    truth = take_photos(folder / "images", lambda: scene, lens, poses, seed, report, shoot)
    random = np.random.default_rng(seed)
    found, posed = [], []
    pinhole = lens_of("PINHOLE", width, height, lens.params[:4])
    for i, (name, pose) in enumerate(truth.poses.items()):
        with Image.open(folder / "images" / name) as photo:
            pixels = np.asarray(photo)
        depth = depth_map(scene, lens, pose)
        if kind.people:
            depth[depth_map(passing[i], lens, pose) < depth] = np.inf
        blur = shutter.aperture * lens.focal * np.abs(1 / shutter.focus - 1 / depth)
        found.append(_features(pixels, depth, blur, lens, pose, points_per_view, random))
        moved = compose_rigid(pose, invert_rigid(DATASET_FROM_SCENE))
        posed.append((name, pinhole, moved))
    xyz, rgb = (np.concatenate(part) for part in zip(*found, strict=True))
    turned = xyz @ DATASET_FROM_SCENE[:, :3].numpy().T
    write_posed(folder / "sparse" / "0", posed, turned, rgb)
    return folder


def hall(gloss: bool, seed: int = 0) -> Scene:
    """The hall with the head; ``gloss``: the floor reflects, and there is a glass case."""
    random = np.random.default_rng(seed)
    x, y = _HALL
    walls = []
    for side in (y, y, x, x):
        wall = paint.plain((int(100 * side), 400), random.uniform(0.35, 0.8, 3).tolist(), random)
        for u in (0.14, 0.38, 0.62, 0.86):
            sheet = paint.poster((240, 200), random)
            wall = paint.paste(wall, sheet, (u + random.normal(0, 0.02), 0.55), 1.3 / side, 0)
        walls.append(wall)
    floor = paint.marble((1100, 912), (0.50, 0.44, 0.38), (0.30, 0.26, 0.24), random)
    ceiling = np.full((16, 16, 3), 0.86, np.float32)
    room = Box((0, 0, _HEIGHT / 2), (x, y, _HEIGHT), inside=True)
    ground = Box((0, 0, 0.005), (x - 0.01, y - 0.01, 0.01))
    objects = [
        SceneObject(room, [*walls, floor, ceiling]),
        SceneObject(ground, [floor], gloss=0.06 if gloss else 0.0),
        *_head(random),
    ]
    for angle in random.uniform(0, 0.5) + np.arange(6) * math.pi / 3:  # other exhibits
        at, tall = (3.4 * math.cos(angle), 3.0 * math.sin(angle)), random.uniform(0.8, 1.2)
        side = paint.wood((128, 256), 3, random.uniform(0.2, 0.7, 3).tolist(), random)
        urn = paint.marble((256, 128), random.uniform(0.2, 0.8, 3).tolist(), _VEIN, random)
        objects += [
            SceneObject(Box((*at, tall / 2), (0.5, 0.5, tall), angle), [side]),
            SceneObject(Ellipsoid((*at, tall + 0.25), (0.2, 0.2, 0.26)), [urn]),
        ]
    if gloss:
        case = Box((0, 0, _EYES + 0.02), (0.62, 0.62, 0.86), 0.4)
        clear = np.zeros((16, 16, 3), np.float32)
        return GlassScene(objects, [SceneObject(case, [clear], gloss=0.08)], _LAMP)
    return Scene(objects, _LAMP)


def _head(random: np.random.Generator) -> list[SceneObject]:
    """A head with a nose, ears, eyes and a wreath, on a neck and a pedestal."""

    def stone(width: int, height: int) -> list[np.ndarray]:
        own = paint.marble((width, height), _STONE, _VEIN, random)
        own *= (1 + 0.5 * paint.noise((width, height), (width / 8, height / 8), 2, random))[
            ..., None
        ]
        return [own.clip(0, 1)]

    parts = [
        SceneObject(
            Box((0, 0, 0.5), (0.5, 0.5, 1.0), 0.3),
            [paint.wood((256, 512), 4, (0.3, 0.25, 0.2), random)],
        ),
        SceneObject(Frustum((0, 0, 1.0), 0.28, 0.18, 0.07), stone(512, 160)),
        SceneObject(Ellipsoid((0, 0, _EYES), (0.15, 0.12, 0.20)), stone(768, 384)),
        SceneObject(Ellipsoid((0.15, 0, _EYES - 0.03), (0.035, 0.022, 0.05)), stone(128, 64)),
        SceneObject(Ring((0, 0, _EYES + 0.09), 0.125, 0.025), stone(512, 96)),
    ]
    for side in (-1, 1):
        parts += [
            SceneObject(Ellipsoid((0, 0.12 * side, _EYES), (0.03, 0.02, 0.05)), stone(128, 64)),
            SceneObject(Ellipsoid((0.135, 0.045 * side, _EYES + 0.03), (0.02,) * 3), stone(64, 32)),
        ]
    return parts


def arc(count: int, seed: int) -> list[Tensor]:
    """``cam_from_world`` of a hand-held camera: half the way around the head, in two rows."""
    random = np.random.default_rng([seed, count])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    poses = []
    for i in range(count):
        angle = _ARC * ((i + 0.5) / count - 0.5) + random.normal(0, 0.02)
        away = _AWAY * (1 + random.normal(0, 0.03))
        position = np.array([away * math.cos(angle), away * math.sin(angle), 0.0])
        position[2] = _EYES + (0.30 if i % 2 else -0.05) + random.normal(0, 0.03)
        target = np.array([0, 0, _EYES - 0.05]) + random.normal(0, 0.03, 3)
        pose = look_at(torch.from_numpy(position), torch.from_numpy(target), up)
        poses.append(roll(pose, random.normal(0, 0.04)))
    return poses


def visitors(cam_from_world: Tensor, number: int, seed: int) -> Scene:
    """The people behind the head in one photo; they stand at other places in each."""
    random = np.random.default_rng([seed, number])
    x, y, _ = invert_rigid(cam_from_world)[:, 3].tolist()
    people: list[SceneObject] = []
    for _ in range(_VISITORS):
        angle, away = math.atan2(-y, -x) + random.uniform(-0.5, 0.5), random.uniform(*_BEHIND)
        feet = (away * math.cos(angle), away * math.sin(angle), 0.0)
        colours = random.uniform(0.05, 0.8, (2, 3)).tolist()
        people += figure(feet, random, (colours[0], colours[1]))
    return Scene(people, _LAMP)


def _features(
    photo: np.ndarray,
    depth: np.ndarray,
    blur: np.ndarray,
    lens: Lens,
    cam_from_world: Tensor,
    count: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """At most ``count`` points (P, 3) at pixels with contrast, and their colours (P, 3).

    The error of the depth z is z² / (focal · baseline) times that of the position in the photo.
    """
    light = photo.astype(np.float32).mean(axis=2)
    down, right = np.gradient(light)
    rows, columns = np.nonzero((np.hypot(down, right) > _CONTRAST) & np.isfinite(depth))
    chosen = random.permutation(len(rows))[:count]
    rows, columns = rows[chosen], columns[chosen]
    z, error = depth[rows, columns], _SHARP_ERROR + _BLUR_SHARE * blur[rows, columns]
    inverse = 1 / z + error / (lens.focal * _BASELINE) * random.standard_normal(len(z))
    seen = inverse > 0.2 / z
    rays = lens.directions(np.stack([columns + 0.5, rows + 0.5]))
    cam = rays / rays[2] / np.where(seen, inverse, 1.0)
    world_from_cam = invert_rigid(cam_from_world).numpy()
    xyz = (world_from_cam[:, :3] @ cam + world_from_cam[:, 3:]).T
    return xyz[seen], photo[rows, columns][seen]
