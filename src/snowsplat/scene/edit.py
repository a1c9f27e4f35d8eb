"""Editing a scene: transform, crop, merge. The input Gaussians are not modified."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from snowsplat.ops import reference
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import Similarity, quat_from_rotation, quat_product
from snowsplat.scene.origin import HERE, Origin, origin_of
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

logger = logging.getLogger(__name__)

# Directions on the sphere for `sh_rotation`. 16 determine degree 3; more are better conditioned.
_DIRECTIONS = 64


def transform(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """The scene in a new world frame; ``similarity`` maps the old frame to the new one.

    Means, covariances and the view-dependent colours (SH) are transformed. The new frame has no
    origin in a larger one, see `transform_world` for scenes that have one.
    """
    dtype = gaussians.means.dtype
    turn = quat_from_rotation(similarity.rotation).to(dtype)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype)
    # A zero quaternion means the identity, but as a factor it would make the product zero.
    quats = torch.where((gaussians.quats == 0).all(1, keepdim=True), identity, gaussians.quats)
    return replace(
        gaussians,
        means=similarity.apply(gaussians.means.to(torch.float64)).to(dtype),
        log_scales=gaussians.log_scales + math.log(similarity.scale),
        quats=quat_product(turn, quats),
        sh_rest=_rotate_sh(gaussians.sh_rest, similarity.rotation),
        origin=HERE,
        metres_per_unit=gaussians.metres_per_unit and gaussians.metres_per_unit / similarity.scale,
    )


def transform_world(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """`transform` for positions in the world, which are the means plus the origin of the scene.

    They are computed in float64; the result has an origin if float32 would lose precision.
    Raises: UserError: the result would be larger or smaller than float32 can represent.
    """
    world = similarity.apply(_world(gaussians))
    size = float(gaussians.log_scales.median().exp()) * similarity.scale if len(world) else 0.0
    origin = origin_of(world.numpy(), size)
    means = (world - torch.tensor(origin, dtype=torch.float64)).to(gaussians.means.dtype)
    before, after = (m[gaussians.means.isfinite().all(1)] for m in (gaussians.means, means))
    shrunk = bool((before != before[:1]).any()) and not (after != after[:1]).any()
    if shrunk or not after.isfinite().all():
        raise UserError(
            "a scale of {scale:.3g} makes the scene too {size} for float32; use another one",
            scale=similarity.scale,
            size=message("small") if shrunk else message("large"),
        )
    return replace(transform(gaussians, similarity), means=means, origin=origin)


def _world(gaussians: Gaussians) -> Tensor:
    """(N, 3) float64: the positions in the world."""
    origin = torch.tensor(gaussians.origin, dtype=torch.float64)
    return gaussians.means.to(torch.float64) + origin


def seen_from(gaussians: Gaussians, origin: Origin) -> Gaussians:
    """The same Gaussians in the world, with positions relative to another origin."""
    if gaussians.origin == origin:
        return gaussians
    means = _world(gaussians) - torch.tensor(origin, dtype=torch.float64)
    return replace(gaussians, means=means.to(gaussians.means.dtype), origin=origin)


def seen_from_dataset(gaussians: Gaussians, origin: Origin | None) -> Gaussians:
    """`seen_from` the origin of the dataset with which the scene was trained; unchanged if it is
    None, not known.

    Other programs do not write the origin of a file that they save. Positions without an origin
    that are nearer to 0 than to that of the dataset are therefore relative to it already.
    """
    if origin is None:
        return gaussians
    if gaussians.origin == HERE and any(origin) and len(gaussians):
        middle = gaussians.means.detach().nanmedian(0).values.double().cpu()
        if middle.norm() < (middle - torch.tensor(origin, dtype=torch.float64)).norm():
            logger.info("the scene has no origin; its positions are relative to its dataset")
            return replace(gaussians, origin=origin)
    return seen_from(gaussians, origin)


def sh_rotation(rotation: Tensor, degree: int) -> list[Tensor]:
    """Matrices (2l+1, 2l+1) that rotate SH coefficients, for l = 1 … degree.

    With c' = M c, the new colour along direction R d is the old colour along d. A rotation mixes
    only the 2l+1 basis functions of the same degree, so M_l is the solution of
    Y_l(R d) M_l = Y_l(d). It is computed by least squares over directions d that are evenly
    distributed on the sphere. The basis Y is that of the renderer.

    ``rotation``: R, (3, 3); ``degree``: 0 to 3.
    """
    rotation = rotation.to(torch.float64)
    # The Fibonacci lattice: heights are evenly spaced, azimuths differ by the golden angle.
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
    """The Gaussians whose centre is in ``box``, including its border.

    ``box``: (2, 3) lower and upper corner in the world.
    """
    origin = torch.tensor(gaussians.origin, dtype=torch.float64)
    low, high = (box.to(torch.float64) - origin).to(gaussians.means.dtype)
    return gaussians.select(((gaussians.means >= low) & (gaussians.means <= high)).all(1))


def merge(parts: Sequence[Gaussians]) -> Gaussians:
    """All rows of ``parts`` (at least one) in order, with the highest SH degree of the parts.

    They keep their places in the world; the origin of the first part is that of all.
    A single part is returned as it is: a copy of a large scene would need much memory.
    """
    if len(parts) == 1:
        return parts[0]
    degree = max(part.sh_degree for part in parts)
    return Gaussians.cat(
        [seen_from(with_sh_degree(part, degree), parts[0].origin) for part in parts]
    )


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The Gaussians with SH ``degree`` 0 to 3: removes coefficients, or adds zeros."""
    wanted, rest = SH_REST_COUNTS[degree], gaussians.sh_rest
    if wanted > rest.shape[1]:
        rest = torch.cat([rest, rest.new_zeros(len(rest), wanted - rest.shape[1], 3)], 1)
    return replace(gaussians, sh_rest=rest[:, :wanted].contiguous())


def _rotate_sh(sh_rest: Tensor, rotation: Tensor) -> Tensor:
    """Rotated SH coefficients (N, K, 3) of degree 1 and higher."""
    degree = SH_REST_COUNTS.index(sh_rest.shape[1])
    parts, start = [], 0
    for matrix in sh_rotation(rotation, degree):
        band = sh_rest[:, start : start + len(matrix)]
        parts.append(torch.einsum("ij,njc->nic", matrix.to(sh_rest.dtype), band))
        start += len(matrix)
    return torch.cat(parts, 1) if parts else sh_rest
