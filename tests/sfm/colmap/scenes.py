"""Renders small photos of textured boards from known cameras. SfM takes only seconds with them."""

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.sfm.ingest.photo import Photo

WIDTH, HEIGHT, FOCAL = 256, 192, 224.0


@dataclass(frozen=True)
class Board:
    """A textured parallelogram: corner, two edges (3,), texture (T, T) grey 0–1."""

    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    texture: np.ndarray


@functools.cache
def texture(seed: int, size: int = 256) -> np.ndarray:
    """Blobs of many sizes, (size, size) 0–1: unique features everywhere. Read-only."""
    random = np.random.default_rng(seed)
    sum_ = np.zeros((size, size))
    for cells in (8, 16, 32, 64):
        noise = Image.fromarray(random.random((cells, cells)).astype(np.float32))
        sum_ += np.asarray(noise.resize((size, size), Image.Resampling.BICUBIC))
    low, high = np.percentile(sum_, [2, 98])
    return np.clip((sum_ - low) / (high - low), 0, 1)


def boards(seed: int = 0) -> list[Board]:
    """A back wall, a floor, and three boards in front of it. x right, y down, z forward."""

    def board(seed2, corner, right, down):
        vectors = [np.array(v, float) for v in (corner, right, down)]
        return Board(*vectors, texture(1000 * seed + seed2))

    return [
        board(1, (-4, -3, 7), (8, 0, 1), (0, 5, 0)),
        board(2, (-4, 1.5, 2), (8, 0, 0), (0, 0, 6)),
        board(3, (-2, -1, 4.5), (1.4, 0, 0.5), (0, 2.5, 0)),
        board(4, (0.6, -0.8, 3.8), (1.2, 0, -0.4), (0, 2.3, 0)),
        board(5, (-0.6, 0, 5.5), (1.3, 0, 0), (0, 1.5, 0.2)),
    ]


def wall(seed: int = 0) -> list[Board]:
    """One plane."""
    return [
        Board(np.array([-6.0, -4, 6]), np.array([12.0, 0, 0]), np.array([0, 8.0, 0]), texture(seed))
    ]


def look(position, target) -> np.ndarray:
    """(3, 4) cam_from_world of a camera at ``position`` that looks at ``target``; y axis down."""
    position, target = np.array(position, float), np.array(target, float)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation, -rotation @ position[:, None]], 1)


def arc(count: int) -> list[np.ndarray]:
    """Cameras along an arc in front of the boards."""
    angles = np.linspace(-0.5, 0.5, count)
    return [
        look((5 * np.sin(a), -0.2 + 0.3 * np.cos(5 * a), 5 - 5 * np.cos(a)), (0, 0, 5))
        for a in angles
    ]


def photograph(
    scene: list[Board], cam_from_world: np.ndarray, seed: int = 0, *, zoom: float = 1
) -> np.ndarray:
    """(HEIGHT, WIDTH) uint8: a pinhole camera with four rays per pixel and a little noise.

    ``zoom``: the same view with this many times as many pixels along each side.
    """
    width, height, focal = round(zoom * WIDTH), round(zoom * HEIGHT), zoom * FOCAL
    rotation, translation = cam_from_world[:, :3], cam_from_world[:, 3]
    centre = -rotation.T @ translation
    x = ((np.arange(2 * width) + 0.5) / 2 - width / 2) / focal
    y = ((np.arange(2 * height) + 0.5) / 2 - height / 2) / focal
    nearest, grey = np.full((len(y), len(x)), np.inf), np.full((len(y), len(x)), 0.5)
    for board in scene:
        # centre + t ray = corner + u right + v down, so u/t, v/t and 1/t are linear in x and y.
        edges = np.stack([board.right, board.down, board.corner - centre], 1)
        u, v, inverse = (
            row[0] * x + (row[1] * y + row[2])[:, None]
            for row in np.linalg.solve(edges, rotation.T)
        )
        with np.errstate(divide="ignore"):
            t = 1 / inverse
        ahead = (inverse > 0) & (t < nearest)
        hit = ahead & (u >= 0) & (u < inverse) & (v >= 0) & (v < inverse)
        t = nearest[hit] = t[hit]
        size = len(board.texture)
        grey[hit] = _sample(board.texture, v[hit] * t * (size - 1), u[hit] * t * (size - 1))
    grey = grey.reshape(height, 2, width, 2).mean((1, 3))
    noise = np.random.default_rng(seed).normal(0, 1.5, grey.shape)
    return np.clip(20 + 215 * grey + noise, 0, 255).astype(np.uint8)


def _sample(texture: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    i, j = row.astype(int), column.astype(int)
    i2, j2 = np.minimum(i + 1, len(texture) - 1), np.minimum(j + 1, len(texture) - 1)
    a, b = row - i, column - j
    upper = texture[i, j] * (1 - b) + texture[i, j2] * b
    return upper * (1 - a) + (texture[i2, j] * (1 - b) + texture[i2, j2] * b) * a


def write_photos(folder: Path, count: int) -> Path:
    """``count`` photos of the boards, 000.jpg …, in colour, with EXIF data; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = boards()
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "snowsplat", "boards"  # Make, Model
    exif.get_ifd(0x8769)[0xA405] = round(FOCAL * math.hypot(36, 24) / math.hypot(WIDTH, HEIGHT))
    for i, pose in enumerate(arc(count)):
        grey = photograph(scene, pose, i)
        colour = np.stack([grey, 0.9 * grey, 255 - 0.7 * grey], -1).astype(np.uint8)
        Image.fromarray(colour).save(folder / f"{i:03}.jpg", quality=95, exif=exif)
    return folder


def write(dataset: Path, images: list[np.ndarray], **of_all) -> list[Photo]:
    """Write images to ``input/`` of a dataset as 000.png …; returns their `Photo` records."""
    names = [f"{i:03}.png" for i in range(len(images))]
    return [save(dataset, name, image, **of_all) for name, image in zip(names, images, strict=True)]


def save(dataset: Path, name: str, image: np.ndarray, **of_it) -> Photo:
    path = dataset / "input" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)
    height, width = image.shape[:2]
    return Photo(
        name=name, source=name, width=width, height=height, **({"group": "camera"} | of_it)
    )
