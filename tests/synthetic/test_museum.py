"""Thin lens, motion blur and glass of the ray tracer, and the dataset of the museum."""

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat import load_dataset
from snowsplat.synthetic.lens import Lens
from snowsplat.synthetic.light import Lamp
from snowsplat.synthetic.scene import Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid

from ..scenes.coarse import coarse_light
from ..scenes.glass import GlassScene
from ..scenes.museum import Museum, write_museum_dataset
from ..scenes.shutter import Shutter, photograph

LENS = Lens(120, 90, 150.0, (0.0, 0.0, 0.0, 0.0))
AHEAD = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], dtype=torch.float64)
LAMP = Lamp((0, 0, 9.0), (1.0, 1.0), 1.0, 0.6)


def ball(x: float, z: float, radius: float) -> SceneObject:
    return SceneObject(
        Ellipsoid((x, 0, z), (radius,) * 3), [np.full((8, 16, 3), 0.8, np.float32)], emissive=True
    )


def photo(
    objects: list[SceneObject],
    passing: Scene | None = None,
    panes: tuple[SceneObject, ...] = (),
    **shutter: float,
) -> np.ndarray:
    """(H, W) linear light, without visible noise."""
    scene = GlassScene(objects or [ball(0.0, -9.0, 0.1)], panes, LAMP)
    used = Shutter(samples=64, **shutter) if shutter else None
    pixels = photograph(scene, LENS, AHEAD, np.random.default_rng(0), passing, used) / 255.0
    return (pixels.mean(axis=2) ** 2.2) / 0.8**2.2


def spread(light: np.ndarray) -> float:
    """The variance of the position of light along the rows, pixels²."""
    columns = np.where(light > 0.005, light, 0).sum(axis=0)
    x = np.arange(len(columns))
    middle = (columns * x).sum() / columns.sum()
    return float((columns * (x - middle) ** 2).sum() / columns.sum())


def test_a_ball_is_sharp_at_the_focus_and_blurred_by_a_disc_elsewhere():
    near, far = ball(-1.0, 4.0, 0.08), ball(2.0, 8.0, 0.16)
    sharp = photo([near, far])
    blurred = photo([near, far], aperture=0.8, focus=4.0)
    left, right = np.s_[:, :60], np.s_[:, 60:]
    assert spread(blurred[left]) == pytest.approx(spread(sharp[left]), abs=0.3)
    disc = 0.8 * 150 * (1 / 4 - 1 / 8)  # 15 pixels; the variance of a disc is a 16th of its square
    wider = spread(blurred[right]) - spread(sharp[right])
    assert wider == pytest.approx(disc**2 / 16, rel=0.15)
    assert blurred[right].sum() == pytest.approx(sharp[right].sum(), rel=0.1)  # no light is lost


def test_what_moves_is_drawn_out_by_its_motion():
    passing = Scene([ball(0.0, 4.0, 0.05)], LAMP)
    still = photo([], passing, aperture=0.0, focus=4.0)
    moves = photo([], passing, aperture=0.0, focus=4.0, motion=(0.8, 0.0, 0.0))
    columns, rows = (moves > 0.01).any(axis=0).sum(), (moves > 0.01).any(axis=1).sum()
    assert columns == pytest.approx((still > 0.01).any(axis=0).sum() + 0.8 * 150 / 4, abs=2)
    assert rows == pytest.approx((still > 0.01).any(axis=1).sum(), abs=1)


def test_glass_shows_what_is_behind_it_and_reflects_what_is_before_it():
    behind, before = ball(0.0, 6.0, 0.4), ball(0.6, -6.0, 0.4)
    pane = SceneObject(
        Box((0, 0, 3.0), (4.0, 4.0, 0.1)), [np.zeros((8, 8, 3), np.float32)], gloss=0.2
    )
    open_, closed = photo([behind, before]), photo([behind, before], panes=(pane,))
    assert closed[45, 60] == pytest.approx(0.8 * open_[45, 60], abs=0.03)
    # The mirror image is at z = 2 · 2.95 + 6 and x = 0.6.
    column = 60 + round(150 * 0.6 / 11.9)
    outside = photo([before], panes=(pane,))
    assert outside[45, column] == pytest.approx(0.2, abs=0.03)
    assert photo([before]).max() < 0.01


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        coarse_light(patch, 0.5)
        folder = tmp_path_factory.mktemp("museum")
        return write_museum_dataset(folder, Museum(gloss=False), 4, 80, 60, points_per_view=60)


def test_the_points_of_the_museum_are_sharp_on_the_head_and_few_behind_it(folder):
    dataset = load_dataset(folder, hold_out=None)
    assert len(dataset.train) == 4
    for view in dataset.train:
        with Image.open(view.image.path) as picture:
            assert np.asarray(picture, np.float32).std() > 20
    distance = dataset.points.xyz[:, [0, 2]].norm(dim=1)  # from the axis of the head
    on_the_head = distance < 0.4
    assert len(distance) > 150
    assert float(on_the_head.float().mean()) > 0.5
    assert float((~on_the_head).float().mean()) > 0.01
