"""Whether other photos confirm a photo, at the depth of the scene."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data import ImageLoader, load_dataset
from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import pinhole_of
from snowsplat.evaluation.metrics import Rendering
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import RenderOutput
from snowsplat.training.parts.photo_agreement import confirmation

DEPTH = 2.0
FOCAL = 80.0


def photo_of_plane(x: float) -> Image.Image:
    """The photo, 96×64, of a plane with texture at z = 2, from the position (x, 0, 0)."""
    random = np.random.default_rng(1)
    columns, rows = np.meshgrid(np.arange(96) + 0.5 - 48, np.arange(64) + 0.5 - 32)
    across, down = x + columns * DEPTH / FOCAL, rows * DEPTH / FOCAL
    values = 128 + np.zeros((64, 96))
    for _ in range(40):
        a, b = random.normal(0, 12, 2)
        values += 8 * np.sin(a * across + b * down + random.uniform(0, 6))
    grey = np.rint(values.clip(0, 255)).astype(np.uint8)
    return Image.fromarray(np.repeat(grey[..., None], 3, axis=2))


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Ten photos of the plane; the cameras are side by side, the last six far apart."""
    folder = tmp_path_factory.mktemp("plane")
    (folder / "images").mkdir()
    posed = []
    for i, x in enumerate([0.0, 0.15, 0.3, 0.45, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0]):
        photo_of_plane(x).save(folder / "images" / f"{i}.png")
        pose = torch.eye(4, dtype=torch.float64)[:3].clone()
        pose[0, 3] = -x
        camera = Camera(96, 64, FOCAL, FOCAL, 48.0, 32.0, pose)
        posed.append((f"{i}.png", pinhole_of(camera), pose))
    nothing = np.zeros((0, 3))
    write_posed(folder / "sparse" / "0", posed, nothing, nothing.astype(np.uint8), [])
    return load_dataset(folder, hold_out=None).train


def seen(views, index: int, *, depth: float = DEPTH, other: int | None = None, mask=None) -> float:
    """How the photos of two views confirm another view.

    ``depth``: of the rendering. ``other``: the view whose photo it has.
    """
    with ImageLoader(views) as images:
        background = torch.zeros(3)
        photo = images.get(views[index if other is None else other], 1).over(background)
        alpha = torch.full((64, 96), 0.5)
        output = RenderOutput(photo, alpha, alpha * depth, None)
        rendering = Rendering(views[index], photo, photo, mask, output)
        around = [views[i] for i in (1, 2, 3) if i != index]
        return confirmation(rendering, around, views[4:], images, background)


def test_photos_of_a_plane_agree_at_its_depth(views):
    assert seen(views, 2) > 5


def test_photos_disagree_at_another_depth(views):
    assert abs(seen(views, 2, depth=0.3 * DEPTH)) < 3


def test_the_photo_of_another_place_disagrees(views):
    assert abs(seen(views, 2, other=9)) < 3


def test_only_what_other_photos_show_counts(views):
    mask = torch.ones(64, 96, dtype=torch.bool)
    mask[32:] = False
    assert seen(views, 2, mask=mask) > 5
    mask[:] = False
    assert math.isnan(seen(views, 2, mask=mask))
    assert math.isnan(seen(views, 2, depth=math.nan))  # no Gaussians
    assert math.isnan(seen(views, 2, depth=-DEPTH))  # behind the cameras
    assert math.isnan(seen(views[:7], 2))  # too few photos of other places
