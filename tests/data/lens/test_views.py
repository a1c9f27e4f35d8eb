"""Pinhole views of lenses: each pixel shows the direction that it should show."""

import math

import numpy as np
import pycolmap
import pytest

from snowsplat.data.lens.coverage import covered_pixels, image_circle
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.models import COLMAP_MODELS, lens_of
from snowsplat.data.lens.resample import nearest, resample
from snowsplat.data.lens.views import lens_views, look

# Plausible coefficients by the names of COLMAP's parameters.
COEFFICIENTS = {"omega": 0.9, "alpha": 0.6, "beta": 1.1, "k": -0.1, "k1": -0.03, "p1": 1e-3}
COEFFICIENTS |= {"k0": 0.02, "k2": 0.01, "p0": -1e-3, "p2": 2e-3, "s1": 1e-3, "sx1": 1e-3}
WIDE = {
    "half a sphere in the photo": (
        lens_of("FISHEYE", 900, 900, (286.0, 286.0, 452.0, 447.0)),
        None,
    ),
    "circle of 180°": (lens_of("FISHEYE", 900, 900, (286.0, 286.0, 452.0, 447.0)), 430.0),
    "circle of 220°": (lens_of("SIMPLE_FISHEYE", 900, 900, (234.0, 450.0, 450.0)), 449.0),
    "action camera": (
        lens_of("OPENCV_FISHEYE", 960, 540, (300.0, 301.0, 483.0, 268.0, 0.02, -0.01, 0.0, 0.0)),
        None,
    ),
    "perspective": (lens_of("SIMPLE_DIVISION", 960, 540, (300.0, 480.0, 270.0, -0.5)), None),
    "panorama": (lens_of("EQUIRECTANGULAR", 1200, 600, (1200.0, 600.0)), None),
}


def colmap_camera(model: str) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(1, model, 600.0, 1000, 800)
    names = camera.params_info.replace(" ", "").split(",")
    pairs = zip(names, camera.params, strict=True)
    camera.params = [COEFFICIENTS.get(name, value) for name, value in pairs]
    return camera


def as_lens(camera: pycolmap.Camera) -> Lens:
    return lens_of(camera.model_name, camera.width, camera.height, tuple(camera.params))


def position_of(view, x, y):
    """Positions (H, W, 2) in the photo by the definition, at columns x and rows y of the view."""
    fx, fy, cx, cy = view.params
    u, v = np.meshgrid((x - cx) / fx, (y - cy) / fy)
    rays = np.stack([u, v, np.ones_like(u)], -1)
    return view.lens.project(rays if view.rotation is None else rays @ np.array(view.rotation))


def test_all_models_of_colmap_are_known_with_their_numbers():
    theirs = {
        int(number): name for name, number in pycolmap.CameraModelId.__members__.items() if number
    }
    theirs = {number: name for number, name in theirs.items() if number >= 0}
    theirs[0] = "SIMPLE_PINHOLE"
    assert [theirs[number] for number in sorted(theirs)] == [model.name for model in COLMAP_MODELS]
    for model in COLMAP_MODELS:
        assert len(colmap_camera(model.name).params) == len(model.parameters)


@pytest.mark.parametrize("model", [model.name for model in COLMAP_MODELS])
def test_projections_are_those_of_colmap(model):
    camera = colmap_camera(model)
    rays = np.random.default_rng(0).normal(size=(2000, 3))
    rays[:, 2] = np.abs(rays[:, 2]) + 0.3
    found = as_lens(camera).project(rays)
    np.testing.assert_allclose(found, camera.img_from_cam(rays), rtol=0, atol=1e-8)
    if model != "EQUIRECTANGULAR":
        pixels = np.random.default_rng(1).uniform((300, 250), (700, 550), (50, 2))
        np.testing.assert_allclose(
            as_lens(camera).unproject(pixels), camera.cam_from_img(pixels), atol=1e-6
        )


