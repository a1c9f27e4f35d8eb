"""Merging pixels: blocks are disjoint, within one surface, and small where there is detail."""

from __future__ import annotations

import torch

from snowsplat.extras.lift.blocks import merge_pixels, pixel_blocks
from snowsplat.extras.lift.surface import find_links


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
