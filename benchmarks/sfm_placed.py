"""Compares the poses of a model with the true poses: which photos are placed correctly."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.geometry import Similarity, invert_rigid, similarity_from_points

#: A photo is placed correctly if its errors after the alignment are below these limits.
MAX_ROTATION = 3.0  # degrees
MAX_CENTRE = 0.03  # as a fraction of the largest distance between two true centres
_SAMPLES = 1000  # maximum number of pairs of photos from which a transform is computed
_ROUNDS = 5  # maximum number of least-squares fits


@dataclass(frozen=True)
class Placed:
    """The photos of a model, compared with their true poses.

    ``rotations`` (degrees) and ``centres`` (fractions of ``extent``) are the errors of the photos
    in ``correct``, in that order.
    """

    correct: list[str]
    wrong: list[str]
    missing: list[str]  # photos without a pose in the model
    rotations: Tensor  # (len(correct),) float64
    centres: Tensor  # (len(correct),) float64
    extent: float  # largest distance between two true centres, in their unit


def placed(found: Mapping[str, Tensor], true: Mapping[str, Tensor], seed: int = 0) -> Placed:
    """Divide the photos of ``true`` into those placed correctly, wrongly and not at all.

    The world frames of ``found`` and ``true`` differ by an unknown similarity transform. Many
    transforms are tried, each computed from a pair of photos. The one with the least sum of squared
    errors is chosen; an error above the limits counts as an error at the limits. So the wrong
    photos do not affect the transform, even if they are the majority, as long as they do not agree
    with each other. If a model consists of several parts that are consistent in themselves but not
    with each other, the photos of the largest part are placed correctly, and all others wrongly.

    Args:
        found: photo name -> ``cam_from_world`` (3, 4) in the model. Photos that are not in ``true``
            are ignored.
        true: the same for the true poses; at least two photos.
        seed: equal seeds give equal results.
    """
    names = sorted(found.keys() & true.keys())
    missing = sorted(true.keys() - found.keys())
    all_centres = invert_rigid(torch.stack([pose.double() for pose in true.values()]))[..., 3]
    extent = float(torch.cdist(all_centres, all_centres).max())
    none = torch.zeros(0, dtype=torch.float64)
    if len(names) < 2:
        return Placed([], names, missing, none, none, extent)
    a = torch.stack([found[name].double() for name in names])
    b = torch.stack([true[name].double() for name in names])
    best = _fit(None, a, b, extent)
    for similarity in _hypotheses(a, b, seed):
        best = min(best, _fit(similarity, a, b, extent), key=lambda fit: fit.cost)
    for _ in range(_ROUNDS):
        refined = _fit(_refined(a[best.good], b[best.good]), a, b, extent)
        if not refined.cost < best.cost:
            break
        best = refined
    return Placed(
        correct=[name for name, good in zip(names, best.good, strict=True) if good],
        wrong=[name for name, good in zip(names, best.good, strict=True) if not good],
        missing=missing,
        rotations=best.rotations[best.good],
        centres=best.centres[best.good],
        extent=extent,
    )


def _hypotheses(a: Tensor, b: Tensor, seed: int) -> list[Similarity]:
    """Transforms that are each computed from a pair of photos.

    The rotation is that of the first photo; scale and translation align the two centres.
    """
    count = len(a)
    if count * (count - 1) <= _SAMPLES:
        pairs = [(i, j) for i in range(count) for j in range(count) if i != j]
    else:
        random = torch.Generator().manual_seed(seed)
        i = torch.randint(count, (_SAMPLES,), generator=random)
        j = (i + torch.randint(1, count, (_SAMPLES,), generator=random)) % count
        pairs = list(zip(i.tolist(), j.tolist(), strict=True))
    x, y = invert_rigid(a), invert_rigid(b)
    result = []
    for i, j in pairs:
        rotation = y[i, :, :3] @ x[i, :, :3].T
        lengths = float((x[i, :, 3] - x[j, :, 3]).norm()), float((y[i, :, 3] - y[j, :, 3]).norm())
        if min(lengths) > 0:
            scale = lengths[1] / lengths[0]
            middle = (x[i, :, 3] + x[j, :, 3]) / 2, (y[i, :, 3] + y[j, :, 3]) / 2
            result.append(Similarity(scale, rotation, middle[1] - scale * rotation @ middle[0]))
    return result


def _refined(a: Tensor, b: Tensor) -> Similarity | None:
    """The least-squares transform of the camera centres; None if they do not determine it."""
    try:
        return similarity_from_points(invert_rigid(a)[..., 3], invert_rigid(b)[..., 3])
    except ValueError:
        return None


@dataclass(frozen=True)
class _Fit:
    """The errors of poses after a transform, in the units of `MAX_ROTATION` and `MAX_CENTRE`."""

    rotations: Tensor  # (N,) errors in degrees
    centres: Tensor  # (N,) errors as fractions of the extent

    @property
    def good(self) -> Tensor:
        """(N,) bool: which photos are placed correctly."""
        return (self.rotations < MAX_ROTATION) & (self.centres < MAX_CENTRE)

    @functools.cached_property
    def cost(self) -> float:
        """The sum of (error / limit)², at most 1 for each photo."""
        errors = torch.maximum(self.rotations / MAX_ROTATION, self.centres / MAX_CENTRE)
        return float((errors * errors).clamp(max=1.0).sum())


def _fit(similarity: Similarity | None, a: Tensor, b: Tensor, extent: float) -> _Fit:
    """The errors of poses ``a`` (N, 3, 4) after the transform, compared with the true poses ``b``.

    The errors are infinite if there is no transform.
    """
    if similarity is None:
        unknown = torch.full((len(a),), math.inf, dtype=torch.float64)
        return _Fit(unknown, unknown)
    aligned = similarity.apply_to_poses(a)
    # |A − B| (Frobenius) is 2√2 sin(θ/2), which is accurate for small angles, too.
    sine = (aligned[..., :3] - b[..., :3]).flatten(1).norm(dim=1) / 8**0.5
    distances = (invert_rigid(aligned)[..., 3] - invert_rigid(b)[..., 3]).norm(dim=1)
    return _Fit(2 * torch.rad2deg(torch.asin(sine.clamp(max=1.0))), distances / extent)
