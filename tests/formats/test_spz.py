"""`.spz`: bytes packed by hand in every version, frames, precision, false declarations."""

import gzip
import logging
import struct

import pytest
import torch
import zstandard

from snowsplat.formats import format_for_reading, read_gaussians, write_gaussians
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.spz import spz_version, write_spz
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import rotation_from_quat


def head(version: int, count: int, degree: int, bits: int = 12, flags: int = 0, streams: int = 0):
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, flags, streams)


def version_4(
    columns: list[bytes], count: int, degree: int, flags: int = 0, extensions: bytes = b""
) -> bytes:
    packed = [zstandard.compress(column) for column in columns]
    table = 32 + len(extensions)
    start = head(4, count, degree, 12, flags, len(columns)) + struct.pack("<I12x", table)
    sizes = [struct.pack("<QQ", len(p), len(c)) for p, c in zip(packed, columns, strict=True)]
    return start + extensions + b"".join(sizes) + b"".join(packed)


#: One Gaussian of degree 1 at (1, −2, 0.5) in the file's frame, 12 fractional bits.
POSITION = struct.pack("<i", 4096)[:3] + struct.pack("<i", -8192)[:3] + struct.pack("<i", 2048)[:3]
# x is largest (0), then −1/√2 · 511/511 for y: sign 1, 511; z and w are 0.
ROTATION = struct.pack("<I", 0 << 30 | (1 << 9 | 511) << 20)
COLUMNS = [
    POSITION, bytes([51]), bytes([128, 166, 0]), bytes([160, 144, 128]), ROTATION,
    bytes([128, 192, 64, 0, 144, 128, 136, 120, 128]),
]  # fmt: skip


def check_the_one(read: Gaussians) -> None:
    """Compare with the content of `COLUMNS` in the frame of a PLY: y and z change their signs."""
    torch.testing.assert_close(read.means, torch.tensor([[1.0, 2.0, -0.5]]))
    torch.testing.assert_close(read.opacities, torch.tensor([0.2]))
    dc = torch.tensor([[[0.5, 38.5, -127.5]]]) / 38.25
    torch.testing.assert_close(read.sh_dc, dc)
    torch.testing.assert_close(read.log_scales, torch.tensor([[0.0, -1.0, -2.0]]))
    # x and −y are equal; the conversion of the frame changes the signs of y and z.
    q = torch.tensor([[0.0, 0.5**0.5, 0.5**0.5, 0.0]])
    torch.testing.assert_close(read.rotations, q, rtol=0, atol=1e-6)
    # The coefficients of degree 1 belong to y, z, x.
    sh = torch.tensor([[0, 0.5, -0.5], [-1, 0.125, 0], [0.0625, -0.0625, 0]])
    torch.testing.assert_close(read.sh_rest[0], sh * torch.tensor([[-1.0], [-1.0], [1.0]]))


def test_one_gaussian_by_hand_in_versions_3_and_4(tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(head(3, 1, 1) + b"".join(COLUMNS)))
    check_the_one(read_gaussians(path))
    path.write_bytes(version_4(COLUMNS, 1, 1))
    check_the_one(read_gaussians(path))


def test_version_2_has_three_bytes_of_rotation_and_may_be_uncompressed(tmp_path):
    q = bytes([128 + 90, 127 - 90, 128])  # 90.5 / 127.5 is nearly 1/√2
    body = head(2, 1, 1) + b"".join([*COLUMNS[:4], q, COLUMNS[5]])
    for data in (gzip.compress(body), body):
        (tmp_path / "a.spz").write_bytes(data)
        read = read_gaussians(tmp_path / "a.spz")
        read.quats[0, 0] = read.quats[0, 3] = 0  # up to the precision of a byte
        assert (read.rotations[0, 1:3] - 0.5**0.5).abs().max() < 0.01
        read.quats = torch.tensor([[0.0, 1.0, 1.0, 0.0]])
        check_the_one(read)


def test_rotations_written_in_three_bytes(tmp_path, make_scene):
    scene = make_scene(1, 0)
    # (0.8 i + 0.6 j) i = −0.8 − 0.6 k, and −q is the same rotation as q. In the frame of the file,
    # z has the other sign.
    scene.quats[0] = torch.tensor([0.0, 0.8, 0.6, 0.0])
    write_spz(tmp_path / "a.spz", GaussianArrays.from_gaussians(scene), 2)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert data[4] == 2
    assert len(data) == 16 + 9 + 1 + 3 + 3 + 3
    assert list(data[-3:]) == [128, 128, round(127.5 - 127.5 * 0.6)]
    expected = torch.tensor([0.8, 0.0, 0.0, 0.6])
    read = read_gaussians(tmp_path / "a.spz").rotations[0]
    torch.testing.assert_close(read, expected, rtol=0, atol=0.005)


