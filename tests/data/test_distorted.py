"""Datasets with lens distortion: their photos, masks and depth maps become pinhole views.

Photos have smooth patterns of the pixel position, so each pixel of a view says where it comes from.
"""

import json
import math
import random

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data import ImageLoader, load_dataset
from snowsplat.data.colmap.model import read_model, write_model
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.data.judge.verdict import judge
from snowsplat.data.lens.models import COLMAP_MODELS, lens_of
from snowsplat.data.maps.map_files import to_z
from snowsplat.data.photos.decode import load_image, load_thumbnail
from snowsplat.pipeline.blocks.plan import write_block_dataset
from snowsplat.util.errors import UserError

W, H = 160, 120
FOCAL = {"f": 110.0, "fx": 110.0, "fy": 108.0, "cx": 82.0, "cy": 59.0, "w": 160.0, "h": 120.0}
OPENCV = (110.0, 108.0, 82.0, 59.0, -0.1, 0.02, 1e-3, -2e-3)
WIDE = ("FISHEYE", (45.0, 45.0, 80.0, 60.0))  # 204° across, 153° down


def params_of(model):
    import pycolmap

    names = pycolmap.Camera.create_from_model_name(1, model, 1.0, W, H).params_info
    values = {**FOCAL, "omega": 0.9, "alpha": 0.6, "beta": 1.1, "k": -0.1, "k1": -0.05, "p1": 1e-3}
    return tuple(values.get(name.strip(), 0.002) for name in names.split(","))


def pattern(x, y):
    """(..., 3) in 0..255: colours at positions of the photo, in pixels of 160 × 120."""
    waves = (np.sin(x / 9), np.sin(y / 7 + 1), np.sin((x + y) / 11 + 2))
    return 127.5 + 110 * np.stack(waves, -1)


def photo(width=W, height=H):
    x, y = np.meshgrid((np.arange(width) + 0.5) * W / width, (np.arange(height) + 0.5) * H / height)
    return Image.fromarray(np.rint(pattern(x, y)).astype(np.uint8))


def write(folder, model="OPENCV", params=OPENCV, count=3, image=None, text=False):
    """A COLMAP dataset of ``count`` equal photos that look along z."""
    (folder / "images").mkdir(parents=True)
    for i in range(count):
        (image or photo()).save(folder / f"images/{i}.png")
    images = [ColmapImage(f"{i}.png", 1, (1.0, 0, 0, 0, 0.1 * i, 0, 0)) for i in range(count)]
    camera = {1: lens_of(model, W, H, tuple(map(float, params)))}
    nothing = np.empty((0, 3))
    write_model(folder / "sparse/0", camera, images, nothing, nothing, text=text)
    return folder


def source_positions(view, lens):
    """(H, W, 2): where the pixels of a view are in the photo, from its camera and pose alone."""
    camera = view.camera
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    return lens.project(rays @ camera.cam_from_world[:, :3].numpy())


def check(view, lens, loaded, error=4.0):
    at = source_positions(view, lens)
    inside = (at > 2).all(-1) & (at < (W - 2, H - 2)).all(-1)
    if loaded.mask is not None:
        inside &= loaded.mask.numpy()
    assert inside.sum() > 100
    difference = np.abs(loaded.rgb.numpy() - pattern(at[..., 0], at[..., 1]))[inside]
    assert difference.max() < error * 3
    assert difference.mean() < error / 3


@pytest.mark.parametrize("model", [model.name for model in COLMAP_MODELS])
def test_each_model_becomes_pinhole_views(tmp_path, model):
    params = params_of(model)
    folder = write(tmp_path / "binary", model, params, 2)
    text = write(tmp_path / "text", model, params, 2, text=True)
    assert read_model(text / "sparse/0").cameras == read_model(folder / "sparse/0").cameras
    dataset = load_dataset(folder, hold_out=None)
    assert judge(dataset) == []
    with ImageLoader(dataset.train) as images:
        for view in dataset.train:
            loaded = images.get(view)
            assert loaded.rgb.shape == (view.camera.height, view.camera.width, 3)
            check(view, lens_of(model, W, H, params), loaded, error=8.0)


