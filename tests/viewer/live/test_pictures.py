"""All display modes, on scenes with known images."""

import math

import numpy as np
import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.scene.render import render
from snowsplat.viewer.live.pictures import DEPTH, HEAT, Display, Photo, PhotoRectangle, draw

WIDTH, HEIGHT = 90, 60
CAMERA = Camera(WIDTH, HEIGHT, 80.0, 80.0, 45.0, 30.0, torch.eye(3, 4, dtype=torch.float64))
RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)


def balls(*places, colors=(RED, GREEN), size=0.12, opacity=0.98) -> Gaussians:
    """Gaussians of one size at some places."""
    n = len(places)
    return Gaussians(
        means=torch.tensor(places),
        log_scales=torch.full((n, 3), math.log(size)),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh_dc=((torch.tensor(colors[:n]) - 0.5) / SH_C0)[:, None],
        sh_rest=torch.zeros(n, 3, 3),
    )


LEFT, RIGHT = (-0.5, 0.0, 2.0), (1.0, 0.0, 4.0)  # in the image at column 25 and 65, row 30
TWO = balls(LEFT, RIGHT)


def at(picture: np.ndarray, column: int, row: int = 30) -> list[int]:
    return picture[row, column].tolist()


def test_colours_are_those_of_a_render():
    picture = draw(TWO, CAMERA, Display(), torch.tensor([0.0, 0.0, 1.0]))
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    image = render(TWO, CAMERA, torch.tensor([0.0, 0.0, 1.0])).image
    assert np.abs(picture - 255 * image.clamp(0, 1).numpy()).max() <= 0.51
    assert at(picture, 25)[0] > 200
    assert at(picture, 65)[1] > 200
    assert at(picture, 5) == [0, 0, 255]


def test_depth_grows_from_yellow_to_violet():
    far = [float(x) for x in np.linspace(2.0, 8.0, 5)]
    row = balls(*[((i - 2) * 0.15 * z, 0.0, z) for i, z in enumerate(far)], colors=[RED] * 5)
    row.log_scales = torch.log(0.04 * torch.tensor(far))[:, None].repeat(1, 3)
    picture = draw(row, CAMERA, Display("depth"))
    # The place of each colour in the palette.
    table = DEPTH.numpy().astype(int)
    places = [
        int(np.abs(table - picture[30, 45 + 12 * (i - 2)].astype(int)).sum(1).argmin())
        for i in range(5)
    ]
    assert places == sorted(places, reverse=True)
    assert places[0] > 240
    assert places[4] < 30
    assert at(picture, 45, 2) == [0, 0, 0]  # empty
    assert not draw(balls((0.0, 0.0, -1.0)), CAMERA, Display("depth")).any()


