"""`lift`: the photo from its own pose, a second viewpoint, unknown depths, fewer Gaussians."""

from dataclasses import replace

import pytest
import torch

from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.lift.blocks import merge_pixels, pixel_blocks
from snowsplat.extras.lift.lift import lift, with_colors
from snowsplat.extras.lift.options import LiftOptions
from snowsplat.extras.lift.surface import find_links
from snowsplat.scene.render import render


@pytest.fixture(scope="module")
def lifted(shots):
    first = shots[0]
    return lift(first.photo, first.depth, first.camera)


def seen(gaussians, shot):
    with torch.no_grad():
        output = render(gaussians, shot.camera, with_depth=True)
    return output.image, output.alpha, output.depth / output.alpha.clamp_min(1e-6)


def test_the_photo_from_its_own_pose(lifted, shots):
    image, alpha, _ = seen(lifted, shots[0])
    assert len(lifted) == shots[0].photo.shape[0] * shots[0].photo.shape[1]
    assert lifted.sh_degree == 0
    assert psnr(image.clamp(0, 1), shots[0].photo) > 36
    assert float(alpha.min()) > 0.9


def test_a_second_viewpoint(lifted, shots):
    image, alpha, depth = seen(lifted, shots[1])
    covered = alpha > 0.5
    assert 0.8 < float(covered.float().mean()) < 0.99  # the rest is hidden in the first photo
    assert psnr(image.clamp(0, 1), shots[1].photo, covered) > 26
    errors = (depth / shots[1].depth - 1).abs()[covered]
    assert float((errors < 0.02).float().mean()) > 0.95


def wrong(gaussians, shot) -> float:
    """The share of the covered pixels in which there is a surface where nothing is."""
    _, alpha, depth = seen(gaussians, shot)
    return float(((depth / shot.depth - 1).abs() > 0.05)[alpha > 0.5].float().mean())


def test_no_surface_is_where_nothing_is(lifted, shots):
    assert wrong(lifted, shots[1]) < 0.03


def test_a_blurred_depth_map_has_no_pixels_between_the_surfaces(shots):
    """As maps of networks. Without the cut, these pixels are a spray behind each outline."""
    first, second = shots
    padded = torch.nn.functional.pad(first.depth[None, None], [2] * 4, mode="replicate")
    blurred = padded[0, 0].unfold(0, 5, 1).unfold(1, 5, 1).mean((2, 3))
    cut = lift(first.photo, blurred, first.camera)
    uncut = lift(first.photo, blurred, first.camera, LiftOptions(edge=1e9))
    assert wrong(cut, second) < 0.5 * wrong(uncut, second)


def test_pixels_of_unknown_depth_have_no_gaussians(shots):
    first = shots[0]
    depth = first.depth.clone()
    depth[:40, :50] = torch.nan
    depth[40:60, :50] = 0.0
    gaussians = lift(first.photo, depth, first.camera)
    assert len(gaussians) == depth.numel() - 60 * 50
    image, alpha, _ = seen(gaussians, first)
    assert float(alpha[:55, :45].max()) < 0.01
    assert psnr(image[:, 55:].clamp(0, 1), first.photo[:, 55:]) > 36


def test_fewer_gaussians_and_a_better_image_with_more_of_them(shots):
    first, _ = shots
    found = []
    for most in (2000, 6000):
        gaussians = lift(first.photo, first.depth, first.camera, LiftOptions(max_gaussians=most))
        assert 0.9 * most < len(gaussians) <= most
        image, alpha, _ = seen(gaussians, first)
        assert float(alpha[2:-2, 2:-2].min()) > 0.8
        found.append(psnr(image.clamp(0, 1), first.photo))
    assert 25 < found[0] < found[1] - 2


def test_colours_are_corrected_for_the_overlap(lifted, shots):
    """The colours of the photo themselves give a blurred image."""
    first = shots[0]
    pixels, _ = first.camera.project(lifted.means.double())
    column, row = pixels.floor().long().unbind(1)
    blurred, _, _ = seen(with_colors(lifted, first.photo[row, column]), first)
    image, _, _ = seen(lifted, first)
    assert psnr(image.clamp(0, 1), first.photo) > psnr(blurred.clamp(0, 1), first.photo) + 4


