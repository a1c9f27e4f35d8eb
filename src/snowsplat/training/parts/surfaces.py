"""`Surfaces`: flat Gaussians that lie in the surface that they show.

Photos alone are reproduced as well by a cloud of round Gaussians around a surface. Two terms make
surfaces of it, from Huang et al. 2024 (2DGS, arXiv:2403.17888) and Chen et al. 2024 (PGSR,
arXiv:2406.06521):

- Flat. The smallest scale of a Gaussian shrinks by a steady rate, down to a share of the middle
  one, like the scales of `Decay`: Adam restores it where the photos need thickness.
- Consistent. The normal n of a Gaussian is the axis of its smallest scale, towards the camera, and
  its plane has the distance δ = n · μ from the camera. Both are rendered: N = Σ T α n and
  Δ = Σ T α δ. Along the ray r with z = 1, the plane of a pixel has the depth Δ / (N · r), which
  does not depend on where in its plane the centre of a Gaussian is (PGSR, eq. 5). The normal N_d of
  this depth map should be the rendered one. The loss is the mean of w (alpha − N · N_d). The weight
  w is the cosine between N_d and the ray: the edges of the depth map look like steep surfaces.

The second term begins when most of the Gaussians are there. Its gradient reaches them through their
splats as that of the photos does, and directly through n and δ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.splats import COLORS, Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import rotation_from_quat, transform_points
from snowsplat.scene.render import RenderOutput
from snowsplat.scene.surface_normals import normals_of_depth, rays_of, surrounded
from snowsplat.training.parts.part import Part
from snowsplat.util.errors import SettingError

if TYPE_CHECKING:
    from snowsplat.training.core.batch import BatchView
    from snowsplat.training.core.run import Run
    from snowsplat.training.core.view_gradient import ViewGradient

#: The weight of the consistency, and the share of the steps after which it begins.
_WEIGHT, _FROM = 0.05, 0.4
#: Number of steps between two reductions of the smallest scale, the factor of each, and the ratio
#: to the middle scale below which there is none.
_INTERVAL, _SHRINK, _FLAT = 10, 0.97, 0.1

#: The least cosine between the rendered normal and the ray of a pixel that has a depth.
_SIDEWAYS = 0.05


class Surfaces(Part):
    """Flattens the Gaussians, and makes depths and normals consistent. It has no state."""

    name = "surfaces"

    def __init__(self) -> None:
        # The gradients of `means` and `quats` in the present step, by view.
        self._present: dict[BatchView, tuple[Tensor, Tensor]] = {}

    def prepare(self, run: Run) -> None:
        """Refuse what is not possible.

        Raises:
            SettingError: there are several processes.
        """
        if run.shards.size > 1:
            raise SettingError("surfaces", "needs all Gaussians in one process; set processes to 1")

    def between(self, run: Run) -> None:
        """Flatten in place, in every `_INTERVAL`-th step."""
        times = run.schedule.multiples(run.step, _INTERVAL)
        if times:
            scales = run.gaussians.log_scales
            smallest, middle, _ = scales.sort(dim=1).values.unbind(1)
            flat = torch.minimum(smallest, middle + math.log(_FLAT))
            flatter = torch.maximum(smallest + times * math.log(_SHRINK), flat)
            scales.scatter_(1, scales.argmin(1, keepdim=True), flatter[:, None])

    def loss(self, run: Run, view: BatchView, rendered: RenderOutput) -> Tensor | None:
        """See the module."""
        if run.step < run.schedule.step_of(_FROM):
            return None
        means = run.gaussians.means.detach().requires_grad_()
        quats = run.gaussians.quats.detach().requires_grad_()
        self._present[view] = means, quats
        splats = rendered.splats
        assert splats.ids is not None
        rows = splats.ids.clamp(min=0).long()  # on a GPU, empty rows have the id -1
        axis = run.gaussians.log_scales.argmin(1)
        planes = planes_of(means[rows], quats[rows], axis[rows], view.camera)
        return _WEIGHT * consistency(splats, planes, view.camera, run.runner.capacity)

    def gradients(
        self,
        run: Run,
        step: int,
        batch: Sequence[BatchView],
        gradients: Sequence[ViewGradient],
    ) -> None:
        """Add those of n and δ to ``.grad`` of the parameters, which the optimiser adds."""
        parameters = run.gaussians.means, run.gaussians.quats
        for leaves in self._present.values():
            for parameter, leaf in zip(parameters, leaves, strict=True):
                assert leaf.grad is not None
                found = leaf.grad / len(batch)
                parameter.grad = found if parameter.grad is None else parameter.grad + found
        self._present.clear()


def planes_of(means: Tensor, quats: Tensor, axis: Tensor, camera: Camera) -> Tensor:
    """(M, 4): the normals in the camera frame, towards the camera, and n · μ, at most 0.

    Args:
        means: (M, 3) in the world frame.
        quats: (M, 4).
        axis: (M,) int64, that of the smallest scale.
    """
    cam_from_world = camera.cam_from_world.to(means)
    index = axis[:, None, None].expand(-1, 3, 1)
    normals = rotation_from_quat(quats).gather(2, index)[..., 0]
    normals = normals @ cam_from_world[:, :3].T
    distances = (normals * transform_points(cam_from_world, means)).sum(1, keepdim=True)
    return torch.where(distances > 0, -1.0, 1.0) * torch.cat([normals, distances], dim=1)


def consistency(
    splats: Splats2D, planes: Tensor, camera: Camera, capacity: Capacity | None = None
) -> Tensor:
    """The mean () of w (alpha − N · N_d), differentiable in ``splats.packed`` and ``planes``.

    Args:
        splats: M splats of 3 colours, which are replaced.
        planes: (M, 4), see `planes_of`.
        camera: of the splats.
        capacity: see `ops.rasterize`.
    """
    packed = splats.packed
    padding = packed.new_zeros(len(packed), packed.shape[1] - COLORS - planes.shape[1])
    packed = torch.cat([packed[:, :COLORS], planes, padding], dim=1)
    size = camera.width, camera.height
    drawn = Splats2D(packed, splats.ids, planes.shape[1])
    image, alpha, _ = ops.rasterize(drawn, *size, capacity=capacity)
    normals, distances = image.permute(2, 0, 1).split([3, 1])
    rays = rays_of(camera, packed)
    along, lengths = (normals * rays).sum(0), rays.square().sum(0).sqrt()
    # The planes face the camera, so `along` is negative. Those seen from the side have no depth.
    shown = (along < -_SIDEWAYS * lengths) & (distances[0] < 0)
    depth = torch.where(shown, distances[0], -1.0) / torch.where(shown, along, -1.0)
    from_depth = normals_of_depth(depth, camera)
    with torch.no_grad():
        # All nine pixels around have a depth. At the border of the image, the normals are 0.
        weight = surrounded(shown) * -((from_depth * rays).sum(0) / lengths).clamp(max=0.0)
    return (weight * (alpha.detach() - (normals * from_depth).sum(0))).mean()
