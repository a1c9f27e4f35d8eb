"""Selection of the source views with which the depth map of each view is computed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.training.starts.photos import in_threads

#: Angles between two viewing directions of a point, in degrees. The weight of a pair of views rises
#: from 0 at the first angle to 1 at the second one, and falls from 1 at the third to 0 at the last.
#: With a smaller angle, the depth is uncertain; with a larger one, the pictures differ too much.
_ANGLES = (1.0, 6.0, 15.0, 40.0)
#: A source view needs this share of the weight of the best one.
_LEAST_WEIGHT = 0.1


def source_views(cameras: Sequence[Camera], points: Tensor, count: int) -> list[list[int]]:
    """For each view, the views that show the same points from suitable directions.

    The weight of a pair of views is the sum, over the points that are visible in both, of a weight
    for the angle between the two viewing directions, as in the view selection of MVSNet (Yao et al.
    2018), multiplied by the ratio of the two depths.

    Args:
        points: (P, 3) in the world frame, a sample of the scene; computed on its device. Occlusion
            is not considered.
        count: the maximum number of source views of a view.

    Returns: Indices into ``cameras``, the best one first. The list of a view is empty if no other
    view shows the same points.
    """
    points = points.to(torch.float64)
    visible, depths, rays = [], [], []
    for camera in cameras:
        pixel, depth = camera.project(points)
        inside = (pixel >= 0).all(1) & (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
        visible.append(inside & (depth > 0))
        depths.append(depth.clamp(min=1e-12))
        rays.append(torch.nn.functional.normalize(points - camera.position.to(points), dim=1))
    visible_, depth_, ray_ = torch.stack(visible), torch.stack(depths), torch.stack(rays)

    def chosen(i: int) -> list[int]:
        cosine = (ray_ * ray_[i]).sum(2).clamp(-1.0, 1.0)
        ratio = torch.minimum(depth_ / depth_[i], depth_[i] / depth_)
        weight = (_angle_weight(cosine.acos()) * ratio * (visible_ & visible_[i])).sum(1)
        weight[i] = 0.0
        best = torch.argsort(weight, descending=True, stable=True)[:count]
        weights = weight[best].tolist()
        least = max(_LEAST_WEIGHT * weights[0], 1e-9)
        return [j for j, w in zip(best.tolist(), weights, strict=True) if w >= least]

    return in_threads(chosen, range(len(cameras)), points.device)


def _angle_weight(angle: Tensor) -> Tensor:
    a, b, c, d = (math.radians(degrees) for degrees in _ANGLES)
    return torch.minimum((angle - a) / (b - a), (d - angle) / (d - c)).clamp(0.0, 1.0)
