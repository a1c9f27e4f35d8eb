"""Rotations and rigid transforms on tensors: batched, any floating dtype, differentiable.

A rigid transform ``a_from_b`` is a (..., 3, 4) matrix [R | t] with x_a = R x_b + t; names compose
like units: ``compose_rigid(a_from_b, b_from_c)`` is ``a_from_c``. Quaternions are wxyz (Hamilton).
"""

import torch
from torch import Tensor


def rotation_from_quat(quats: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions wxyz (..., 4), which need not be normalised.

    The zero quaternion gives the identity.
    """
    w, x, y, z = quats.unbind(-1)
    # R = I + s·[…] with s = 2/|q|²: no square root, whose gradient at 0 is not finite.
    norm2 = (quats * quats).sum(-1)
    s = torch.where(norm2 > 0, 2.0 / torch.where(norm2 > 0, norm2, 1.0), 0.0)
    rows = [
        1 - s * (y * y + z * z),
        s * (x * y - w * z),
        s * (x * z + w * y),
        s * (x * y + w * z),
        1 - s * (x * x + z * z),
        s * (y * z - w * x),
        s * (x * z - w * y),
        s * (y * z + w * x),
        1 - s * (x * x + y * y),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quat_from_rotation(rotations: Tensor) -> Tensor:
    """Unit quaternions wxyz (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    The entries of 4 q qᵀ are sums of entries of R, and each row of it is a multiple of q. The row
    with the largest diagonal entry is far from zero for every rotation, so the result and its
    gradient are well conditioned everywhere, half turns included.
    """
    r = rotations.flatten(-2)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = r.unbind(-1)
    outer = torch.stack(
        [
            torch.stack([1 + r00 + r11 + r22, r21 - r12, r02 - r20, r10 - r01], -1),
            torch.stack([r21 - r12, 1 + r00 - r11 - r22, r10 + r01, r02 + r20], -1),
            torch.stack([r02 - r20, r10 + r01, 1 - r00 + r11 - r22, r21 + r12], -1),
            torch.stack([r10 - r01, r02 + r20, r21 + r12, 1 - r00 - r11 + r22], -1),
        ],
        -2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    row = torch.gather(outer, -2, index).squeeze(-2)
    quats = row / row.norm(dim=-1, keepdim=True)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def invert_rigid(a_from_b: Tensor) -> Tensor:
    """``b_from_a`` (..., 3, 4) of a rigid transform ``a_from_b`` (..., 3, 4)."""
    rotation_t = a_from_b[..., :3].transpose(-1, -2)
    return torch.cat([rotation_t, -rotation_t @ a_from_b[..., 3:]], -1)


def compose_rigid(a_from_b: Tensor, b_from_c: Tensor) -> Tensor:
    """``a_from_c`` (..., 3, 4): first ``b_from_c``, then ``a_from_b``."""
    product = a_from_b[..., :3] @ b_from_c
    return torch.cat([product[..., :3], product[..., 3:] + a_from_b[..., 3:]], -1)


def transform_points(a_from_b: Tensor, points: Tensor) -> Tensor:
    """Points (..., P, 3) of frame b, in frame a; ``a_from_b`` is (..., 3, 4)."""
    return points @ a_from_b[..., :3].transpose(-1, -2) + a_from_b[..., 3].unsqueeze(-2)


def look_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """``cam_from_world`` (..., 3, 4) of a camera at ``position`` that looks at ``target``.

    OpenCV axes: x right, y down, z forward; ``up`` (world) points to the picture's upper edge. All
    arguments are (..., 3). Where ``up`` is along the line of sight, another up direction is taken.

    Raises:
        ValueError: position and target are the same point.
    """
    forward = target - position
    distance = forward.norm(dim=-1, keepdim=True)
    if bool((distance == 0).any()):
        raise ValueError("look_at: position and target are the same point")
    forward = forward / distance
    up = up.expand_as(forward)
    right = torch.linalg.cross(forward, up)
    # Any axis that is not along the line of sight does: the one in which forward is smallest.
    spare = torch.zeros_like(forward).scatter(-1, forward.abs().argmin(-1, keepdim=True), 1.0)
    degenerate = right.norm(dim=-1, keepdim=True) < 1e-6 * up.norm(dim=-1, keepdim=True)
    right = torch.where(degenerate, torch.linalg.cross(forward, spare), right)
    right = right / right.norm(dim=-1, keepdim=True)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], -2)
    return torch.cat([rotation, -rotation @ position.unsqueeze(-1)], -1)
