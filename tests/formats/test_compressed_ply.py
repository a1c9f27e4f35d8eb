"""Compressed PLY: words packed by hand, full and partial chunks, precision."""

import struct

import numpy as np
import pytest
import torch

from snowsplat.formats import format_for_reading, read_gaussians, write_gaussians
from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.scene.geometry import morton_order

BOUNDS = [f"{e}_{k}{a}" for k in ("", "scale_") for e in ("min", "max") for a in "xyz"]
COLORS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def header(chunks: int, n: int, bounds: list[str], sh: int | None = None) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in bounds] + [f"element vertex {n}"]
    lines += [f"property uint {name}" for name in WORDS]
    if sh is not None:
        lines += [f"element sh {n}"] + [f"property uchar f_rest_{i}" for i in range(sh)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def test_one_gaussian_by_hand(tmp_path):
    chunk = struct.pack("<12f", 0, -1, 2, 2047, 1, 4, -5, -6, -7, 0, 0, 0)
    words = struct.pack(
        "<4I",
        5 << 21 | 1023 << 11 | 0,
        2 << 30 | 1023 << 20 | 0 << 10 | 1023,
        2047 << 21 | 0 << 11 | 0,
        255 << 24 | 0 << 16 | 51 << 8 | 102,
    )
    sh = bytes([0, 255, 128, *range(6)])
    path = tmp_path / "a.ply"
    path.write_bytes(header(1, 1, BOUNDS, 9) + chunk + words + sh)
    assert format_for_reading(path).name == "compressed PLY"
    read = read_gaussians(path)
    torch.testing.assert_close(read.means, torch.tensor([[5.0, 1.0, 2.0]]))
    torch.testing.assert_close(read.log_scales, torch.tensor([[0.0, -6.0, -7.0]]))
    # y is largest; w, x, z are ±1/√2, more than a unit quaternion allows.
    half = 0.5**0.5
    torch.testing.assert_close(
        read.rotations,
        torch.nn.functional.normalize(torch.tensor([[half, -half, 0, half]]), dim=1),
        rtol=0, atol=1e-6,
    )  # fmt: skip
    torch.testing.assert_close(read.opacities, torch.tensor([0.4]))
    torch.testing.assert_close(read.sh_dc[0, 0], (torch.tensor([1.0, 0.0, 0.2]) - 0.5) / SH_C0)
    # Channel-major, as in an uncompressed PLY: 0, 255 and 128 are red.
    torch.testing.assert_close(read.sh_rest[0, :, 0], torch.tensor([-4.0, 4.0, 0.5 / 32]))
    assert read.sh_rest.shape == (1, 3, 3)


def test_colours_between_the_bounds_of_their_chunk(tmp_path):
    chunk = struct.pack("<18f", *([0.0] * 12), -1, 0, 0, 1, 0.5, 2)
    words = struct.pack("<4I", 0, 0, 0, 255 << 24 | 255 << 16 | 51 << 8)
    (tmp_path / "a.ply").write_bytes(header(1, 1, BOUNDS + COLORS) + chunk + words)
    read = read_gaussians(tmp_path / "a.ply")
    torch.testing.assert_close(read.base_colors, torch.tensor([[1.0, 0.5, 0.4]]))
    assert read.sh_degree == 0


def test_an_sh_element_without_properties_is_degree_0(tmp_path, make_scene):
    path = tmp_path / "a.compressed.ply"
    write_gaussians(path, make_scene(30, 0))
    path.write_bytes(path.read_bytes().replace(b"end_header", b"element sh 30\nend_header"))
    assert read_gaussians(path).sh_degree == 0


def test_written_bytes(tmp_path):
    scene = Gaussians(
        torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 4.0]]),
        torch.tensor([[-1.0, -2.0, -3.0], [0.0, -2.0, -4.0]]),
        torch.tensor([[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0]]),
        torch.tensor([0.0, 100.0]),
        torch.tensor([[[-0.5, 0.5, 0.0]], [[0.5, 0.5, 0.0]]]) / SH_C0,
        torch.tensor([[[0.0] * 3] * 3, [[4.0, -4.0, 1.0]] * 3]),
    )
    write_gaussians(tmp_path / "a.compressed.ply", scene)
    data = (tmp_path / "a.compressed.ply").read_bytes()
    expected = header(1, 2, BOUNDS + COLORS, 9).replace(b"comment by hand\n", b"")
    assert data.startswith(expected)
    data = data[len(expected) :]
    assert struct.unpack_from("<18f", data) == pytest.approx(
        [0, 0, 0, 1, 2, 4, -1, -2, -4, 0, -2, -3, 0, 1, 0.5, 1, 1, 0.5]
    )
    words = struct.unpack_from("<8I", data, 72)
    middle = 512  # of 0 to 1023, the nearest even number to 511.5
    others = middle << 20 | middle << 10 | middle
    assert words == (
        0,
        0 << 30 | others,
        0 << 21 | 0 << 11 | 2047,
        0 << 24 | 0 << 16 | 0 << 8 | 128,
        2047 << 21 | 1023 << 11 | 2047,
        3 << 30 | others,
        2047 << 21 | 0 << 11 | 0,
        255 << 24 | 0 << 16 | 0 << 8 | 255,
    )
    assert data[72 + 32 :] == bytes([128] * 9 + [255] * 3 + [0] * 3 + [160] * 3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 256, 700])
