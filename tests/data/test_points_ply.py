"""Point clouds as PLY files: round trip, no colours, floating-point colours."""

import struct
import warnings

import numpy as np
import pytest

from snowsplat.data.points_ply import read_points, write_points
from snowsplat.util.errors import UserError


def test_points_round_trip(tmp_path):
    random = np.random.default_rng(0)
    xyz = random.normal(size=(100, 3)).astype(np.float32)
    rgb = random.integers(0, 256, (100, 3)).astype(np.uint8)
    write_points(tmp_path / "input.ply", xyz, rgb)
    again = read_points(tmp_path / "input.ply")
    np.testing.assert_array_equal(again[0], xyz)
    np.testing.assert_array_equal(again[1], rgb)
    header = (tmp_path / "input.ply").read_bytes().split(b"end_header")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]


def test_points_without_colour_or_with_float_colour(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 1\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    path = tmp_path / "points.ply"
    path.write_text(head + "end_header\n1 2 3\n")
    xyz, rgb = read_points(path)
    assert xyz.tolist() == [[1, 2, 3]]
    assert rgb.tolist() == [[128, 128, 128]]
    colors = "".join(f"property float {c}\n" for c in ("red", "green", "blue"))
    path.write_text(head + colors + "end_header\n1 2 3 0 0.5 2.0\n")
    assert read_points(path)[1].tolist() == [[0, 128, 255]]
    path.write_text(head.replace("property float z\n", "") + "end_header\n1 2\n")
    with pytest.raises(UserError, match="not a point cloud"):
        read_points(path)


def test_colours_of_any_type_become_eight_bits(tmp_path):
    """Integers are clamped to 0..255; floating-point colours are multiplied by 255 and rounded."""
    path = tmp_path / "points.ply"
    cases = {
        "uchar": ([0, 7, 255], [0, 7, 255]),
        "short": ([-3, 255, 256], [0, 255, 255]),
        "uint": ([128, 256, 4_000_000_000], [128, 255, 255]),
        "float": ([-0.1, 0.25, 1.5], [0, 64, 255]),
        "double": ([float("nan"), 0.75, 1e300], [0, 191, 255]),
    }
    for kind, (values, expected) in cases.items():
        colors = "".join(f"property {kind} {c}\n" for c in ("red", "green", "blue"))
        codes = {"uchar": "B", "short": "h", "uint": "I", "float": "f", "double": "d"}
        head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + "".join(
            f"property float {name}\n" for name in "xyz"
        )
        rows = struct.pack(f"<3f3{codes[kind]}", 1, 2, 3, *values)
        path.write_bytes((head + colors + "end_header\n").encode() + rows)
        xyz, rgb = read_points(path)
        assert (xyz.dtype, rgb.dtype) == (np.float32, np.uint8)
        assert xyz.tolist() == [[1, 2, 3]]
        assert rgb.tolist() == [expected], kind


def test_numbers_without_a_float32_are_read_without_a_warning(tmp_path):
    """Doubles stay doubles. A signalling NaN sets a flag of the processor when converted."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    head += "".join(f"property double {name}\n" for name in "xyz")
    rows = struct.pack("<2dQ", 1e300, -1e300, 0x7FF4_0000_0000_0000)
    (tmp_path / "points.ply").write_bytes((head + "end_header\n").encode() + rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        xyz, rgb = read_points(tmp_path / "points.ply")
    np.testing.assert_array_equal(xyz, [[1e300, -1e300, np.nan]])
    assert rgb.dtype == np.uint8
