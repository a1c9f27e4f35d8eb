"""Errors of predicted depths and of second views, and predictions that need no photo."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from network import Prediction, focal_scale, without_offsets
from torch import Tensor

from scenes import Shots
from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.lift.surface import find_links
from snowsplat.scene.render import render
from training import Example, examples

#: Images (N, H, W, 3) -> depths and discs.
Predictor = Callable[[Tensor], Prediction]
_EDGE_RADIUS = 2  # pixels around a discontinuity of the true depth
_EDGE = 0.1  # relative difference of the true depths of neighbours


def priors_of(train: Shots) -> dict[str, Predictor]:
    """Predictions that do not look at the photo: one depth, and a depth for each row."""
    logs = torch.stack([example.log_depth for example in examples([train])])
    mean, rows = logs.mean(), logs.mean((0, 2))

    def constant(images: Tensor) -> Prediction:
        return without_offsets(mean.expand(images.shape[:3]).clone())

    def of_row(images: Tensor) -> Prediction:
        return without_offsets(rows[:, None].expand(images.shape[:3]).clone())

    return {"mean depth": constant, "mean depth of the row": of_row}


@torch.no_grad()
def measure(
    predict: Predictor | None, shots: Shots, *, known_focal: bool = False
) -> dict[str, float]:
    """Means over all photos.

    - ``abs_rel``: mean of |z − z*| / z*, where z* is the true depth.
    - ``abs_rel_scaled``: the same after the depths of each photo are multiplied by the number that
      gives them the median of the true depths.
    - ``scale_invariant``: standard deviation of log z − log z* in a photo (Eigen et al. 2014).
    - ``abs_rel_edges``, ``abs_rel_elsewhere``: ``abs_rel`` near discontinuities, and elsewhere.
    - ``psnr``: of the second view, where the first photo shows it, in dB.

    Args:
        predict: None: the true depth.
        known_focal: multiply the depths by the ratio of the focal lengths.
    """
    scale = focal_scale(shots.focal) if known_focal else 1.0
    found = []
    for example in examples([shots]):
        truth, image = shots.depths[example.i], shots.image(example.i)
        if predict is None:
            prediction, scale = without_offsets(truth.log()[None]), 1.0
        else:
            prediction = predict(image[None])
        depth = prediction.log_depth[0].exp() * scale
        error = (depth - truth).abs() / truth
        scaled = depth * (truth.median() / depth.median())
        edge = near_edges(truth)
        gaussians = prediction.gaussians(0, image, shots.camera(example.i), scale)
        second = render(gaussians, shots.camera(example.second)).image.clamp(0, 1)
        found.append(
            {
                "abs_rel": error.mean(),
                "abs_rel_scaled": ((scaled - truth).abs() / truth).mean(),
                "scale_invariant": (depth.log() - truth.log()).std(),
                "abs_rel_edges": error[edge].mean(),
                "abs_rel_elsewhere": error[~edge].mean(),
                "psnr": psnr(second, shots.image(example.second), example.visible()),
            }
        )
    # A photo without a discontinuity has no error near one.
    columns = {key: torch.tensor([float(row[key]) for row in found]) for key in found[0]}
    return {key: round(float(column.nanmean()), 4) for key, column in columns.items()}


def near_edges(depth: Tensor) -> Tensor:
    """(H, W) bool: pixels near a discontinuity of the depth (H, W)."""
    links = find_links(depth, _EDGE)
    ends = torch.zeros_like(depth)
    ends[:, :-1] += ~links.right
    ends[:-1] += ~links.down
    size = 2 * _EDGE_RADIUS + 1
    return F.max_pool2d(ends[None, None], size, 1, _EDGE_RADIUS)[0, 0] > 0


def error_map(predict: Predictor, example: Example) -> tuple[Tensor, Tensor]:
    """The predicted depth (H, W), and its relative error (H, W)."""
    with torch.no_grad():
        depth = predict(example.shots.image(example.i)[None]).log_depth[0].exp()
    truth = example.shots.depths[example.i]
    return depth, (depth - truth).abs() / truth
