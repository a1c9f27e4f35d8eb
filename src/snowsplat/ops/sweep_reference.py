"""The reference of `plane_sweep`: see `reference.py`.

- [Collins 1996] A Space-Sweep Approach to True Multi-Image Matching. CVPR.
- [Gallup et al. 2007] Real-Time Plane-Sweeping Stereo with Multiple Sweeping Directions. CVPR.
"""

import torch
from torch import Tensor
from torch.nn.functional import pad

MIN_VARIANCE = 1 / 255**2  # of a window: a standard deviation of one 8-bit level


@torch.no_grad()
def plane_sweep(
    image: Tensor,
    sources: Tensor,
    source_from_pixel: Tensor,
    min_inverse_depth: float,
    max_inverse_depth: float,
    *,
    planes: int = 64,
    radius: int = 3,
    centre: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The inverse depth (H, W) of every pixel and its score (H, W); 0 and −1: no result.

    image (H, W); sources (S, Hs, Ws); source_from_pixel (S, 3, 4): pixel (u, v) at inverse depth w
    is at A (u, v, 1) + w b of a source; centre (H, W) is added to all inverse depths.

    The score of a plane is the mean of the two highest ZNCCs among the sources. A source counts if
    it sees the complete window. The best plane is refined by a parabola.
    """
    height, width = image.shape
    v, u = torch.meshgrid(
        torch.arange(height).to(image) + 0.5, torch.arange(width).to(image) + 0.5, indexing="ij"
    )
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1)
    step = (max_inverse_depth - min_inverse_depth) / (planes - 1)
    base = min_inverse_depth + (torch.zeros_like(image) if centre is None else centre)

    scores = []
    for k in range(planes):
        w = base + k * step
        correlations = []
        for source, matrix in zip(sources, source_from_pixel, strict=True):
            q = pixels @ matrix[:, :3].T + w[..., None] * matrix[:, 3]
            seen = (q[..., 2] > 0) & (w >= 0)
            warped = torch.where(seen, _sample(source, q[..., :2] / q[..., 2:]), torch.nan)
            correlations.append(_zncc(image, warped, radius))
        best = torch.stack(correlations).nan_to_num(-torch.inf).sort(dim=0, descending=True).values
        both = best[:2].mean(dim=0)
        scores.append(torch.where(both.isfinite(), both, best[0]))
    score, plane = torch.stack(scores).max(dim=0)  # the first one if several are equal

    # The maximum of the parabola through the three scores, if all of them exist.
    none = torch.full_like(image, -torch.inf)
    around = torch.stack([none, *scores, none])
    before, after = (around.gather(0, plane[None] + i)[0] for i in (0, 2))
    shift = 0.5 * (before - after) / (before - 2 * score + after)
    shift = torch.where(before.isfinite() & after.isfinite(), shift, 0)
    valid = score.isfinite()
    inverse_depth = torch.where(valid, base + step * (plane + shift), 0)
    return inverse_depth, torch.where(valid, score, -1)


def _sample(source: Tensor, position: Tensor) -> Tensor:
    """Bilinear interpolation at pixel positions (…, 2); NaN outside of the pixel centres."""
    size = torch.tensor([source.shape[1], source.shape[0]], device=source.device)
    position = position - 0.5
    inside = ((position >= 0) & (position <= size - 1)).all(dim=-1)
    position = torch.where(inside[..., None], position, 0)
    whole = torch.minimum(position.long(), size - 2)
    fx, fy = (position - whole).unbind(dim=-1)
    x, y = whole.unbind(dim=-1)
    upper = source[y, x] + fx * (source[y, x + 1] - source[y, x])
    lower = source[y + 1, x] + fx * (source[y + 1, x + 1] - source[y + 1, x])
    return torch.where(inside, upper + fy * (lower - upper), torch.nan)


def _zncc(a: Tensor, b: Tensor, radius: int) -> Tensor:
    """Zero-mean normalised cross-correlation of the windows of two images around every pixel.

    NaN if a window contains NaN, or if the variance of the window of `a` is below MIN_VARIANCE. A
    lower variance of the window of `b` counts as MIN_VARIANCE.
    """

    def windows(image: Tensor) -> Tensor:
        """(H, W, 2 r + 1, 2 r + 1); 0 outside of the image."""
        size = 2 * radius + 1
        return pad(image, [radius] * 4).unfold(0, size, 1).unfold(1, size, 1)

    inside = windows(torch.ones_like(a))

    def mean(values: Tensor) -> Tensor:
        return values.sum(dim=(2, 3), keepdim=True) / inside.sum(dim=(2, 3), keepdim=True)

    a, b = windows(a), windows(b)
    a, b = (a - mean(a)) * inside, (b - mean(b)) * inside
    variance_a, variance_b = mean(a * a), mean(b * b).clamp(min=MIN_VARIANCE)
    zncc = mean(a * b) / (variance_a * variance_b).sqrt()
    return torch.where(variance_a >= MIN_VARIANCE, zncc, torch.nan)[:, :, 0, 0]
