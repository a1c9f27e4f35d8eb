"""A small photo for the tests: smooth shapes with edges, from formulas."""

import torch
from torch import Tensor


def photo(width: int = 40, height: int = 30) -> Tensor:
    """(H, W, 3) in 0..1: a disc and a stripe on a gradient, with soft edges."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    disc = torch.sigmoid((9 - torch.hypot(x - 14, y - 16)) / 0.7)[..., None]
    stripe = torch.sigmoid((3 - (x - y - 12).abs()) / 0.7)[..., None]
    image = torch.stack([x / width, y / height, 0.5 + 0 * x], dim=2) * 0.6 + 0.1
    image = image + disc * (torch.tensor([0.9, 0.3, 0.1]) - image)
    image = image + stripe * (torch.tensor([0.1, 0.2, 0.6]) - image)
    return image.clamp(0, 1)