def test_the_focal_length_is_kept_and_no_border_is_blank(tmp_path):
    (view, *_) = load_dataset(write(tmp_path), hold_out=None).train
    assert (view.camera.fx, view.camera.fy) == (110.0, 108.0)
    assert view.mask is None
    assert view.camera.width > W - 8


@pytest.mark.parametrize("resolution", [2, 4, 90])
def test_scaled_photos(tmp_path, resolution):
    dataset = load_dataset(write(tmp_path), hold_out=None, resolution=resolution)
    view = dataset.train[0]
    assert view.camera.width == pytest.approx(90 if resolution == 90 else W / resolution, abs=5)
    with ImageLoader([view]) as images:
        check(view, lens_of("OPENCV", W, H, OPENCV), images.get(view), error=12.0 * resolution)


@pytest.mark.parametrize("size", [(80, 60), (240, 180), (119, 89)])
def test_photos_of_another_size_than_the_camera(tmp_path, size):
    view = load_dataset(write(tmp_path, image=photo(*size)), hold_out=None).train[0]
    assert view.camera.fx == pytest.approx(110.0 * size[0] / W, rel=0.01)
    with ImageLoader([view]) as images:
        check(view, lens_of("OPENCV", W, H, OPENCV), images.get(view), error=12.0)


def test_a_folder_of_smaller_copies_gives_the_same_view(tmp_path):
    folder = write(tmp_path)
    large = load_dataset(folder, resolution=2).train[0]
    (folder / "images_2").mkdir()
    for i in range(3):
        photo(80, 60).save(folder / f"images_2/{i}.png")
    small = load_dataset(folder, resolution=2).train[0]
    assert small.image.path.parent.name == "images_2"
    assert (small.camera.width, small.camera.height) == (large.camera.width, large.camera.height)
    assert small.camera.fx == large.camera.fx
    a, b = (load_image(view.image).float() for view in (large, small))
    assert (a - b).abs().mean() < 3


