"""Exchange of files with the converter of PlayCanvas, in both directions."""

import pytest
import torch

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.packing import flip_axes
from snowsplat.formats.spz import write_spz
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, rotation_from_quat

pytestmark = pytest.mark.slow  # Node is started


def assert_same(a: Gaussians, b: Gaussians, tolerance: float = 1e-5) -> None:
    assert len(a) == len(b)
    assert a.sh_degree == b.sh_degree
    torch.testing.assert_close(a.means, b.means, rtol=0, atol=tolerance)
    torch.testing.assert_close(a.log_scales, b.log_scales, rtol=0, atol=tolerance)
    torch.testing.assert_close(a.opacities, b.opacities, rtol=0, atol=1.1e-3)  # 0 and 255
    torch.testing.assert_close(a.sh_dc, b.sh_dc, rtol=0, atol=tolerance)
    torch.testing.assert_close(a.sh_rest, b.sh_rest, rtol=0, atol=tolerance)
    cosine = (a.rotations * b.rotations).sum(1).abs()
    # splat-transform reads the bytes of a quaternion in .splat as 127.5 + 127.5 q.
    assert (1 - cosine).max() < 1e-4


def as_it_reads_spz(scene: Gaussians) -> Gaussians:
    """The scene as splat-transform reads it from an .spz file: it does not convert the frame."""
    return flip_axes(GaussianArrays.from_gaussians(scene)).to_gaussians()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splat_transform_reads_what_we_write(tmp_path, make_scene, splat_transform, degree):
    scene = make_scene(700, degree)
    for name in ("a.ply", "a.compressed.ply", "a.splat"):
        write_gaussians(tmp_path / name, scene)
        splat_transform(tmp_path / name, tmp_path / "back.ply")
        assert_same(read_gaussians(tmp_path / "back.ply"), read_gaussians(tmp_path / name))
    for version in (2, 3, 4):
        write_spz(tmp_path / "a.spz", GaussianArrays.from_gaussians(scene), version)
        splat_transform(tmp_path / "a.spz", tmp_path / "back.ply")
        ours = as_it_reads_spz(read_gaussians(tmp_path / "a.spz"))
        assert_same(read_gaussians(tmp_path / "back.ply"), ours)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_we_read_what_splat_transform_writes(tmp_path, make_scene, splat_transform, degree):
    write_gaussians(tmp_path / "a.ply", make_scene(700, degree))
    splat_transform(tmp_path / "a.ply", tmp_path / "a.compressed.ply")
    splat_transform(tmp_path / "a.compressed.ply", tmp_path / "back.ply")
    assert_same(
        read_gaussians(tmp_path / "a.compressed.ply"), read_gaussians(tmp_path / "back.ply")
    )
    for version in ("3", "4"):
        splat_transform(tmp_path / "a.ply", tmp_path / "a.spz", "--spz-version", version)
        splat_transform(tmp_path / "a.spz", tmp_path / "back.ply")
        ours = as_it_reads_spz(read_gaussians(tmp_path / "a.spz"))
        assert_same(ours, read_gaussians(tmp_path / "back.ply"))


def test_splat_transform_and_snowsplat_read_the_same_from_fixtures(
    tmp_path, shared, splat_transform
):
    for name in ("minimal.splat", "minimal.ksplat", "guitar.compressed.ply"):
        splat_transform(shared / name, tmp_path / "back.ply")
        assert_same(read_gaussians(shared / name), read_gaussians(tmp_path / "back.ply"))
    for name in ("minimal-v2.spz", "minimal-v3.spz", "minimal-v4.spz"):
        splat_transform(shared / name, tmp_path / "back.ply")
        ours = as_it_reads_spz(read_gaussians(shared / name))
        assert_same(ours, read_gaussians(tmp_path / "back.ply"))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splat_transform_reads_our_sog(tmp_path, make_scene, splat_transform, degree):
    write_gaussians(tmp_path / "a.sog", make_scene(300, degree))
    splat_transform(tmp_path / "a.sog", tmp_path / "back.ply")
    assert_same(read_gaussians(tmp_path / "back.ply"), read_gaussians(tmp_path / "a.sog"))


@pytest.mark.parametrize("degree", [0, 3])
def test_we_read_a_sog_of_splat_transform(tmp_path, make_scene, splat_transform, degree):
    """The scene is just large enough for more values than a codebook has entries."""
    write_gaussians(tmp_path / "a.ply", make_scene(100, degree))
    flags = ("--gpu", "cpu", "--max-workers", "0")
    splat_transform(tmp_path / "a.ply", tmp_path / "a.sog", *flags)
    splat_transform(tmp_path / "a.sog", tmp_path / "back.ply")
    assert_same(read_gaussians(tmp_path / "a.sog"), read_gaussians(tmp_path / "back.ply"))
    folder = tmp_path / "folder"
    folder.mkdir()
    splat_transform(tmp_path / "a.ply", folder / "meta.json", *flags)
    splat_transform(folder / "meta.json", tmp_path / "back.ply")
    assert_same(read_gaussians(folder / "meta.json"), read_gaussians(tmp_path / "back.ply"))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_we_read_a_glb_of_splat_transform(tmp_path, make_scene, splat_transform, degree):
    """splat-transform rotates a PLY by 180° about z, snowsplat by 180° about x.

    The difference is a rotation by 180° about the vertical axis.
    """
    scene = make_scene(300, degree)
    write_gaussians(tmp_path / "a.ply", scene)
    splat_transform(tmp_path / "a.ply", tmp_path / "a.glb")
    half = Similarity(1.0, torch.diag(torch.tensor([-1.0, 1.0, -1.0])), torch.zeros(3))
    read = transform(read_gaussians(tmp_path / "a.glb"), half)
    # The axes of an ellipsoid have no sign.
    axes = rotation_from_quat(read.quats).mT @ rotation_from_quat(scene.quats)
    torch.testing.assert_close(axes.abs(), torch.eye(3).expand(300, 3, 3), rtol=0, atol=1e-5)
    read.quats = scene.quats
    assert_same(read, scene)