@pytest.mark.parametrize("width", [64, 128, 300, 2000])
def test_positions_of_panoramas_of_any_size_are_exact(width):
    """Also those of a view that one cell of nodes would fill, and whose errors cancel out there."""
    for view in lens_views(lens_of("EQUIRECTANGULAR", width, width // 2, (width, width / 2.0))):
        found = np.concatenate([rows for _, rows in view.strips(view.width, view.height)])
        x, y = np.arange(view.width) + 0.5, np.arange(view.height) + 0.5
        difference = found - view.lens.project(view.rays(x, y))
        difference[..., 0] -= width * np.round(difference[..., 0] / width)
        assert np.abs(difference).max() < 0.05


@pytest.mark.parametrize("name", WIDE)
def test_several_views_cover_the_photo_and_each_pixel_has_its_ray(name):
    lens, circle = WIDE[name]
    views = lens_views(lens, circle)
    assert 2 <= len(views) <= 6
    assert len({view.name for view in views}) == len(views)
    reached = np.zeros((lens.height // 10, lens.width // 10), bool)
    for view in views:
        assert 2 * math.atan(view.width / 2 / view.params[0]) < math.radians(121)
        centre = np.array(view.rotation) @ np.array(view.rotation).T
        np.testing.assert_allclose(centre, np.eye(3), atol=1e-12)
        for rows, found in view.strips(view.width, view.height):
            shown = view.covered(found) & np.isfinite(found).all(-1)
            x, y = np.arange(view.width) + 0.5, np.arange(view.height)[rows] + 0.5
            difference = found - position_of(view, x, y)
            if view.wraps:  # several turns are the same
                turns = np.round(difference[..., 0] / lens.width)
                assert found[..., 0].min() >= 0
                difference[..., 0] -= turns * lens.width
                found[..., 0] %= lens.width
            assert np.abs(difference)[shown].max(initial=0) < 0.02  # pixels of the photo
            inside = (found[shown] / 10).astype(int)
            reached[
                inside[:, 1].clip(0, len(reached) - 1), inside[:, 0].clip(0, reached.shape[1] - 1)
            ] = True
    x, y = (np.arange(size // 10) * 10 + 5.0 for size in (lens.width, lens.height))
    wanted = np.ones_like(reached)
    if circle is not None:
        wanted = np.hypot(x - lens.params[-2], (y - lens.params[-1])[:, None]) < circle - 10
    elif lens.model == "FISHEYE":  # the corners are more than 180° apart
        wanted = np.hypot(x - lens.params[-2], (y - lens.params[-1])[:, None]) < 440
    assert reached[wanted].mean() > 0.98


@pytest.mark.parametrize("width", [896, 1200, 3840])
def test_all_pixels_of_a_panorama_are_used(width):
    views = lens_views(lens_of("EQUIRECTANGULAR", width, width // 2, (width, width // 2)))
    assert not any(view.partial for view in views)


@pytest.mark.parametrize("name", WIDE)
def test_shown_pixels_have_all_samples_in_the_photo_and_its_circle(name):
    for view in lens_views(*WIDE[name])[:2]:
        width, height = view.width // 3, view.height // 3
        samples = np.zeros((2 * height, 2 * width), bool)
        for rows, found in view.strips(2 * width, 2 * height):
            samples[rows] = view.covered(found)
        expected = samples.reshape(height, 2, width, 2).all((1, 3))
        assert np.array_equal(covered_pixels(view, width, height), expected)


@pytest.mark.parametrize("name", ["circle of 220°", "panorama"])
def test_colours_of_a_wide_view_encode_its_rays(name):
    """A photo whose colours are directions: they are found in each view, to 0.1 pixels."""
    lens, circle = WIDE[name]
    for view in lens_views(lens, circle):
        axis = np.array(view.rotation)
        x, y = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
        if name == "panorama":
            turn, rise = np.meshgrid((x / 1200 - 0.5) * 2 * np.pi, (y / 600 - 0.5) * np.pi)
            rays = np.stack(
                [np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], -1
            )
        else:
            u, v = np.meshgrid((x - 450) / 234, (y - 450) / 234)
            angle = np.maximum(np.hypot(u, v), 1e-9)
            ratio = np.sin(angle) / angle
            rays = np.stack([u * ratio, v * ratio, np.cos(angle)], -1)
        in_view = rays @ axis.T
        # A fine and a coarse wave along each axis of the view: phases of the position in the view.
        ahead = np.maximum(in_view[..., 2:], 0.05)
        position = view.params[0] * in_view[..., :2] / ahead
        photo = np.rint(127.5 + 120 * np.sin(position / 8)).astype(np.uint8).transpose(2, 0, 1)
        made = resample(photo, view, view.width, view.height).astype(float)
        u, v = (
            np.arange(size) + 0.5 - centre
            for size, centre in ((view.width, view.params[2]), (view.height, view.params[3]))
        )
        true = 127.5 + 120 * np.sin(np.stack(np.meshgrid(u, v)) / 8)
        slope = 15 * np.abs(np.cos(np.stack(np.meshgrid(u, v)) / 8))
        shown = np.concatenate([view.covered(p) for _, p in view.strips(view.width, view.height)])
        shown[:3] = shown[-3:] = False
        shown[:, :3] = shown[:, -3:] = False
        steep = shown & (slope > 12).all(0)
        shift = (made - true)[:, steep] / (15 * np.cos(np.stack(np.meshgrid(u, v)) / 8))[:, steep]
        assert steep.sum() > 1000
        assert np.abs(np.mean(shift)) < 0.01
        assert np.sqrt(np.mean(shift**2)) < 0.1  # pixels


def test_an_ordinary_lens_is_one_view_with_the_same_axis():
    (view,) = lens_views(lens_of("OPENCV", 400, 300, (300, 300, 200, 150, -0.1, 0.02, 0, 0)))
    assert (view.name, view.rotation, view.partial) == ("", None, False)
    assert view.params[:2] == (300, 300)
    assert view.width > 400  # the borders are stretched


def test_the_circle_of_a_fisheye_is_one_view_if_it_is_small():
    lens = lens_of("FISHEYE", 400, 300, (145.0, 145.0, 200.0, 150.0))
    (view,) = lens_views(lens, 145.0)  # 57° to each side
    assert view.name == ""
    assert view.partial


@pytest.mark.parametrize(
    "lens",
    [
        lens_of("SIMPLE_RADIAL", 400, 300, (300, 200, 150, -90.0)),
        lens_of("SIMPLE_RADIAL", 400, 300, (300, 200, 150, float("nan"))),
        lens_of("OPENCV_FISHEYE", 400, 300, (300, 300, 200, 150, -90.0, 0, 0, 0)),
        lens_of("FISHEYE", 400, 300, (1e8, 1e8, 200, 150)),
        lens_of("FISHEYE", 400, 300, (1e-8, 1e-8, 200, 150)),
        lens_of("OPENCV", 400, 300, (300, 300, 1e8, -1e8, 0.1, 0, 0, 0)),
        lens_of("EUCM", 400, 300, (300, 300, 200, 150, 0.5, -3.0)),
    ],
)
def test_impossible_coefficients_are_errors_not_large_images(lens):
    try:
        views = lens_views(lens)
    except ValueError:
        return
    assert all(max(view.width, view.height) <= 2 * 400 for view in views)


def test_random_coefficients_make_views_of_bounded_size_or_a_value_error():
    random = np.random.default_rng(5)
    for _ in range(60):
        model = COLMAP_MODELS[random.integers(len(COLMAP_MODELS))]
        count = len(model.parameters)
        params = random.normal(size=count) * 10.0 ** random.uniform(-4, 4, count)
        params[:4] = np.abs(params[:4]) if random.random() < 0.8 else params[:4]
        lens = lens_of(model.name, *random.integers(1, 500, 2).tolist(), tuple(params.tolist()))
        try:
            views = lens_views(lens)
        except ValueError:
            continue
        largest = 2 * max(lens.width, lens.height) + 2
        assert all(1 <= min(v.width, v.height) <= max(v.width, v.height) <= largest for v in views)


def test_a_view_turns_right_and_up():
    assert np.allclose(look(0, 0), np.eye(3))
    assert np.allclose(look(math.pi / 2, 0)[2], [1, 0, 0])
    assert np.allclose(look(0, math.pi / 2)[2], [0, -1, 0])


def test_the_image_circle_is_found_where_all_photos_are_black():
    lens = lens_of("FISHEYE", 800, 600, (250.0, 250.0, 410.0, 300.0))
    x, y = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    inside = np.hypot(2 * x - 410, 2 * y - 300) < 280
    random = np.random.default_rng(0)
    photos = [random.integers(0, 255, (3, 300, 400)) * inside for _ in range(4)]
    photos = [np.clip(photo + random.integers(0, 9, photo.shape), 0, 255) for photo in photos]
    found = image_circle(lens, [photo.astype(np.uint8) for photo in photos])
    assert found is not None
    assert 270 < found < 281
    full = [random.integers(0, 255, (3, 300, 400)).astype(np.uint8) for _ in range(4)]
    assert image_circle(lens, full) is None
    assert image_circle(lens, [np.zeros((3, 300, 400), np.uint8)]) is None


def test_depth_is_not_mixed_at_an_edge():
    lens = lens_of("OPENCV", 400, 300, (300, 300, 200, 150, -0.1, 0.02, 0, 0))
    (view,) = lens_views(lens)
    depth = np.where(np.arange(200) < 100, 1.0, 9.0) * np.ones((150, 1), np.float32)
    depth[:40] = 0.0  # unknown
    made = nearest(depth.astype(np.float32), view, view.width, view.height)
    assert set(np.unique(made)) == {0.0, 1.0, 9.0}
    edge = np.argmax(made[view.height // 2] == 9.0)
    assert abs(edge - view.params[2]) <= 2