@pytest.mark.parametrize("scale", [1, 2])
def test_masks_are_undistorted_with_their_photos(tmp_path, scale):
    folder = write(tmp_path)
    (folder / "masks").mkdir()
    mask = np.zeros((H // scale, W // scale), np.uint8)
    mask[:, : 60 // scale] = 255
    Image.fromarray(mask).save(folder / "masks/0.png.png")
    view = load_dataset(folder, hold_out=None).train[0]
    with ImageLoader([view]) as images:
        found = images.get(view).mask.numpy()
    x = source_positions(view, lens_of("OPENCV", W, H, OPENCV))[..., 0]
    sure = np.abs(x - 60) > scale
    assert (found == (x < 60))[sure].all()


def test_a_photo_that_exif_turns(tmp_path):
    folder = write(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6  # turn clockwise
    turned = photo().transpose(Image.Transpose.ROTATE_90)
    for i in range(3):
        turned.save(folder / f"images/{i}.png", exif=exif)
    view = load_dataset(folder, hold_out=None).train[0]
    with ImageLoader([view]) as images:
        check(view, lens_of("OPENCV", W, H, OPENCV), images.get(view), error=8.0)


def test_a_wide_lens_has_several_views_with_masks(tmp_path):
    folder = write(tmp_path, *WIDE, count=9)
    dataset = load_dataset(folder)
    names = {view.name for view in dataset.train}
    assert "1.png/front" in names
    assert not any("\\" in name or ".." in name for name in names)
    # No view of a photo that is held out is trained on.
    held_out = {view.name.split("/")[0] for view in dataset.test}
    assert held_out == {"0.png", "8.png"}
    assert not held_out & {name.split("/")[0] for name in names}
    listed = load_dataset(folder, test_list=["3.png"])
    assert {view.name.split("/")[0] for view in listed.test} == {"3.png"}
    views = [view for view in dataset.train if view.name.startswith("1.png/")]
    assert len(views) == len({view.camera for view in views}) >= 3
    positions = torch.stack([view.camera.position for view in views])
    assert torch.allclose(positions, positions[0].expand_as(positions), atol=1e-12)
    with ImageLoader(views) as images:
        for view in views:
            loaded = images.get(view)
            check(view, lens_of(WIDE[0], W, H, WIDE[1]), loaded, error=12.0)
            at = source_positions(view, lens_of(WIDE[0], W, H, WIDE[1]))
            outside = (at < -1).any(-1) | (at > (W + 1, H + 1)).any(-1)
            if outside.any():
                assert not loaded.mask.numpy()[outside].any()
            small = load_thumbnail(view.image, 40)
            assert small.shape[0] == 4
            assert (small[3] == 0).any() == (view.mask is not None)
    assert not [finding for finding in judge(dataset) if finding.impossible]


def test_black_corners_of_a_circular_fisheye_are_masked(tmp_path):
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    pixels = np.asarray(photo()) * (np.hypot(x - 80, y - 60) < 55)[..., None]
    params = (45.0, 45.0, 80.0, 60.0)
    bright = np.maximum(pixels, 60 * (np.hypot(x - 80, y - 60) < 55)[..., None]).astype(np.uint8)
    dataset = load_dataset(write(tmp_path, "FISHEYE", params, image=Image.fromarray(bright)))
    with ImageLoader(dataset.train) as images:
        for view in dataset.train:
            loaded = images.get(view)
            assert loaded.mask is not None
            seen = loaded.rgb.numpy()[loaded.mask.numpy()]
            assert (seen.max(-1) > 40).mean() > 0.999


def test_z_of_a_turned_view():
    camera = load_like(64, 48)
    values = np.full((48, 64), 2.0, np.float32)  # a wall at z = 2 of the photo
    angle = 0.5
    u = (np.arange(64) + 0.5 - 32) / 40
    photo_z = np.broadcast_to(math.cos(angle) - math.sin(angle) * u, (48, 64)).copy()
    z = to_z(values, "z", camera, photo_z=photo_z)
    np.testing.assert_allclose(z.numpy(), 2.0 / photo_z, rtol=1e-6)
    assert to_z(values, "z", camera, photo_z=-photo_z).isnan().all()


def load_like(width, height):
    from snowsplat.scene.camera import Camera

    pose = torch.eye(4, dtype=torch.float64)[:3]
    return Camera(width, height, 40.0, 40.0, width / 2, height / 2, pose)


def test_impossible_coefficients_are_one_line(tmp_path):
    folder = write(tmp_path, "SIMPLE_RADIAL", (110.0, 80.0, 60.0, -90.0))
    with pytest.raises(UserError, match=r"0\.png: the lens distortion \(SIMPLE_RADIAL 110, 80"):
        load_dataset(folder)


def test_a_block_keeps_the_lens(tmp_path):
    from snowsplat.data import read_files
    from snowsplat.project.training_folder import DatasetSettings

    folder = write(tmp_path / "whole")
    files = read_files(DatasetSettings(str(folder)))
    write_block_dataset(
        tmp_path / "block", [image for image, _ in files.images], None, files.origin
    )
    (camera,) = read_model(tmp_path / "block/sparse/0").cameras.values()
    assert (camera.model, camera.params) == ("OPENCV", OPENCV)
    again = load_dataset(tmp_path / "block", hold_out=None).train[0].camera
    assert again.fx == files.dataset(-1).train[0].camera.fx


# transforms.json

UPRIGHT = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]  # OpenCV axes, in OpenGL's
INTRINSICS = {"fl_x": 110.0, "fl_y": 108.0, "cx": 82.0, "cy": 59.0, "w": W, "h": H}
LENSES = {
    "brown": ({"k1": -0.1, "k2": 0.02, "p1": 1e-3, "p2": -2e-3}, "OPENCV", OPENCV[4:]),
    "k3": (
        {"k1": -0.1, "k3": 0.01, "camera_model": "OPENCV"},
        "FULL_OPENCV",
        (-0.1, 0, 0, 0, 0.01, 0, 0, 0),
    ),
    "rational": (
        {"k1": -0.1, "k4": 0.02, "k6": 0.01},
        "FULL_OPENCV",
        (-0.1, 0, 0, 0, 0, 0.02, 0, 0.01),
    ),
    "fisheye": (
        {"k1": 0.01, "k4": 1e-3, "camera_model": "OPENCV_FISHEYE"},
        "OPENCV_FISHEYE",
        (0.01, 0, 0, 1e-3),
    ),
    "instant-ngp": ({"k1": 0.01, "is_fisheye": True}, "OPENCV_FISHEYE", (0.01, 0, 0, 0)),
    "tangential": (
        {"k1": 0.01, "p1": 1e-3, "is_fisheye": True},
        "THIN_PRISM_FISHEYE",
        (0.01, 0, 1e-3, 0, 0, 0, 0, 0),
    ),
    "thin prism": (
        {"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.01, "sx1": 0.02, "sy1": -0.03},
        "THIN_PRISM_FISHEYE",
        (0.01, 0, 0, 0, 0, 0, 0.02, -0.03),
    ),
    "aria by names": (
        {"camera_model": "FISHEYE624", "k1": 0.01, "p0": 1e-3, "s3": 1e-3},
        "RAD_TAN_THIN_PRISM_FISHEYE",
        (0.01, *(0,) * 5, 1e-3, *(0,) * 4, 1e-3),
    ),
    "aria": (
        {"camera_model": "FISHEYE624", "distortion_params": [0.01] * 6 + [1e-3] * 6},
        "RAD_TAN_THIN_PRISM_FISHEYE",
        (0.01,) * 6 + (1e-3,) * 6,
    ),
    "panorama": ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR", None),
}


def write_json(folder, common, frames=({}, {})):
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        frame |= {"file_path": f"images/{i}.png", "transform_matrix": UPRIGHT}
        photo().save(folder / frame["file_path"])
    (folder / "transforms.json").write_text(json.dumps({**common, "frames": list(frames)}))
    return folder


@pytest.mark.parametrize("name", LENSES)
def test_lenses_of_transforms_json(tmp_path, name):
    entries, model, coefficients = LENSES[name]
    common = entries if coefficients is None else {**INTRINSICS, **entries}
    params = (float(W), float(H)) if coefficients is None else (*OPENCV[:4], *coefficients)
    dataset = load_dataset(write_json(tmp_path, common), hold_out=None)
    lens = lens_of(model, W, H, params)
    with ImageLoader(dataset.train) as images:
        for view in dataset.train:
            check(view, lens, images.get(view), error=9.0)


def test_a_model_is_added_by_a_line_of_the_table(tmp_path, monkeypatch):
    """Mei and Rives 2007: its coefficient is read by its name, or the file is refused."""
    from snowsplat.data.lens.lens import Lens, Model
    from snowsplat.data.readers import transforms_lens

    def unified(lens, x, y, z):
        depth = z + lens.coefficients[0] * np.sqrt(x * x + y * y + z * z)
        return x / depth, y / depth

    model = Model("UNIFIED", ("fx", "fy", "cx", "cy", "xi"), unified, ("UNIFIED",))
    monkeypatch.setitem(transforms_lens._MODELS, "UNIFIED", model)
    common = {**INTRINSICS, "camera_model": "UNIFIED"}
    dataset = load_dataset(write_json(tmp_path, {**common, "xi": 0.3}), hold_out=None)
    with ImageLoader(dataset.train) as images:
        for view in dataset.train:
            check(view, Lens(model, W, H, (*OPENCV[:4], 0.3)), images.get(view), error=9.0)
    with pytest.raises(UserError, match="distortion_params: should be 1 numbers"):
        load_dataset(write_json(tmp_path, {**common, "x_i": 0.3}), hold_out=None)


def test_a_polynomial_of_the_eighth_degree(tmp_path):
    """nerfstudio's k4, which no camera model of COLMAP has."""
    k = (-0.1, 0.02, 0.01, -0.004)
    common = {**INTRINSICS, **dict(zip(("k1", "k2", "k3", "k4"), k, strict=True))}
    view = load_dataset(write_json(tmp_path, common), hold_out=None).train[0]
    lens = view.image.view.lens
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 20), np.linspace(-0.5, 0.5, 20))
    s = x * x + y * y
    factor = 1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    fx, fy, cx, cy = lens.intrinsics
    true = np.stack([fx * x * factor + cx, fy * y * factor + cy], -1)
    found = lens.project(np.stack([x, y, np.ones_like(x)], -1))
    assert np.abs(found - true).max() < 0.01


def test_a_lens_for_each_frame(tmp_path):
    frames = [{"k1": -0.1}, {"k1": 0.05, "fl_x": 120.0}, {}, {"is_fisheye": True}]
    dataset = load_dataset(write_json(tmp_path, INTRINSICS, frames), hold_out=None)
    lenses = [
        lens_of("OPENCV", W, H, (110.0, 108.0, 82.0, 59.0, -0.1, 0, 0, 0)),
        lens_of("OPENCV", W, H, (120.0, 108.0, 82.0, 59.0, 0.05, 0, 0, 0)),
        lens_of("PINHOLE", W, H, (110.0, 108.0, 82.0, 59.0)),
        lens_of("OPENCV_FISHEYE", W, H, (110.0, 108.0, 82.0, 59.0, 0, 0, 0, 0)),
    ]
    with ImageLoader(dataset.train) as images:
        for view, lens in zip(dataset.train, lenses, strict=True):
            check(view, lens, images.get(view), error=8.0)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"camera_model": "ORTHOPHOTO"}, "frame 0: the camera model ORTHOPHOTO is not known"),
        ({"ftheta_p0": 0.1}, "F-THETA|F-Theta"),
        ({"k1": "strong"}, "frame 0: k1 should be a number"),
        ({"k2": float("nan")}, "frame 0: k2 should be a number"),
        ({"k1": -90.0}, "lens distortion"),
        ({"k4": -1e6}, r"lens distortion \(BROWN"),
        ({"camera_model": "FISHEYE624"}, "frame 0: distortion_params: should be 12 numbers"),
        ({"camera_model": "OPENCV", "distortion_params": [0.1]}, "should be 6 numbers"),
    ],
)
def test_lenses_that_cannot_be_used(tmp_path, entries, message):
    with pytest.raises(UserError, match=message) as error:
        load_dataset(write_json(tmp_path, {**INTRINSICS, **entries}), hold_out=None)
    assert "\n" not in str(error.value)


def test_random_entries_are_views_or_one_line_errors(tmp_path):
    generator = random.Random(3)
    values = [0, -0.1, 0.3, 1e3, -1e8, 1e300, float("nan"), True, "x", [], None, {}, [0.1] * 12]
    keys = ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "fl_x", "cx", "w", "is_fisheye"]
    keys += ["distortion_params", "camera_model", "equirectangular", "ftheta_p0"]
    values += ["OPENCV_FISHEYE", "FISHEYE624", "EQUIRECTANGULAR"]
    folder = write_json(tmp_path, INTRINSICS, [{}])
    frame = {"file_path": "images/0.png", "transform_matrix": UPRIGHT}
    for _ in range(50):
        entries = {key: generator.choice(values) for key in generator.sample(keys, 3)}
        scene = {**INTRINSICS, **entries, "frames": [frame]}
        (folder / "transforms.json").write_text(json.dumps(scene))
        try:
            views = load_dataset(folder, hold_out=None).train
        except UserError:
            continue
        assert all(max(view.camera.width, view.camera.height) <= 2 * W + 2 for view in views)
