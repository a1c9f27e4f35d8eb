"""Normal maps: each format and coding, unknown pixels, files that are none."""

import cv2
import numpy as np
import pytest
from PIL import Image

from snowsplat.data.maps.map_files import read_normal_file
from snowsplat.util.errors import UserError


def normals() -> np.ndarray:
    """(6, 10, 3): random directions towards a camera that looks along z."""
    values = np.random.default_rng(0).standard_normal((6, 10, 3)).astype(np.float32)
    values[..., 2] = -np.abs(values[..., 2])
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def test_files_of_8_and_16_bits(tmp_path):
    coded = 0.5 + 0.5 * normals()
    Image.fromarray(np.rint(255 * coded).astype(np.uint8)).save(tmp_path / "eight.png")
    deep = np.rint(65535 * coded).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), deep[..., ::-1])
    np.save(tmp_path / "deep.npy", deep)
    for name, error in {"eight.png": 0.01, "deep.png": 0.015, "deep.npy": 1e-4}.items():
        read = read_normal_file(tmp_path / name)
        assert read.dtype == np.float32
        np.testing.assert_allclose(read, normals(), atol=error, err_msg=name)


def test_floats_in_both_ranges_and_orders(tmp_path):
    for i, values in enumerate([normals(), 0.5 + 0.5 * normals()]):
        np.save(tmp_path / f"{i}.npy", values.astype(np.float64))
        np.save(tmp_path / f"planes{i}.npy", values.transpose(2, 0, 1)[None])
        for name in (f"{i}.npy", f"planes{i}.npy"):
            np.testing.assert_allclose(read_normal_file(tmp_path / name), normals(), atol=1e-6)


@pytest.mark.parametrize("names", ["RGB", "XYZ"])
def test_exr_files(tmp_path, names):
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    planes = np.ascontiguousarray(normals().transpose(2, 0, 1))
    channels = dict(zip(names, planes, strict=True)) if names == "XYZ" else {"RGB": normals()}
    openexr.File(header, channels).write(str(tmp_path / "map.exr"))
    np.testing.assert_allclose(read_normal_file(tmp_path / "map.exr"), normals(), atol=1e-6)


def test_unknown_pixels(tmp_path):
    coded = np.rint(255 * (0.5 + 0.5 * normals())).astype(np.uint8)
    coded[:4] = 0  # the background
    coded[4, 0] = 128
    Image.fromarray(coded).save(tmp_path / "map.png")
    known = np.isfinite(read_normal_file(tmp_path / "map.png")).all(-1)
    assert not known[:4].any()
    assert not known[4, 0]
    assert known[4:].sum() == 19
    values = normals()
    values[0, :3] = np.nan
    values[1, :2] = 0.0
    np.save(tmp_path / "map.npy", values)
    assert np.isfinite(read_normal_file(tmp_path / "map.npy")).all(-1).sum() == 55


def test_files_that_are_no_normal_maps(tmp_path):
    photo = np.random.default_rng(0).integers(0, 255, (20, 20, 3)).astype(np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    Image.fromarray(photo[..., 0]).save(tmp_path / "grey.png")
    np.save(tmp_path / "signed.npy", photo.astype(np.int16))
    np.save(tmp_path / "long.npy", 3 * normals())
    (tmp_path / "damaged.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    for name, problem in {
        "photo.png": "its values are not normals",
        "grey.png": "three numbers per pixel",
        "signed.npy": "three numbers per pixel",
        "long.npy": "its values are not normals",
        "damaged.png": "cannot be read as a normal map",
        "missing.png": "no such normal map",
    }.items():
        with pytest.raises(UserError, match=problem) as error:
            read_normal_file(tmp_path / name)
        assert name in str(error.value)
        assert "\n" not in str(error.value)
