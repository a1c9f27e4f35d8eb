"""The loss of one view: masks and transparent photos."""

import pytest
import torch

from snowsplat import ops
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.training.step.losses import view_loss

BLACK = torch.zeros(3)


def rendering(height: int = 20, width: int = 24) -> torch.Tensor:
    planes = torch.rand(3, height, width, generator=torch.Generator().manual_seed(2))
    return planes.permute(1, 2, 0).requires_grad_()


@pytest.mark.parametrize("ssim_weight", [0.2, 0.7])
def test_the_loss_of_opaque_photos_is_the_photometric_loss(ssim_weight):
    image = rendering()
    planes = torch.randint(0, 256, (3, 20, 24), dtype=torch.uint8)
    loss = view_loss(image, LoadedImage(planes), BLACK, ssim_weight)
    assert torch.equal(loss, ops.photometric_loss(image, planes.permute(1, 2, 0), ssim_weight))


def test_transparent_photos_show_the_background():
    planes = torch.zeros(4, 20, 24, dtype=torch.uint8)
    planes[:, :, 12:] = 255  # opaque white on the right, nothing on the left
    background = torch.tensor([0.25, 0.5, 1.0])
    image = torch.ones(3, 20, 24)
    image[:, :, :12] = background[:, None, None]
    loss = view_loss(image.permute(1, 2, 0), LoadedImage(planes), background, 0.2)
    assert float(loss) < 1e-5


def test_masked_pixels_have_no_loss_and_no_gradient():
    image = rendering()
    mask = torch.ones(20, 24, dtype=torch.bool)
    mask[5:, :9] = False
    planes = (255 * image.detach()).round().to(torch.uint8).permute(2, 0, 1).contiguous()
    planes[:, ~mask] = 255 - planes[:, ~mask]  # different only where it is masked
    loss = view_loss(image, LoadedImage(planes, mask), BLACK, 0.2)
    assert float(loss.detach()) < 3e-3  # the rounding to 8 bits
    loss.backward()
    assert image.grad is not None
    assert not image.grad[~mask].any()
    assert image.grad[mask].any()


@pytest.mark.parametrize("channels", [3, 4])
def test_a_view_without_a_pixel_that_counts_has_no_loss(channels):
    """The loss compares the photo with itself, also one composited over the background."""
    planes = torch.full((channels, 20, 24), 200, dtype=torch.uint8)
    photo = LoadedImage(planes, torch.zeros(20, 24, dtype=torch.bool))
    background = torch.tensor([0.25, 0.5, 1.0])
    assert float(view_loss(rendering(), photo, background, 0.2).detach()) < 1e-6
