"""`.splat`: the bytes of a Gaussian, the order of the rows, the precision of each field."""

import struct

import pytest
import torch

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.scene.gaussians import SH_C0, Gaussians


def importance(g: Gaussians) -> torch.Tensor:
    return g.log_scales.double().sum(1) + g.opacities.double().log()


def test_the_32_bytes_of_a_gaussian(tmp_path):
    gaussians = Gaussians(
        torch.tensor([[1.5, -2.0, 3.25]]),
        torch.tensor([[0.5, 0.25, 2.0]]).log(),
        torch.tensor([[-1.0, 0.0, 1.0, 0.0]]),
        torch.zeros(1),
        torch.tensor([[[0.5 / SH_C0, -0.5 / SH_C0, 9.0]]]),
        torch.zeros(1, 0, 3),
    )
    write_gaussians(tmp_path / "a.splat", gaussians)
    data = (tmp_path / "a.splat").read_bytes()
    assert struct.unpack("<3f", data[:12]) == (1.5, -2.0, 3.25)
    assert struct.unpack("<3f", data[12:24]) == pytest.approx((0.5, 0.25, 2.0))
    half = 128 * 0.5**0.5
    assert list(data[24:]) == [255, 0, 255, 128, round(128 - half), 128, round(128 + half), 128]


def test_reading_a_row_packed_by_hand(tmp_path):
    row = struct.pack("<6f8B", 1, 2, 3, 1, 0.5, 0, 255, 128, 0, 255, 128, 128, 128, 0)
    (tmp_path / "a.splat").write_bytes(row + row[:28] + bytes([128] * 4))
    read = read_gaussians(tmp_path / "a.splat")
    assert read.means.tolist() == [[1, 2, 3]] * 2
    torch.testing.assert_close(read.scales[0], torch.tensor([1.0, 0.5, 0.0]))
    assert read.log_scales.isfinite().all()  # a disc: its third scale is 0, which has no logarithm
    assert read.rotations.tolist() == [[0, 0, 0, -1], [1, 0, 0, 0]]
    torch.testing.assert_close(read.base_colors[0], torch.tensor([1.0, 128 / 255, 0.0]))
    assert read.sh_degree == 0
    assert 0.998 < read.opacities[0] < 1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 257])
def test_round_trip_is_as_precise_as_the_bytes_allow(
    tmp_path, make_scene, rotation_error, n, degree
):
    scene = make_scene(n, degree)
    write_gaussians(tmp_path / "a.splat", scene)
    assert (tmp_path / "a.splat").stat().st_size == 32 * n
    read = read_gaussians(tmp_path / "a.splat")
    scene = scene.select(importance(scene).argsort(descending=True, stable=True))
    assert torch.equal(read.means, scene.means)
    torch.testing.assert_close(read.log_scales, scene.log_scales, rtol=1e-6, atol=1e-6)
    assert rotation_error(read, scene) < 1.5 / 128
    half_a_step = 0.51 / 255
    torch.testing.assert_close(read.opacities, scene.opacities, rtol=0, atol=half_a_step)
    colors = scene.base_colors.clamp(0, 1)
    torch.testing.assert_close(read.base_colors, colors, rtol=0, atol=half_a_step)
    assert read.sh_degree == 0  # the highest degree of the format


def test_huge_and_tiny_scales_stay_finite(tmp_path, make_scene):
    scene = make_scene(3, 0)
    scene.log_scales[0], scene.log_scales[1] = 1000, -1000
    write_gaussians(tmp_path / "a.splat", scene)
    assert len(read_gaussians(tmp_path / "a.splat")) == 3


def test_fixtures(shared):
    minimal = read_gaussians(shared / "minimal.splat")
    assert minimal.means.tolist() == [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]]
    assert len(read_gaussians(shared / "airplane.splat")) == 26_108


def test_an_invalid_size_is_reported(tmp_path, one_line):
    (tmp_path / "a.splat").write_bytes(bytes(33))
    assert "33 bytes are not a multiple of 32" in one_line(tmp_path / "a.splat")
