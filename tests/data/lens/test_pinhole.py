"""The pinhole camera of a lens is valid for every calibration that SfM may return."""

import numpy as np
import pycolmap
import pytest

from snowsplat.data.lens.models import lens_of
from snowsplat.data.lens.views import LensView, pinhole_view

LENSES = {
    "pincushion": ("SIMPLE_RADIAL", [260.0, 160.0, 120.0, 0.15]),
    "barrel": ("SIMPLE_RADIAL", [260.0, 158.3, 121.6, -0.2]),
    "tangential": ("OPENCV", [262.0, 258.0, 165.0, 117.0, -0.12, 0.05, 0.003, -0.004]),
    "fisheye": ("OPENCV_FISHEYE", [150.0, 150.0, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0]),
}


def pinhole_of(camera: pycolmap.Camera) -> LensView:
    size = camera.width, camera.height
    return pinhole_view(lens_of(camera.model_name, *size, tuple(camera.params)))


def nodes_of(view: LensView) -> np.ndarray:
    ((_, positions),) = view.positions(view.width, view.height)
    return positions.nodes


def lens(model: str, params: list[float], width: int = 320, height: int = 240) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


@pytest.mark.parametrize("name", LENSES)
def test_no_blank_borders_and_the_same_size_as_colmap(name):
    camera = lens(*LENSES[name])
    pinhole = pinhole_of(camera)
    nodes = nodes_of(pinhole)
    assert nodes.min() > -1
    assert (nodes.max(axis=(0, 1)) < (321, 241)).all()
    theirs = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    assert (pinhole.width, pinhole.height) == (theirs.width, theirs.height)
    assert np.allclose(pinhole.params, theirs.params)
    assert not pinhole.cropped


@pytest.mark.parametrize("name", LENSES)
def test_nodes_are_the_distorted_positions(name):
    camera = lens(*LENSES[name])
    pinhole = pinhole_of(camera)
    fx, fy, cx, cy = pinhole.params
    nodes = nodes_of(pinhole)
    rows, columns = nodes.shape[:2]
    for row, column in ((0, 0), (rows - 1, columns - 1), (rows // 2, 1)):
        x, y = column * pinhole.width / (columns - 1), row * pinhole.height / (rows - 1)
        expected = camera.img_from_cam(np.array([(x - cx) / fx, (y - cy) / fy, 1.0]))
        assert np.allclose(nodes[row, column], expected)


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", [260.0, 160.0, 120.0], (260.0, 260.0, 160.0, 120.0)),
        ("PINHOLE", [260.0, 255.0, 160.0, 120.0], (260.0, 255.0, 160.0, 120.0)),
        ("RADIAL", [260.0, 161.0, 122.0, 0.0, 0.0], (260.0, 260.0, 161.0, 122.0)),
    ],
)
def test_a_camera_without_distortion_is_unchanged(model, params, expected):
    pinhole = pinhole_of(lens(model, params))
    assert pinhole.is_photo
    assert (pinhole.width, pinhole.height) == (320, 240)
    assert pinhole.params == expected


def test_a_fisheye_without_coefficients_is_no_pinhole():
    assert not pinhole_of(lens(*LENSES["fisheye"])).is_photo


@pytest.mark.parametrize(
    ("model", "params", "cropped"),
    [
        # Polynomials that turn back inside the image, and one that has a pole outside.
        ("SIMPLE_RADIAL", [250.0, 160.0, 120.0, -0.6], True),
        (
            "FULL_OPENCV",
            [250.0, 250.0, 160.0, 120.0, 0.1, 0.1, 0.0, 0.0, 0.1, -2.0, 0.0, 0.0],
            False,
        ),
    ],
)
def test_a_folded_image_is_cropped(model, params, cropped):
    pinhole = pinhole_of(lens(model, params))
    assert pinhole.cropped == cropped
    assert pinhole.width >= 64
    # The map is monotonic in both directions.
    nodes = nodes_of(pinhole)
    assert (np.diff(nodes[..., 0], axis=1) > 0).all()
    assert (np.diff(nodes[..., 1], axis=0) > 0).all()
    assert nodes.min() > -1


@pytest.mark.parametrize("strength", [-30.0, 300.0])
def test_an_absurd_distortion_is_rejected(strength):
    with pytest.raises(ValueError, match="less than a fifth"):
        pinhole_of(lens("SIMPLE_RADIAL", [250.0, 160.0, 120.0, strength]))
