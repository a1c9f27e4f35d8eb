"""Depth maps: each format and kind of values, ranges, damaged files."""

import sys

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data.maps.map_files import read_depth_file, to_z
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError

POSE = torch.eye(4, dtype=torch.float64)[:3]
CAMERA = Camera(10, 6, 8.0, 8.0, 5.0, 3.0, POSE)
VALUES = np.linspace(1, 250, 60).reshape(6, 10)


def test_png_files_of_8_and_16_bits(tmp_path):
    grey, wide = VALUES.astype(np.uint8), (VALUES * 200).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(wide).save(tmp_path / "wide.png")
    Image.fromarray(np.stack([grey] * 3, -1)).save(tmp_path / "rgb.png")
    for name, expected in {"grey.png": grey, "rgb.png": grey, "wide.png": wide}.items():
        read = read_depth_file(tmp_path / name)
        assert read.dtype == np.float32
        assert np.array_equal(read, expected), name


def test_tiff_and_npy_files_of_floats(tmp_path):
    values = VALUES.astype(np.float32) / 7
    Image.fromarray(values).save(tmp_path / "map.tif")
    np.save(tmp_path / "map.npy", values[None].astype(np.float64))
    assert np.array_equal(read_depth_file(tmp_path / "map.tif"), values)
    assert np.array_equal(read_depth_file(tmp_path / "map.npy"), values)
    for scale, order in ((-1.0, "<f4"), (1.0, ">f4")):  # PFM, from the bottom to the top
        head = f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n".encode()
        (tmp_path / "map.pfm").write_bytes(head + values[::-1].astype(order).tobytes())
        assert np.array_equal(read_depth_file(tmp_path / "map.pfm"), values)


@pytest.mark.parametrize("channel", ["Z", "Y"])
def test_exr_files(tmp_path, channel):
    openexr = pytest.importorskip("OpenEXR")
    values = VALUES.astype(np.float32) / 7
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    channels = {channel: values, "A": np.ones_like(values)}
    openexr.File(header, channels).write(str(tmp_path / "map.exr"))
    assert np.array_equal(read_depth_file(tmp_path / "map.exr"), values)


def test_exr_files_without_the_package_name_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "map.exr").write_bytes(b"v/1\x01")
    with pytest.raises(UserError, match="pip install OpenEXR"):
        read_depth_file(tmp_path / "map.exr")


def test_z_and_distance_and_unknown_values():
    z = to_z(VALUES, "z", CAMERA)
    torch.testing.assert_close(z, torch.from_numpy(VALUES).float())
    u = (np.arange(10) + 0.5 - 5) / 8
    v = (np.arange(6) + 0.5 - 3) / 8
    lengths = np.sqrt(1 + u**2 + v[:, None] ** 2)
    torch.testing.assert_close(to_z(VALUES * lengths, "distance", CAMERA), z)
    # A map of another size than the photo: the rays are those of its own pixels.
    larger = Camera(40, 24, 32.0, 32.0, 20.0, 12.0, POSE)
    torch.testing.assert_close(to_z(VALUES * lengths, "distance", larger), z)
    holes = VALUES.copy()
    holes[0, :4] = [0, -1, np.nan, np.inf]
    found = to_z(holes, "z", CAMERA)
    assert found[0, :4].isnan().all()
    assert not found.flatten()[4:].isnan().any()


def test_disparity_is_known_up_to_a_factor_and_has_a_farthest_depth():
    z = np.array([[1.0, 2.0], [4.0, 100.0]])
    found = to_z(37.0 / z, "disparity", CAMERA)
    torch.testing.assert_close(found, torch.tensor([[1.0, 2.0], [4.0, 20.0]]))
    assert to_z(np.array([[0.0, 5.0]]), "disparity", CAMERA).tolist() == [[20.0, 1.0]]


def test_a_range_of_depths():
    grey = np.array([[0.0, 51.0, 255.0]])
    torch.testing.assert_close(to_z(grey, "z", CAMERA, 2, 12), torch.tensor([[2.0, 4.0, 12.0]]))
    disparity = to_z(grey, "disparity", CAMERA, 2, 10)
    torch.testing.assert_close(1 / disparity, torch.tensor([[0.1, 0.18, 0.5]]))
    assert to_z(np.full((2, 2), 7.0), "z", CAMERA, 2, 12).tolist() == [[12.0] * 2] * 2


@pytest.mark.parametrize(("near", "far"), [(1.0, None), (None, 2.0), (2.0, 1.0), (0.0, 1.0)])
def test_invalid_ranges(near, far):
    with pytest.raises(UserError, match="range"):
        to_z(VALUES, "z", CAMERA, near, far)


def test_maps_without_a_value():
    with pytest.raises(UserError, match="no valid value"):
        to_z(np.full((2, 2), np.nan), "z", CAMERA)
    with pytest.raises(UserError, match="no valid value"):
        to_z(np.zeros((2, 2)), "distance", CAMERA)
    with pytest.raises(UserError, match="no positive disparity"):
        to_z(np.full((2, 2), -1.0), "disparity", CAMERA)


def test_files_that_are_no_depth_maps(tmp_path):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8) + np.arange(3, dtype=np.uint8)).save(
        tmp_path / "photo.png"
    )
    np.save(tmp_path / "words.npy", np.array([["a"]]))
    np.save(tmp_path / "objects.npy", np.array([[None]]), allow_pickle=True)
    Image.fromarray(np.zeros((4, 4), np.uint8)).convert("P").save(tmp_path / "palette.png")
    (tmp_path / "damaged.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "damaged.npy").write_bytes(b"\x93NUMPY\x01")
    (tmp_path / "damaged.pfm").write_bytes(b"Pf\n3 4\n-1\n123")
    (tmp_path / "map.txt").write_text("1 2 3")
    for name, problem in {
        "photo.png": "one number per pixel",
        "palette.png": "palette of colours",
        "words.npy": "one number per pixel",
        "objects.npy": "cannot be read",
        "damaged.png": "cannot be read",
        "damaged.npy": "cannot be read",
        "damaged.pfm": "cannot be read",
        "map.txt": "unknown kind",
        "missing.png": "no such depth map",
    }.items():
        with pytest.raises(UserError, match=problem) as error:
            read_depth_file(tmp_path / name)
        assert name in str(error.value)
        assert "\n" not in str(error.value)
