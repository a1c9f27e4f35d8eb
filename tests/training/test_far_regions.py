"""Which regions of directions are far: observations of surfaces at known distances."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from snowsplat.training.parts.far_regions import COUNT, directions_of, in_far_regions

PHOTOS = 12


def shading(directions: Tensor) -> Tensor:
    """(M, 3) in 0..255: slow gradients."""
    return 128.0 + 60.0 * torch.sin(2.0 * directions + torch.tensor([0.0, 1.0, 2.0]))


def is_far(
    distance: float, contrast: float = 1.0, noise: float = 1.0, overcast: bool = False
) -> bool:
    """Whether a cap of a sphere of this radius is far, seen by photos with different exposures.

    The median depth of the points is 1, and the cameras are up to 0.5 from the middle.
    """
    generator = torch.Generator().manual_seed(7)
    offsets = 0.5 * normalize(torch.randn(PHOTOS, 3, generator=generator), dim=1)
    cap = (directions_of(torch.arange(COUNT))[:, 1] < -0.9).nonzero()[:, 0]
    cells, photos = cap.repeat(PHOTOS), torch.arange(PHOTOS).repeat_interleave(len(cap))
    directions, origins = directions_of(cells), offsets[photos]
    along = (origins * directions).sum(1)
    reach = (along.square() + distance**2 - origins.square().sum(1)).sqrt() - along
    surface = normalize(origins + reach[:, None] * directions, dim=1)
    exposure = 10.0 * torch.randn(PHOTOS, 1, generator=generator)
    errors = noise * torch.randn(len(cells), 3, generator=generator)
    colors = contrast * shading(surface) + exposure[photos] + errors
    light = torch.full((len(cells),), overcast)
    found = in_far_regions(cells, photos, colors, light, offsets, 1.0)
    assert found.all() == found.any()  # one region
    return bool(found.all())


@pytest.mark.parametrize(
    ("distance", "far"), [(1.0, False), (2.0, False), (4.0, False), (1e4, True)]
)
def test_the_distance_decides_for_any_exposure_of_the_photos(distance, far):
    assert is_far(distance) is far


def test_without_gradients_a_region_is_far_if_it_looks_like_an_overcast_sky():
    assert not is_far(1e4, contrast=0.0)
    assert is_far(1e4, contrast=0.0, overcast=True)
    assert not is_far(1.0, overcast=True)  # its gradients say that it is near


def test_colours_that_differ_in_every_photo_show_nothing_far():
    assert not is_far(1e4, noise=12.0, overcast=True)