def test_sizes_must_match_and_a_depth_must_be_known(shots):
    first = shots[0]
    with pytest.raises(ValueError, match="must be equal"):
        lift(first.photo, first.depth[:-1], first.camera)
    with pytest.raises(ValueError, match="must be equal"):
        lift(first.photo, first.depth, replace(first.camera, width=100))
    with pytest.raises(ValueError, match="no pixel has a known depth"):
        lift(first.photo, torch.full_like(first.depth, torch.nan), first.camera)


def merged(depth, photo, most):
    return merge_pixels(depth, photo, find_links(depth), most)


def test_a_uniform_photo_becomes_large_blocks():
    blocks = merged(torch.full((40, 50), 2.0), torch.full((40, 50, 3), 0.5), 100)
    # 6 blocks of 16 pixels; the rest of the photo is not a multiple of 16.
    assert int((blocks.size == 16).sum()) == 6
    assert len(blocks) <= 100
    assert float(blocks.size.square().sum()) == 40 * 50


def test_blocks_are_disjoint_and_their_size_is_their_width():
    torch.manual_seed(0)
    depth = torch.full((37, 29), 2.0)
    depth[5:9, 3:20] = torch.nan
    blocks = merged(depth, torch.rand(37, 29, 3), 400)
    assert torch.equal(blocks.owner < 0, depth.isnan())
    counts = torch.bincount(blocks.owner[blocks.owner >= 0], minlength=len(blocks))
    assert torch.equal(counts.float(), blocks.size.square())
    assert 300 < len(blocks) <= 400


def test_no_block_contains_a_discontinuity():
    depth = torch.full((32, 32), 2.0)
    depth[:, 13:] = 3.0
    blocks = merged(depth, torch.full((32, 32, 3), 0.5), 200)
    near = set(blocks.owner[:, :13].flatten().tolist())
    assert not near & set(blocks.owner[:, 13:].flatten().tolist())


def test_blocks_are_small_where_there_is_detail():
    torch.manual_seed(0)
    photo = torch.full((32, 64, 3), 0.5)
    photo[:, 32:] = torch.rand(32, 32, 3)
    blocks = merged(torch.full((32, 64), 2.0), photo, 600)
    sizes = blocks.size[blocks.owner]
    assert float(sizes[:, :32].min()) == 16
    assert float(sizes[:, 32:].mean()) < 3


def test_a_curved_surface_is_divided_and_a_plane_is_not():
    x = torch.arange(64).float() / 64
    flat = (1 / (1 + 0.3 * x)).expand(16, 64)  # disparity is linear on a plane
    curved = (1 / (1 + 0.3 * (x - 0.5).abs())).expand(16, 64)
    photo = torch.full((16, 64, 3), 0.5)
    depth = torch.cat([flat, curved.clone()])
    depth[16:, :32], depth[16:, 32:] = curved[:, :32], curved[:, 32:]
    bent = 1 + 0.1 * torch.sin(x * 60).expand(16, 64)
    blocks = merged(torch.cat([flat, bent]), torch.cat([photo, photo]), 200)
    sizes = blocks.size[blocks.owner]
    assert float(sizes[:16].mean()) == 16
    assert float(sizes[16:].mean()) < 8


def test_means_and_a_block_per_pixel():
    known = torch.ones(3, 4, dtype=torch.bool)
    known[1, 2] = False
    blocks = pixel_blocks(known)
    values = torch.rand(3, 4, 2)
    torch.testing.assert_close(blocks.mean(values), values[known])
    depth, photo = torch.full((16, 16), 2.0), torch.full((16, 16, 3), 0.5)
    values = torch.rand(16, 16)
    torch.testing.assert_close(merged(depth, photo, 1).mean(values), values.mean()[None])
    assert len(merged(depth, photo, 256)) == 256  # no merging is needed
