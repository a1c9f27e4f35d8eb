"""Editing: transformed scenes look the same; crop and merge select the right rows."""

import math

import pytest
import torch

from snowsplat.ops import reference
from snowsplat.scene import edit
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.scene.render import render

from ..gaussians import normal_gaussians


def random_gaussians(n: int, degree: int, seed: int = 0, dtype=torch.float64) -> Gaussians:
    found = normal_gaussians(n, degree, seed, dtype)
    found.means *= 0.5
    found.log_scales.mul_(0.4).sub_(2.0)
    found.sh_rest *= 0.3
    return found


def random_similarity(seed: int) -> Similarity:
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(4, generator=generator, dtype=torch.float64)
    shift = torch.randn(3, generator=generator, dtype=torch.float64)
    return Similarity(0.3 + seed, rotation_from_quat(quat), shift)


def colors(gaussians: Gaussians, directions: torch.Tensor) -> torch.Tensor:
    """(N, M, 3) colours along directions (M, 3), before they are clamped."""
    basis = reference.sh_basis(directions, gaussians.sh_degree)
    coefficients = torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1)
    return 0.5 + torch.einsum("mk,nkc->nmc", basis, coefficients)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_colours_rotate_with_the_scene(degree, seed):
    gaussians, similarity = random_gaussians(20, degree), random_similarity(seed)
    moved = edit.transform(gaussians, similarity)
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    )
    after = colors(moved, directions @ similarity.rotation.T)
    torch.testing.assert_close(after, colors(gaussians, directions), rtol=0, atol=1e-9)


def test_sh_rotations_are_orthogonal_and_compose():
    a, b = (random_similarity(seed).rotation for seed in (3, 4))
    pairs = zip(edit.sh_rotation(a, 3), edit.sh_rotation(b, 3), strict=True)
    for (one, two), both in zip(pairs, edit.sh_rotation(a @ b, 3), strict=True):
        torch.testing.assert_close(one @ one.T, torch.eye(len(one)).double(), rtol=0, atol=1e-12)
        torch.testing.assert_close(one @ two, both, rtol=0, atol=1e-12)
    # A quarter turn around z maps x to y. The order of the functions of degree 1 is (-y, z, -x).
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).double()
    torch.testing.assert_close(edit.sh_rotation(quarter, 1)[0], expected, rtol=0, atol=1e-12)


def test_covariances_rotate_and_scale_with_the_scene():
    gaussians, similarity = random_gaussians(30, 1), random_similarity(2)
    gaussians.quats[3] = 0.0  # means the identity

    def covariances(of: Gaussians) -> torch.Tensor:
        axes = rotation_from_quat(of.quats) * of.scales[:, None, :]
        return axes @ axes.transpose(1, 2)

    moved = edit.transform(gaussians, similarity)
    full = similarity.scale * similarity.rotation
    torch.testing.assert_close(covariances(moved), full @ covariances(gaussians) @ full.T)
    torch.testing.assert_close(moved.means, similarity.apply(gaussians.means))
    back = edit.transform(moved, similarity.inverse())
    torch.testing.assert_close(back.means, gaussians.means)
    torch.testing.assert_close(back.sh_rest, gaussians.sh_rest)
    torch.testing.assert_close(back.log_scales, gaussians.log_scales)


def test_a_moved_scene_renders_the_same_from_a_moved_camera():
    gaussians = random_gaussians(300, 3, dtype=torch.float32)
    similarity = random_similarity(1)
    pose = look_at(torch.tensor([0.2, -0.4, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)
    moved_camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, similarity.apply_to_poses(pose))
    before = render(gaussians, camera).image
    after = render(edit.transform(gaussians, similarity), moved_camera).image
    assert float(before.std()) > 0.05
    # The tolerance is for the low-pass filter of the renderer. Its size is in pixels, so the
    # similarity does not scale it.
    torch.testing.assert_close(after, before, rtol=0, atol=2e-3)


def test_crop():
    gaussians = random_gaussians(500, 1)
    box = torch.tensor([[-0.3, -1.0, 0.0], [0.4, 1.0, 0.5]])
    kept = edit.crop(gaussians, box)
    inside = ((gaussians.means >= box[0]) & (gaussians.means <= box[1])).all(1)
    assert 0 < len(kept) == int(inside.sum()) < 500
    torch.testing.assert_close(kept.sh_rest, gaussians.sh_rest[inside])


def test_merge_raises_the_degree():
    low, high = random_gaussians(3, 0), random_gaussians(4, 2, seed=1)
    both = edit.merge([low, high])
    assert (len(both), both.sh_degree) == (7, 2)
    assert not both.sh_rest[:3].any()
    torch.testing.assert_close(both.sh_rest[3:], high.sh_rest)
    assert len(edit.merge([low])) == 3


@pytest.mark.parametrize("before", range(4))
def test_with_sh_degree_changes_only_higher_coefficients(before):
    gaussians = random_gaussians(5, before)
    for degree in range(4):
        changed = edit.with_sh_degree(gaussians, degree)
        assert changed.sh_degree == degree
        same = min(SH_REST_COUNTS[degree], SH_REST_COUNTS[before])
        torch.testing.assert_close(changed.sh_rest[:, :same], gaussians.sh_rest[:, :same])
        assert not changed.sh_rest[:, same:].any()
    assert len(edit.with_sh_degree(gaussians.select(torch.zeros(0).long()), 3)) == 0


def test_transform_of_no_gaussians_and_rotation_by_half_a_turn():
    none = random_gaussians(0, 3)
    assert len(edit.transform(none, random_similarity(1))) == 0
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    signs = [torch.diagonal(m) for m in edit.sh_rotation(half, 3)]
    orders = [abs(m) for level in (1, 2, 3) for m in range(-level, level + 1)]
    expected = torch.tensor([math.cos(math.pi * m) for m in orders]).double()
    torch.testing.assert_close(torch.cat(signs), expected, rtol=0, atol=1e-12)