def test_round_trip_is_as_precise_as_the_bits_allow(
    tmp_path, make_scene, rotation_error, n, degree
):
    scene = make_scene(n, degree)
    write_gaussians(tmp_path / "a.compressed.ply", scene)
    read = read_gaussians(tmp_path / "a.compressed.ply")
    assert len(read) == n
    assert read.sh_degree == degree
    scene = scene.select(morton_order(scene.means))
    for name, steps in (("means", (2047, 1023, 2047)), ("log_scales", (2047, 1023, 2047))):
        for start in range(0, n, 256):
            part, again = (getattr(g, name)[start : start + 256] for g in (scene, read))
            width = part.amax(0) - part.amin(0)
            assert ((part - again).abs() <= 0.51 * width / torch.tensor(steps) + 1e-6).all()
    assert rotation_error(read, scene) < 0.003
    torch.testing.assert_close(read.opacities, scene.opacities, rtol=0, atol=0.51 / 255)
    widest = float(scene.sh_dc.max() - scene.sh_dc.min()) if n else 0
    torch.testing.assert_close(read.sh_dc, scene.sh_dc, rtol=0, atol=0.51 * widest / 255 + 1e-6)
    torch.testing.assert_close(read.sh_rest, scene.sh_rest, rtol=0, atol=4 / 256 + 1e-6)


def test_fixture(shared):
    read = read_gaussians(shared / "guitar.compressed.ply")
    assert len(read) == 90_854
    assert all(tensor.isfinite().all() for tensor in read.parameters().values())
    low, high = np.quantile(read.means.numpy(), [0.01, 0.99], axis=0)
    assert (high - low).max() < 10


def test_damage_is_reported(tmp_path, make_scene, one_line):
    path = tmp_path / "a.ply"
    write_gaussians(tmp_path / "a.compressed.ply", make_scene(300, 1))
    data = (tmp_path / "a.compressed.ply").read_bytes()
    for size in (300, 1000, len(data) - 1):
        path.write_bytes(data[:size])
        one_line(path)
    path.write_bytes(data.replace(b"element chunk 2", b"element chunk 1"))
    assert "only 1 chunks for 300 Gaussians" in one_line(path)
    path.write_bytes(data.replace(b"element vertex 300", b"element vertex 999999999"))
    one_line(path)
    path.write_bytes(data.replace(b"uint packed_scale", b"int packed_scale"))
    assert "it has no packed_scale" in one_line(path)
    path.write_bytes(data.replace(b"min_scale_x", b"max_scalp_x"))
    assert "it has no min_scale_x" in one_line(path)
    path.write_bytes(data.replace(b"element sh 300", b"element sh 299"))
    assert "has 9 properties of 299 Gaussians" in one_line(path)
