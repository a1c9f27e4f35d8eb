"""`.ksplat`: files built by the test for each level, with full and partial buckets."""

import struct

import numpy as np
import pytest
import torch

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError

BLOCK, SPAN = 5.0, 32767
LOW, HIGH = -0.75, 0.5


def section(scene: Gaussians, level: int, full: int, partial: list[int], size: int = 4) -> bytes:
    """The header (1024 bytes) and the data of one section."""
    kinds = {0: ("<f4", "<f4", "<f4"), 1: ("<u2", "<f2", "<f2"), 2: ("<u2", "<f2", "u1")}[level]
    lengths = [size] * full + partial
    bucket = np.repeat(np.arange(len(lengths)), lengths)
    means = scene.means.numpy().astype(np.float64)
    centers = np.array([means[bucket == b].mean(0) for b in range(len(lengths))]).reshape(-1, 3)
    if level:
        means = np.rint((means - centers.astype("<f4")[bucket]) * SPAN / (BLOCK / 2) + SPAN)
    rest = scene.sh_rest.numpy()
    bands = [rest[:, slice((d * d) - 1, (d + 1) ** 2 - 1)] for d in range(1, scene.sh_degree + 1)]
    flat = [band.transpose(0, 2, 1).reshape(len(scene), -1) for band in bands]
    harmonics = np.concatenate([np.zeros((len(scene), 0)), *flat], 1)
    if level == 2:
        harmonics = np.rint((harmonics - LOW) / (HIGH - LOW) * 255).clip(0, 255)
    rgba = torch.cat([scene.base_colors, scene.opacities[:, None]], 1)
    columns = [
        means.astype(kinds[0]),
        scene.scales.numpy().astype(kinds[1]),
        scene.rotations.numpy().astype(kinds[1]),
        (rgba * 255).round().clamp(0, 255).byte().numpy(),
        harmonics.astype(kinds[2]),
    ]
    rows = [b"".join(column[i].tobytes() for column in columns) for i in range(len(scene))]
    n = len(scene)
    header = struct.pack(
        "<4IfHxxIIIIH", n, n, size, len(lengths), BLOCK, 12, SPAN, 0, full, len(partial),
        scene.sh_degree,
    )  # fmt: skip
    buckets = struct.pack(f"<{len(partial)}I", *partial) + centers.astype("<f4").tobytes()
    if not level:
        header = struct.pack("<2I32xH", n, n, scene.sh_degree)
        buckets = b""
    return header.ljust(1024, b"\0") + buckets + b"".join(rows)


def ksplat(sections: list[bytes], level: int, count: int) -> bytes:
    head = struct.pack(
        "<BBxx4IHxx5f", 0, 1, len(sections), len(sections), count, count, level, 0, 0, 0, LOW, HIGH
    )
    heads, bodies = b"".join(s[:1024] for s in sections), b"".join(s[1024:] for s in sections)
    return head.ljust(4096, b"\0") + heads + bodies


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_levels_and_degrees(tmp_path, make_scene, rotation_error, level, degree):
    scene = make_scene(13, degree)
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat([section(scene, level, 2, [3, 2])], level, 13))
    read = read_gaussians(path)
    step = 0 if level == 0 else BLOCK / 2 / SPAN
    torch.testing.assert_close(read.means, scene.means, rtol=0, atol=0.51 * step + 1e-6)
    torch.testing.assert_close(read.log_scales, scene.log_scales, rtol=0, atol=1e-3)
    assert rotation_error(read, scene) < 1e-3
    torch.testing.assert_close(read.opacities, scene.opacities, rtol=0, atol=0.51 / 255)
    sh_step = (1e-6, 5e-4, 0.51 * (HIGH - LOW) / 255)[level]
    torch.testing.assert_close(
        read.sh_rest, scene.sh_rest.clamp(LOW, HIGH) if level == 2 else scene.sh_rest,
        rtol=0, atol=sh_step,
    )  # fmt: skip


def test_two_sections_of_different_degree(tmp_path, make_scene):
    a, b = make_scene(5, 1, seed=1), make_scene(4, 2, seed=2)
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat([section(a, 0, 0, []), section(b, 0, 0, [])], 0, 9))
    read = read_gaussians(path)
    assert torch.equal(read.means, torch.cat([a.means, b.means]))
    assert read.sh_degree == 2
    assert torch.equal(read.sh_rest[:5, :3], a.sh_rest)
    assert not read.sh_rest[:5, 3:].any()
    assert torch.equal(read.sh_rest[5:], b.sh_rest)


def test_a_partly_loaded_section_has_its_first_rows(tmp_path, make_scene):
    scene = make_scene(6, 0)
    data = bytearray(ksplat([section(scene, 0, 0, [])], 0, 6))
    struct.pack_into("<I", data, 4096, 2)
    (tmp_path / "a.ksplat").write_bytes(data)
    assert torch.equal(read_gaussians(tmp_path / "a.ksplat").means, scene.means[:2])


def test_no_sections_is_an_empty_scene(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(ksplat([], 0, 0))
    assert len(read_gaussians(tmp_path / "a.ksplat")) == 0


def test_fixture(shared):
    read = read_gaussians(shared / "minimal.ksplat")
    assert read.means.tolist() == [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]]
    torch.testing.assert_close(read.scales, torch.full((4, 3), 0.1))


@pytest.mark.parametrize(
    ("offset", "value"),
    [
        (4, 2**32 - 1),  # sections
        (4096, 2**32 - 1),  # Gaussians, more than the capacity
        (4100, 2**32 - 1),  # capacity
        (4108, 2**32 - 1),  # buckets
        (4096 + 32, 2**32 - 1),  # full buckets
        (4096 + 36, 2**32 - 1),  # partial buckets
        (4096 + 36, 0),
        (4096 + 40, 99),  # SH degree
        (4104, 0),  # bucket size
    ],
)
def test_inconsistent_counts_are_reported(tmp_path, make_scene, one_line, offset, value):
    data = bytearray(ksplat([section(make_scene(13, 1), 1, 2, [3, 2])], 1, 13))
    struct.pack_into("<I", data, offset, value)
    (tmp_path / "a.ksplat").write_bytes(data)
    assert "damaged" in one_line(tmp_path / "a.ksplat")


def test_other_versions_and_short_files_are_reported(tmp_path, make_scene, one_line):
    data = bytearray(ksplat([section(make_scene(13, 1), 1, 2, [3, 2])], 1, 13))
    path = tmp_path / "a.ksplat"
    path.write_bytes(data[:4000])
    assert "too short" in one_line(path)
    path.write_bytes(data[:-1])
    assert "damaged" in one_line(path)
    data[0] = 7
    path.write_bytes(data)
    assert "version 7.1" in one_line(path)
    data[0], data[20] = 0, 3
    path.write_bytes(data)
    assert "level 3" in one_line(path)


def test_ksplat_cannot_be_written(tmp_path, make_scene):
    with pytest.raises(UserError, match="selects no scene format"):
        write_gaussians(tmp_path / "a.ksplat", make_scene(1))