def test_three_bytes_of_rotation_determine_w(tmp_path):
    q = bytes([204, 128, 127])  # x is 0.6, so w is 0.8; y and z are nearly 0
    body = head(2, 1, 1) + b"".join([*COLUMNS[:4], q, COLUMNS[5]])
    (tmp_path / "a.spz").write_bytes(body)
    rotation = read_gaussians(tmp_path / "a.spz").rotations[0]
    torch.testing.assert_close(rotation, torch.tensor([0.8, 0.6, 0, 0]), rtol=0, atol=0.005)


def test_version_1_has_positions_as_halves(tmp_path):
    q = bytes([128 + 90, 127 - 90, 128])
    halves = struct.pack("<3e", 1, -2, 0.5)
    (tmp_path / "a.spz").write_bytes(
        gzip.compress(head(1, 1, 1) + b"".join([halves, *COLUMNS[1:4], q, COLUMNS[5]]))
    )
    read = read_gaussians(tmp_path / "a.spz")
    read.quats = torch.tensor([[0.0, 1.0, 1.0, 0.0]])
    check_the_one(read)


@pytest.mark.parametrize("version", [3, 4])
def test_written_bytes(tmp_path, version):
    path = tmp_path / "a.spz"
    path.write_bytes(version_4(COLUMNS, 1, 1))
    write_spz(path, GaussianArrays.from_gaussians(read_gaussians(path)), version)
    data = path.read_bytes()
    if version == 3:
        data = gzip.decompress(data)
        assert data[:16] == head(3, 1, 1, bits=14)
        columns, start = [], 16
        for column in COLUMNS:
            columns.append(data[start : start + len(column)])
            start += len(column)
        assert start == len(data)
    else:
        assert data[:32] == head(4, 1, 1, 14, 0, 6) + struct.pack("<I12x", 32)
        columns, start = [], 32 + 6 * 16
        for i in range(6):
            size, unpacked = struct.unpack_from("<QQ", data, 32 + 16 * i)
            columns.append(zstandard.decompress(data[start : start + size]))
            assert len(columns[-1]) == unpacked
            start += size
        assert start == len(data)
    # 14 fractional bits, not 12: the scene is small.
    position = b"".join(struct.pack("<i", 4 * v)[:3] for v in (4096, -8192, 2048))
    assert columns[:4] == [position, *COLUMNS[1:4]]
    # Which of two equal entries is the larger one depends on rounding; the rotation is the same.
    assert columns[5] == COLUMNS[5]
    check_the_one(read_gaussians(path))


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 257])
def test_round_trip_is_as_precise_as_the_bytes_allow(
    tmp_path, make_scene, rotation_error, n, degree, version
):
    scene = make_scene(n, degree)
    write_spz(tmp_path / "a.spz", GaussianArrays.from_gaussians(scene), version)
    read = read_gaussians(tmp_path / "a.spz")
    assert read.sh_degree == degree
    assert spz_version(tmp_path / "a.spz") == str(version)
    torch.testing.assert_close(read.means, scene.means, rtol=0, atol=0.51 / 4096)
    torch.testing.assert_close(
        read.log_scales, scene.log_scales.clamp(-10, 5.94), rtol=0, atol=0.51 / 16
    )
    if version > 2:
        assert rotation_error(read, scene) < 0.004
    else:  # the axes of a Gaussian are the same, but two may point to the other side
        a, b = rotation_from_quat(read.rotations), rotation_from_quat(scene.rotations)
        cosines = a.transpose(1, 2) @ b
        torch.testing.assert_close(cosines.abs(), torch.eye(3).expand(n, 3, 3), rtol=0, atol=0.02)
    torch.testing.assert_close(read.opacities, scene.opacities, rtol=0, atol=0.51 / 255)
    torch.testing.assert_close(
        read.sh_dc, scene.sh_dc.clamp(-127.5 / 38.25, 127.5 / 38.25), rtol=0, atol=0.51 / 38.25
    )
    sh = scene.sh_rest
    torch.testing.assert_close(read.sh_rest[:, :3], sh[:, :3], rtol=0, atol=1.6 / 128)
    torch.testing.assert_close(read.sh_rest[:, 3:], sh[:, 3:], rtol=0, atol=2.6 / 128)


def test_a_second_round_trip_changes_nothing(tmp_path, make_scene):
    write_gaussians(tmp_path / "a.spz", make_scene(300, 3))
    once = read_gaussians(tmp_path / "a.spz")
    write_gaussians(tmp_path / "b.spz", once)
    twice = read_gaussians(tmp_path / "b.spz")
    for name, tensor in once.parameters().items():
        if name != "quats":  # two of its entries may be equally large
            assert torch.equal(twice.parameters()[name], tensor), name


@pytest.mark.parametrize("size", [1e-3, 1.0, 3000.0, 1e6])
def test_positions_keep_their_precision_in_scenes_of_any_size(tmp_path, make_scene, size):
    scene = make_scene(300, 0)
    scene.means.mul_(size)
    write_gaussians(tmp_path / "a.spz", scene)
    read = read_gaussians(tmp_path / "a.spz")
    assert (read.means - scene.means).abs().max() < size * 2e-4