def test_opacity():
    picture = draw(TWO, CAMERA, Display("alpha"), torch.ones(3))
    assert at(picture, 25)[0] > 230
    assert len(set(at(picture, 25))) == 1
    assert at(picture, 5) == [0, 0, 0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_normals_are_the_shortest_axes_towards_the_camera(sign):
    flat = balls((0.0, 0.0, 2.0))
    flat.log_scales[0, 2] = math.log(0.001)
    flat.quats = sign * flat.quats
    red, green, blue = at(draw(flat, CAMERA, Display("normals")), 45)
    assert (red, green) == pytest.approx((128, 128), abs=4)
    assert blue > 250
    # Rotated about the vertical axis by 45° it faces right or left.
    flat.quats = torch.tensor([[math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0]])
    red, green, blue = at(draw(flat, CAMERA, Display("normals")), 45)
    assert red == pytest.approx(255 * (0.5 - 0.5 / math.sqrt(2)), abs=6)
    assert green == pytest.approx(128, abs=4)
    assert blue == pytest.approx(255 * (0.5 + 0.5 / math.sqrt(2)), abs=6)


def shown(picture: np.ndarray) -> int:
    return int((picture.max(2) > 20).sum())


def test_points_are_small_and_have_their_colours():
    picture = draw(TWO, CAMERA, Display("points"))
    assert 2 <= shown(picture) < 40
    assert at(picture, 65)[1] > at(picture, 65)[0]
    assert np.array_equal(picture, draw(TWO, CAMERA, Display("points", scale=0.1)))


def test_ellipsoids_are_opaque_discs_with_an_edge():
    picture = draw(balls((0.0, 0.0, 2.0), opacity=0.5), CAMERA, Display("ellipsoids"))
    radius = 1.5 * math.hypot(
        80 * 0.12 / 2, math.sqrt(0.3)
    )  # of the splat, with the low-pass filter of 0.3 pixels²
    assert shown(picture) == pytest.approx(math.pi * radius**2, rel=0.15)
    values = picture[30, :, 0]
    assert values.max() == pytest.approx(0.9 * 255, abs=6)
    between = (values > 20) & (values < 200)
    assert between.sum() <= 4
    assert not draw(balls((0.0, 0.0, 2.0), opacity=0.05), CAMERA, Display("ellipsoids")).any()


def test_cost_counts_gaussians():
    place = (0.0, 0.0, 2.0)
    heat = HEAT.numpy().astype(int)
    places = []
    for n in (1, 2, 8):
        picture = draw(balls(*[place] * n, colors=[RED] * n, opacity=0.1), CAMERA, Display("cost"))
        places.append(int(np.abs(heat - picture[30, 45].astype(int)).sum(1).argmin()))
        assert at(picture, 2) == [0, 0, 0]
    expected = [255 * math.log1p(n) / math.log1p(256) for n in (1, 2, 8)]
    assert places == pytest.approx(expected, abs=3)


def test_a_crop_removes_what_is_outside():
    crop = ((-1.0, -1.0, 1.0), (0.0, 1.0, 3.0))
    picture = draw(TWO, CAMERA, Display(crop=crop))
    assert at(picture, 25)[0] > 200
    assert at(picture, 65) == [0, 0, 0]
    assert not draw(TWO, CAMERA, Display(crop=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)))).any()


def test_scale_shrinks():
    sizes = [shown(draw(TWO, CAMERA, Display(scale=scale))) for scale in (1.0, 0.5, 0.2)]
    assert sizes[0] > 2 * sizes[1] > 4 * sizes[2] > 0


def test_sh_degree():
    views = TWO.clone()
    views.sh_rest[:, 1] = 1.0  # along z
    full, plain = (
        draw(views, CAMERA, Display(degree=3)),
        draw(views, CAMERA, Display(degree=0)),
    )
    assert not np.array_equal(full, plain)
    assert np.array_equal(plain, draw(TWO, CAMERA, Display()))


def photo_of(picture: np.ndarray) -> Photo:
    placed = PhotoRectangle(10, 0, 70, 60)
    return Photo(torch.from_numpy(picture[:, 10:80].copy()), placed)


def test_the_error_of_equal_photo_and_render_is_zero():
    colors = draw(TWO, CAMERA, Display())
    same = draw(TWO, CAMERA, Display("error"), photo=photo_of(colors))
    assert not same[:, 10:80].any()
    other = photo_of(colors)
    other.pixels[20:40, 40:50] = 255  # column 50 to 60 of the picture
    error = draw(TWO, CAMERA, Display("error"), photo=other)
    assert error[30, 52].min() > 100
    assert not error[:20, 10:80].any()
    without = draw(TWO, CAMERA, Display("error"))
    assert np.array_equal(without, colors)


def test_a_photo_is_wiped_over_the_render():
    colors = draw(TWO, CAMERA, Display())
    white = Photo(torch.full((60, 70, 3), 255, dtype=torch.uint8), PhotoRectangle(10, 0, 70, 60))
    render_only = draw(TWO, CAMERA, Display(), photo=white)
    assert np.array_equal(render_only[:, 10:80], colors[:, 10:80])
    half = draw(TWO, CAMERA, Display(wipe=0.5), photo=white)
    assert (half[:, 10:45] == 255).all()
    assert np.array_equal(half[:, 46:80], colors[:, 46:80])
    whole = draw(TWO, CAMERA, Display(wipe=1.0), photo=white)
    assert (whole[:, 10:80] == 255).all()
    assert whole[:, :10].max() <= 0.36 * 255  # darker around it


def test_an_empty_scene():
    nothing = TWO.select(torch.zeros(0, dtype=torch.int64))
    for mode in ("color", "depth", "alpha", "normals", "points", "ellipsoids", "cost", "error"):
        assert not draw(nothing, CAMERA, Display(mode)).any(), mode
