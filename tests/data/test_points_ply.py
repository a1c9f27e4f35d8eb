"""Point clouds as PLY files: round trip, no colours, floating-point colours."""

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