def test_one_stray_gaussian_does_not_cost_the_others_their_precision(tmp_path, make_scene, caplog):
    scene = make_scene(300, 0)
    scene.means[7] = torch.tensor([0.0, 1e9, 0.0])
    with caplog.at_level(logging.WARNING):
        write_gaussians(tmp_path / "a.spz", scene)
    assert "cut to the range of SPZ: positions of 1 (at most 4096)" in caplog.text
    read = read_gaussians(tmp_path / "a.spz")
    assert read.means[7, 1] > 4000
    scene.means[7] = read.means[7]
    assert (read.means - scene.means).abs().max() < 1e-3


def test_degree_4_is_read_as_3_with_a_warning(tmp_path, caplog):
    columns = [*COLUMNS[:5], bytes(range(72))]
    (tmp_path / "a.spz").write_bytes(version_4(columns, 1, 4))
    with caplog.at_level(logging.WARNING):
        read = read_gaussians(tmp_path / "a.spz")
    assert read.sh_rest.shape == (1, SH_REST_COUNTS[3], 3)
    assert "SH degree 4 is reduced to 3" in caplog.text


def test_antialiased_scenes(tmp_path, caplog):
    (tmp_path / "a.spz").write_bytes(version_4(COLUMNS, 1, 1, flags=1))
    with caplog.at_level(logging.WARNING):
        read = read_gaussians(tmp_path / "a.spz")
    check_the_one(read)
    assert read.antialiased
    assert not caplog.text


def test_a_tree_of_spark_is_named(tmp_path, one_line):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(head(2, 1, 0, flags=0x80) + bytes(25)))
    assert "a tree of levels of detail of Spark; use the file" in one_line(path)


def test_extensions_are_ignored_except_for_another_frame(tmp_path, one_line):
    path = tmp_path / "a.spz"
    other = struct.pack("<II5s", 0xADBE0002, 5, b"hello")
    path.write_bytes(version_4(COLUMNS, 1, 1, flags=2, extensions=other))
    check_the_one(read_gaussians(path))
    for number, signs in ((4, (1, -1, -1)), (6, (1, 1, 1)), (7, (-1, -1, 1)), (0, (1, -1, -1))):
        frame = struct.pack("<III", 0xADBE0003, 4, number)
        path.write_bytes(version_4(COLUMNS, 1, 1, flags=2, extensions=other + frame))
        read = read_gaussians(path)
        assert torch.equal(read.means, torch.tensor([[1.0, -2.0, 0.5]]) * torch.tensor(signs))
    swapped = struct.pack("<III", 0xADBE0003, 4, 9)
    path.write_bytes(version_4(COLUMNS, 1, 1, flags=2, extensions=swapped))
    assert "swapped" in one_line(path)


def test_fixtures(shared):
    for name in ("minimal-raw.spz", "minimal-v2.spz", "minimal-v3.spz", "minimal-v4.spz"):
        assert format_for_reading(shared / name).name == "SPZ"
        read = read_gaussians(shared / name)
        assert read.means[:, 0].tolist() == [-1, 0, -1, 0]
        assert sorted(read.means[:, 2].abs().tolist()) == [0, 0, 1, 1]
        torch.testing.assert_close(read.opacities, torch.full((4,), 230 / 255))


def test_false_counts_are_one_line_errors_without_memory(tmp_path, one_line):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(head(3, 2**32 - 1, 3) + b"".join(COLUMNS)))
    assert "declares 4294967295 Gaussians" in one_line(path)
    path.write_bytes(gzip.compress(head(3, 1000, 3) + b"".join(COLUMNS)))
    assert "damaged" in one_line(path)
    # Decompression bombs: one file unpacks to more bytes than it declares, the other declares
    # too many.
    path.write_bytes(gzip.compress(head(3, 1, 1) + b"".join(COLUMNS) + bytes(50 << 20)))
    assert "damaged" in one_line(path)
    path.write_bytes(gzip.compress(head(3, 5_000_000, 0) + bytes(100 << 20)))
    assert "declares 5000000 Gaussians" in one_line(path)
    path.write_bytes(version_4([bytes(9 << 20), *COLUMNS[1:]], 1, 1))
    assert "damaged" in one_line(path)
    bomb = bytearray(version_4([bytes(9 << 20), *COLUMNS[1:]], 1, 1))
    struct.pack_into(
        "<Q", bomb, 32 + 8, 9
    )  # the table declares 9 bytes, the stream has nine million
    path.write_bytes(bomb)
    assert "damaged" in one_line(path)


def test_damage_is_reported(tmp_path, make_scene, one_line):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(b"no splats at all, but gzip"))
    assert "not an .spz file" in one_line(path)
    path.write_bytes(gzip.compress(head(7, 1, 1) + b"".join(COLUMNS)))
    assert "version 7" in one_line(path)
    for version in (2, 3, 4):
        write_spz(path, GaussianArrays.from_gaussians(make_scene(50, 1)), version)
        data = path.read_bytes()
        for size in (*range(4, 140, 5), len(data) - 1):
            path.write_bytes(data[:size])
            one_line(path)
    with pytest.raises(ValueError, match="version 1"):
        write_spz(path, GaussianArrays.from_gaussians(make_scene(1)), 1)
