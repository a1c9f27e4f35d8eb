"""Changes to a finished scene: moved, cut, thinned out, put together; Gaussians in and out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.ops import reference
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import Similarity, quat_from_rotation

_DIRECTIONS = 64  # samples of the sphere; 16 would determine degree 3, more are better conditioned


def transform(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """The scene in another world frame: old frame in, new frame out.

    Everything turns with it: places, axes, and the directions from which a colour is seen.
    """
    dtype = gaussians.means.dtype
    turn = quat_from_rotation(similarity.rotation).to(dtype)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype)
    # A quaternion of no length stands for no rotation; as a factor it would stay so.
    quats = torch.where((gaussians.quats == 0).all(1, keepdim=True), identity, gaussians.quats)
    return Gaussians(
        means=similarity.apply(gaussians.means.to(torch.float64)).to(dtype),
        log_scales=gaussians.log_scales + math.log(similarity.scale),
        quats=_quat_product(turn, quats),
        opacity_logits=gaussians.opacity_logits,
        sh_dc=gaussians.sh_dc,
        sh_rest=_rotate_sh(gaussians.sh_rest, similarity.rotation),
    )


def sh_rotation(rotation: Tensor, degree: int) -> list[Tensor]:
    """For l = 1 … degree the matrix (2l+1, 2l+1) that turns SH coefficients with a rotation (3, 3).

    With c' = M c the colour seen along R d is the one that was seen along d. A rotation mixes the
    2l+1 functions of one degree among themselves only, so M_l solves Y_l(R d) M_l = Y_l(d), which
    we do over directions d spread evenly on the sphere; the basis is that of the renderer.
    """
    rotation = rotation.to(torch.float64)
    # The Fibonacci lattice: even in height, the golden angle apart in azimuth.
    index = torch.arange(_DIRECTIONS, dtype=torch.float64)
    height = 1.0 - (2.0 * index + 1.0) / _DIRECTIONS
    azimuth = index * (math.pi * (3.0 - math.sqrt(5.0)))
    radius = (1.0 - height * height).sqrt()
    directions = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), height], 1)
    before = reference.sh_basis(directions, degree)
    after = reference.sh_basis(directions @ rotation.T, degree)
    bands = [slice(level * level, (level + 1) ** 2) for level in range(1, degree + 1)]
    return [torch.linalg.lstsq(after[:, band], before[:, band]).solution for band in bands]


def crop(gaussians: Gaussians, box: Tensor) -> Gaussians:
    """Those with their centre in ``box`` (2, 3), its low and its high corner, borders included."""
    low, high = box.to(gaussians.means.dtype)
    return gaussians.select(((gaussians.means >= low) & (gaussians.means <= high)).all(1))


def decimate(gaussians: Gaussians, count: int) -> Gaussians:
    """The ``count`` most important Gaussians (all, where there are fewer), in their old order.

    Importance is opacity × the longest standard deviation. Of opacity alone, and opacity × area or
    volume and powers of them, this left the most PSNR in pictures of three trained scenes.
    """
    if count >= len(gaussians):
        return gaussians
    size = gaussians.log_scales.amax(1)
    importance = torch.nn.functional.logsigmoid(gaussians.opacity_logits) + size
    order = importance.argsort(descending=True, stable=True)
    return gaussians.select(order[:count].sort().values)


def merge(parts: Sequence[Gaussians]) -> Gaussians:
    """All rows of ``parts`` (at least one) in order, at the highest SH degree among them."""
    degree = max(part.sh_degree for part in parts)
    return Gaussians.cat([with_sh_degree(part, degree) for part in parts])


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """At SH ``degree`` 0 to 3: coefficients beyond it are dropped, missing ones are zero."""
    wanted, rest = SH_REST_COUNTS[degree], gaussians.sh_rest
    if wanted > rest.shape[1]:
        rest = torch.cat([rest, rest.new_zeros(len(rest), wanted - rest.shape[1], 3)], 1)
    values = gaussians.parameters() | {"sh_rest": rest[:, :wanted].contiguous()}
    return Gaussians(**values)


def _rotate_sh(sh_rest: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients (N, K, 3) of degree 1 on, turned."""
    degree = SH_REST_COUNTS.index(sh_rest.shape[1])
    parts, start = [], 0
    for matrix in sh_rotation(rotation, degree):
        band = sh_rest[:, start : start + len(matrix)]
        parts.append(torch.einsum("ij,njc->nic", matrix.to(sh_rest.dtype), band))
        start += len(matrix)
    return torch.cat(parts, 1) if parts else sh_rest


def _quat_product(a: Tensor, b: Tensor) -> Tensor:
    """Quaternions wxyz (..., 4): first rotates ``b``, then ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(product, -1)
