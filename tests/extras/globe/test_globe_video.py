"""The frames of a video of a globe: backdrop, flakes, and their sequence."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from snowsplat.extras.globe import glass
from snowsplat.extras.globe import globe_video as module
from snowsplat.extras.globe.dimensions import FLOOR
from snowsplat.extras.globe.glass import engraving
from snowsplat.extras.globe.globe_video import GlobeVideo, appearance, orbit_camera
from snowsplat.extras.globe.layout import Arrangement
from snowsplat.extras.globe.physics import FLAKE, Snow
from snowsplat.scene.gaussians import SH_C0, Gaussians


def gaussians(count: int = 600) -> Gaussians:
    """A dark red block in the middle of the floor."""
    random = np.random.default_rng(1)
    means = random.uniform((-0.3, -0.2, -0.3), (0.3, FLOOR, 0.3), (count, 3))
    color = (torch.tensor([0.3, 0.05, 0.05]) - 0.5) / SH_C0
    return Gaussians(
        torch.tensor(means).float(),
        torch.tensor(random.uniform(-4.0, -3.0, (count, 3))).float(),
        torch.tensor(random.normal(size=(count, 4))).float(),
        torch.full((count,), 2.0),
        color.repeat(count, 1, 1),
        torch.zeros(count, 3, 3),
    )


def test_standing_gaussians_are_unchanged_and_flakes_are_small_and_bright():
    scene = gaussians()
    snow = Snow(scene.means.T.numpy())
    standing = appearance(scene, snow)
    for name, values in scene.parameters().items():
        if name != "quats":  # these are normalised
            assert torch.equal(standing.parameters()[name], values), name
    assert torch.allclose(standing.quats, scene.rotations, atol=1e-6)
    snow.morph[:300], snow.angle[:300] = 1.0, 1.0
    flakes = appearance(scene, snow).select(torch.arange(300))
    assert flakes.scales.max() < FLAKE[1] + 1e-6
    assert flakes.opacities.min() > 0.89
    assert flakes.base_colors.min() > 0.55  # from 0.05
    assert (flakes.base_colors[:, 0] > flakes.base_colors[:, 1]).all()  # still reddish
    # Turned by 1 radian: |<q, q'>| = cos(1/2).
    cosine = (flakes.rotations * scene.rotations[:300]).sum(1).abs()
    assert torch.allclose(cosine, torch.full((300,), math.cos(0.5)), atol=1e-5)


def test_the_backdrop_has_glass_floor_and_base():
    backdrop = glass.draw(orbit_camera(0.0, 160, 160), engraving("A name"))
    plain = glass.draw(orbit_camera(0.0, 160, 160))
    keep = backdrop.keep[:, :, 0]
    assert keep[3, 3] == 1  # the background
    assert 0.85 < keep[60, 80] < 1  # through the glass
    assert keep[135, 80] == 0  # the base is in front
    # The floor is white; the air above it is blue; the wood is dark.
    floor, air = backdrop.behind[112, 80], backdrop.behind[40, 80]
    assert floor.min() > 0.85
    assert air[2] > air[0] + 0.1
    empty = np.zeros((160, 160, 3), np.float32), np.zeros((160, 160), np.float32)
    picture, without = (b.around(*empty).astype(int) for b in (backdrop, plain))
    assert picture[138, 40].max() < 150
    # Only the plate differs: it is brighter than the wood.
    rows, columns = np.nonzero(np.abs(picture - without).max(2) > 8)
    assert rows.min() > 120
    assert rows.max() < 145
    assert columns.min() > 45
    assert columns.max() < 115
    assert picture[rows, columns].mean() > without[rows, columns].mean() + 20


def test_opaque_gaussians_hide_what_is_behind_them():
    backdrop = glass.draw(orbit_camera(0.0, 60, 60), samples=1)
    red = np.tile(np.float32([0.8, 0.1, 0.1]), (60, 60, 1))
    picture = backdrop.around(red, np.ones((60, 60), np.float32))
    assert np.abs(picture[2, 2] - np.array([204, 25.5, 25.5])).max() < 1  # outside of the glass
    transparent = backdrop.around(0 * red, np.zeros((60, 60), np.float32))
    wood = backdrop.keep[:, :, 0] == 0
    assert wood.mean() > 0.05
    assert (picture[wood] == transparent[wood]).all()


def test_an_engraving_shows_the_whole_name():
    short, long = engraving("A"), engraving(60 * "W")
    assert short.shape == long.shape
    assert 0.001 < short.mean() < 0.1
    for image in (short, long):
        assert image.max() == 1
        assert image[:, :20].max() == image[:, -20:].max() == 0  # not cut off


def test_the_same_video_has_the_same_frames(monkeypatch):
    monkeypatch.setattr(module, "SHAKE_AT", 0.3)
    monkeypatch.setattr(module, "REMEMBER_AT", 2.0)
    monkeypatch.setattr(module, "SECONDS", 6.0)
    video = GlobeVideo(Arrangement(gaussians(), False), None, 64, 48, 3.0)
    first, second = np.stack(list(video.frames())), np.stack(list(video.frames()))
    assert first.shape == (18, 48, 64, 3)
    assert (first == second).all()
    change = np.abs(first.astype(int) - first[0]).mean((1, 2, 3))
    assert change[5] > 2  # 1.7 s: snow
    assert change[-1] < 0.35 * change[5]  # it stands again, turned by 10°
    # A scene that was photographed from all sides makes a whole turn.
    around = replace(video, arrangement=Arrangement(gaussians(), True))
    assert around._azimuth(3.0) == pytest.approx(math.pi)
    assert abs(video._azimuth(1.5)) == pytest.approx(math.radians(30))
