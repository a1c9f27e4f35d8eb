"""Colour alignment: the image with the colours of a photo."""

import torch

from snowsplat.evaluation.metrics import color_aligned, color_fit, compare


def images():
    generator = torch.Generator().manual_seed(3)
    return torch.rand(9, 7, 3, generator=generator) * 0.5 + 0.1


def test_another_exposure_and_white_balance_do_not_count():
    image = images()
    photo = image * torch.tensor([1.5, 0.8, 1.1]) + torch.tensor([0.02, 0.05, -0.03])
    gain, offset = color_fit(image, photo)
    assert torch.allclose(gain.float(), torch.tensor([1.5, 0.8, 1.1]), atol=1e-5)
    assert torch.allclose(offset.float(), torch.tensor([0.02, 0.05, -0.03]), atol=1e-5)
    metrics = compare(image, photo)
    assert metrics.psnr < 25
    assert metrics.psnr_aligned > 80


def test_the_fit_minimises_the_error():
    """Against a solver of linear least squares."""
    image, photo = images(), images().flip(0) * 0.3 + images() * 0.6
    gain, offset = color_fit(image, photo)
    for c in range(3):
        x = image[..., c].flatten().double()
        matrix = torch.stack([x, torch.ones_like(x)], 1)
        solution = torch.linalg.lstsq(matrix, photo[..., c].flatten().double()[:, None]).solution
        assert torch.allclose(solution[:, 0], torch.stack([gain[c], offset[c]]))


def test_masked_pixels_do_not_count_and_an_image_is_not_inverted():
    image = images()
    photo, mask = 2 * image, torch.ones(9, 7, dtype=torch.bool)
    mask[:4] = False
    photo[:4] = 0.5
    gain, _ = color_fit(image, photo, mask)
    assert torch.allclose(gain.float(), torch.full((3,), 2.0), atol=1e-5)
    assert color_fit(image, photo, torch.zeros_like(mask)) is None
    inverted = color_aligned(image, 1 - image)
    assert torch.allclose(inverted, (1 - image).mean((0, 1)).expand_as(image), atol=1e-6)
