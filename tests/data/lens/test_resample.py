"""Undistortion compared with an analytic image: no shift, no change of brightness, little blur."""

from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from PIL import Image

from snowsplat.data.lens.models import lens_of
from snowsplat.data.lens.positions import Positions
from snowsplat.data.lens.resample import resample, undistort_image, undistort_mask
from snowsplat.data.lens.views import LensView, pinhole_view

from .test_pinhole import LENSES, lens, pinhole_of


def as_camera(pinhole: LensView) -> pycolmap.Camera:
    return lens("PINHOLE", list(pinhole.params), pinhole.width, pinhole.height)


def photograph(camera: pycolmap.Camera, pitch: float, channels: int = 3) -> np.ndarray:
    """(H, W, C) in 0..255: sine waves on a plane at z = 1, of ``pitch`` radians per unit."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.cam_from_img(np.stack([x, y], -1).reshape(-1, 2))
    phases = np.arange(channels) * 1.1 + 0.3
    waves = np.sin(pitch * (rays[:, :1] * np.cos(phases) + rays[:, 1:] * np.sin(phases)) + phases)
    return (127.5 + 100 * waves).reshape(camera.height, camera.width, channels)


def to_image(values: np.ndarray) -> Image.Image:
    return Image.fromarray(np.rint(values).astype(np.uint8))


@pytest.mark.parametrize("name", LENSES)
def test_a_photo_becomes_that_of_the_pinhole_camera(name):
    camera = lens(*LENSES[name])
    pinhole = pinhole_of(camera)
    # About 14 pixels per wave; the waves of a fisheye are much shorter near its border.
    pitch = 30 if name == "fisheye" else 110
    made = np.asarray(undistort_image(to_image(photograph(camera, pitch)), pinhole), np.float64)
    true = photograph(as_camera(pinhole), pitch)
    assert made.shape == true.shape
    inner = (slice(3, -3), slice(3, -3))
    difference = (made - true)[inner]
    # With 0.29 of rounding to 8 bits. Bilinear sampling: 1.0 to 1.5.
    assert np.sqrt((difference**2).mean()) < 0.6
    assert abs(difference.mean()) < 0.02
    # Displacement by least squares from the gradient, in 3 × 3 parts: none is shifted.
    gradient_y, gradient_x = np.gradient(true, axis=(0, 1))
    for rows in np.array_split(np.arange(3, true.shape[0] - 3), 3):
        for columns in np.array_split(np.arange(3, true.shape[1] - 3), 3):
            part = np.ix_(rows, columns)
            matrix = np.stack([gradient_x[part].ravel(), gradient_y[part].ravel()], 1)
            shift = np.linalg.lstsq(matrix, (made - true)[part].ravel(), rcond=None)[0]
            assert np.abs(shift).max() < 0.02  # pixels


def test_colours_of_transparent_pixels_do_not_bleed():
    camera = lens(*LENSES["barrel"])
    pixels = np.zeros((240, 320, 4), np.uint8)
    pixels[..., 1] = 255  # transparent green …
    pixels[60:180, 80:240] = (200, 50, 50, 255)  # … around opaque red
    made = np.asarray(undistort_image(Image.fromarray(pixels), pinhole_of(camera)))
    seen = made[..., 3] > 16
    edge = seen & (made[..., 3] < 240)
    assert edge.any()
    assert np.abs(made[edge][:, :3].astype(int) - (200, 50, 50)).max() < 12
    assert 0.9 < seen.mean() / ((pixels[..., 3] > 0).mean()) < 1.1


def test_masks_stay_binary():
    camera = lens(*LENSES["barrel"])
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    disc = (np.hypot(x - 158, y - 121) < 70).astype(np.uint8) * 255
    made = np.asarray(undistort_mask(Image.fromarray(disc), pinhole_of(camera)))
    assert set(np.unique(made)) == {0, 255}
    assert 1.0 < (made > 0).sum() / (disc > 0).sum() < 1.1  # barrel distortion: enlarged


def test_borders_and_levels_do_not_change():
    pinhole = pinhole_of(lens(*LENSES["tangential"]))
    for mode, colour in (("L", 255), ("L", 3), ("RGB", (1, 128, 254)), ("RGBA", (9, 99, 199, 255))):
        made = undistort_image(Image.new(mode, (320, 240), colour), pinhole)
        assert made.mode == mode
        assert made.size == (pinhole.width, pinhole.height)
        assert made.getcolors() == [(pinhole.width * pinhole.height, colour)]


def test_without_distortion_the_photo_is_unchanged():
    pinhole = pinhole_of(lens("PINHOLE", [260.0, 255.0, 160.0, 120.0]))
    image = Image.effect_noise((320, 240), 60)
    assert undistort_image(image, pinhole) is image


@dataclass
class Grid:
    """A map with any positions of nodes."""

    nodes: np.ndarray
    wraps: bool = False

    def positions(self, width, height):
        yield slice(0, height), Positions.between(self.nodes, width, height)


def reference(planes: np.ndarray, at: np.ndarray, wraps: bool) -> np.ndarray:
    """(C, H, W): Catmull-Rom splines at positions (H, W, 2) in float64, before rounding."""
    size = planes.shape[:0:-1]
    first = np.floor(at - 0.5).astype(int)
    f = (at - 0.5 - first)[..., None]
    weights = [-(f**3) + 2 * f**2 - f, 3 * f**3 - 5 * f**2 + 2, -3 * f**3 + 4 * f**2 + f]
    weights = np.concatenate([*weights, f**3 - f**2], -1) / 2  # (H, W, 2, 4)
    x, y = (first[..., k, None] + np.arange(-1, 3) for k in (0, 1))
    x = x % size[0] if wraps else x.clip(0, size[0] - 1)
    taps = planes[:, y.clip(0, size[1] - 1)[..., None], x[..., None, :]].astype(float)
    return np.einsum("chwij,hwi,hwj->chw", taps, weights[..., 1, :], weights[..., 0, :])


def check(planes: np.ndarray, at: np.ndarray, wraps: bool = False) -> None:
    """`resample` at positions (H, W, 2), which are multiples of 1/256 pixel, is the reference."""
    height, width = at.shape[:2]

    class Exact(Grid):
        def positions(self, width, height):
            yield slice(0, height), Positions.exact(at.astype(np.float32))

    made = resample(planes, Exact(at, wraps), width, height).astype(float)
    assert np.abs(made - reference(planes, at, wraps).clip(0, 255)).max() <= 0.501


@pytest.mark.isa
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 2), (200, 150)])
def test_each_pixel_is_that_of_the_spline(channels, size):
    """At any positions: tiles that need the whole photo, its borders, and what is beyond them."""
    random = np.random.default_rng(channels)
    planes = random.integers(0, 256, (channels, *size[::-1]), dtype=np.uint8)
    low, high = (-600, -600), (256 * (size[0] + 3), 256 * (size[1] + 3))
    check(planes, random.integers(low, high, (19, 131, 2)) / 256)
    smooth = np.stack(np.meshgrid(np.arange(131) * 1.25, np.arange(40) * 0.5), -1)
    check(planes, smooth + random.integers(0, 256, 2) / 256)
    turned = smooth @ np.array([[0.75, 0.5], [-0.5, 0.75]]) + (20, 0)
    check(planes, np.rint(256 * turned) / 256)
    turned[..., 0] %= 3 * size[0]  # with seams
    check(planes, np.rint(256 * turned) / 256, wraps=True)


@pytest.mark.isa
def test_positions_without_a_value_do_not_disturb_others():
    planes = np.random.default_rng(0).integers(0, 256, (3, 50, 60), dtype=np.uint8)
    nodes = np.stack(np.meshgrid(np.linspace(0, 60, 7), np.linspace(0, 50, 6)), -1)
    nodes = nodes.astype(np.float32)
    whole = resample(planes, Grid(nodes), 60, 50)
    assert np.array_equal(whole, planes)  # each pixel is at its own position
    nodes[2, 3] = np.nan
    made = resample(planes, Grid(nodes), 60, 50)
    near = np.zeros((50, 60), bool)
    near[10:30, 20:40] = True
    assert np.array_equal(made[:, ~near], planes[:, ~near])
    assert (made[:, near] == planes[:, :1, 0]).all()
    nodes[2, 3] = np.inf
    assert (resample(planes, Grid(nodes), 60, 50)[:, near] >= 0).all()


@pytest.mark.parametrize("name", LENSES)
def test_positions_between_nodes_are_exact_to_a_hundredth_of_a_pixel(name):
    model, params = LENSES[name]
    camera = lens_of(model, 1280, 960, (*(4 * np.array(params[: -4 if len(params) > 4 else 3])),))
    camera = lens_of(model, 1280, 960, (*camera.params, *params[len(camera.params) :]))
    pinhole = pinhole_view(camera)
    fx, fy, cx, cy = pinhole.params
    ((_, positions),) = pinhole.positions(pinhole.width, pinhole.height)
    for rows, found in positions.strips():
        x, y = np.arange(pinhole.width) + 0.5, np.arange(pinhole.height)[rows] + 0.5
        across, down = np.meshgrid((x - cx) / fx, (y - cy) / fy)
        true = camera.project(np.stack([across, down, np.ones_like(across)], -1))
        assert np.abs(found - true).max() < 0.011  # with the rounding to float32
