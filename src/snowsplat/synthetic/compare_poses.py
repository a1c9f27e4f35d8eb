"""Errors of estimated poses; estimated and true poses are aligned by a similarity transform."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.geometry import invert_rigid, similarity_from_points


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated poses after their camera centres were aligned with the true ones."""

    names: list[str]  # photos with both poses; the errors are in this order
    missing: list[str]  # photos without an estimated pose
    rotations: Tensor  # (N,) degrees, angle between the estimated and the true rotation
    centres: Tensor  # (N,) distance between the camera centres, as a fraction of ``extent``
    extent: float  # largest distance between two true centres, in their unit


def compare_poses(found: Mapping[str, Tensor], true: Mapping[str, Tensor]) -> PoseErrors:
    """Compare poses by name; each is a ``cam_from_world`` (3, 4), in two different world frames.

    Raises: ValueError: fewer than three common names, or all camera centres on one line.
    """
    names = sorted(found.keys() & true.keys())
    if len(names) < 3:
        raise ValueError(f"{len(names)} poses in common; a similarity transform needs three")
    found_poses = torch.stack([found[name].double() for name in names])
    true_poses = torch.stack([true[name].double() for name in names])
    true_centres = invert_rigid(true_poses)[..., 3]
    similarity = similarity_from_points(invert_rigid(found_poses)[..., 3], true_centres)
    aligned = similarity.apply_to_poses(found_poses)
    extent = float(torch.cdist(true_centres, true_centres).max())
    distances = (invert_rigid(aligned)[..., 3] - true_centres).norm(dim=1)
    missing = sorted(true.keys() - found.keys())
    # |A − B| (Frobenius) is 2√2 sin(θ/2). The arccosine of the trace would lose half the digits.
    sine = (aligned[..., :3] - true_poses[..., :3]).flatten(1).norm(dim=1) / 8**0.5
    rotations = 2 * torch.rad2deg(torch.asin(sine.clamp(max=1.0)))
    return PoseErrors(names, missing, rotations, distances / extent, extent)
