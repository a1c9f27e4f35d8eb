"""`Fitter`: both blendings approximate a photo; the result is reproducible."""

import math

import pytest
import torch

from snowsplat import ops
from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.image.fit import Fitter, ImageGaussians, column_count
from snowsplat.extras.image.options import Blending, FitOptions
from snowsplat.util.errors import SettingError

from .photos import photo

BLENDINGS: tuple[Blending, ...] = ("front-to-back", "additive")


def fitted(options: FitOptions, width: int = 40, height: int = 30) -> ImageGaussians:
    fitter = Fitter(photo(width, height), options)
    while not fitter.finished:
        fitter.step()
    return fitter.gaussians


@pytest.mark.parametrize("blending", BLENDINGS)
def test_the_image_approximates_the_photo(blending: Blending) -> None:
    gaussians = fitted(FitOptions(60, blending, steps=150))
    target = photo()
    mean = target.mean((0, 1)).expand_as(target)
    assert psnr(mean, target) < 15
    assert psnr(gaussians.render(), target) > 32
    assert len(gaussians) == 60


def test_more_gaussians_are_better() -> None:
    few, many = (fitted(FitOptions(count, steps=120)).render() for count in (10, 100))
    assert psnr(many, photo()) > psnr(few, photo()) + 5


def test_colors_are_those_of_a_screen() -> None:
    """So that an SVG file can contain them."""
    colors = fitted(FitOptions(60, steps=60)).rows[:, 5:8]
    assert colors.min() >= 0
    assert colors.max() <= 1


@pytest.mark.parametrize("blending", BLENDINGS)
def test_the_result_does_not_depend_on_the_threads(blending: Blending) -> None:
    options, threads = FitOptions(50, blending, steps=40, seed=3), ops.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            ops.set_num_threads(count)
            results.append(fitted(options).rows)
    finally:
        ops.set_num_threads(threads)
    assert torch.equal(*results)
    assert not torch.equal(results[0], fitted(FitOptions(50, blending, steps=40, seed=4)).rows)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 30), (17, 2)])
@pytest.mark.parametrize("steps", [1, 2, 30])
def test_tiny_photos_and_few_steps(width: int, height: int, steps: int) -> None:
    gaussians = fitted(FitOptions(20, steps=steps), width, height)
    assert len(gaussians) == 20
    assert gaussians.rows.isfinite().all()


def test_a_photo_of_one_colour() -> None:
    target = torch.full((20, 20, 3), 0.25)
    fitter = Fitter(target, FitOptions(5, steps=20))
    while not fitter.finished:
        fitter.step()
    assert psnr(fitter.gaussians.render(), target) > 40


@pytest.mark.parametrize("options", [{"gaussians": 0}, {"gaussians": 10**9}, {"steps": 0}])
def test_settings_out_of_range(options: dict[str, int]) -> None:
    with pytest.raises(SettingError, match=next(iter(options))):
        FitOptions(**options)


def random_gaussians(blending: Blending, count: int = 30, seed: int = 0) -> ImageGaussians:
    """Gaussians in and around an image of 40×30 pixels."""
    g = torch.Generator().manual_seed(seed)
    rows = torch.zeros(count, column_count(blending))
    rows[:, :2] = torch.rand(count, 2, generator=g) * torch.tensor([44.0, 34.0]) - 2
    rows[:, 2:4] = torch.rand(count, 2, generator=g) * 2
    rows[:, 4] = torch.rand(count, generator=g) * 9 - 3
    rows[:, 5:8] = torch.rand(count, 3, generator=g)
    if blending == "front-to-back":
        rows[:, 8] = torch.randn(count, generator=g)
    return ImageGaussians(40, 30, blending, rows, torch.tensor([0.2, 0.4, 0.1]))


@pytest.mark.parametrize("blending", BLENDINGS)
def test_definition(blending: Blending) -> None:
    """Each pixel, from the formula of the blending."""
    gaussians = random_gaussians(blending)
    y, x = torch.meshgrid(torch.arange(30) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    image, transmittance = torch.zeros(30, 40, 3), torch.ones(30, 40, 1)
    for row in gaussians.rows:
        cos, sin = math.cos(row[4]), math.sin(row[4])
        dx, dy = x - row[0], y - row[1]
        u, v = (cos * dx + sin * dy) / row[2].exp(), (cos * dy - sin * dx) / row[3].exp()
        weight = torch.exp(-0.5 * (u * u + v * v))
        if blending == "front-to-back":
            weight = weight * torch.sigmoid(row[8])
        weight = torch.where(weight < 1 / 255, 0, weight)[..., None]
        image += transmittance * weight * row[5:8]
        if blending == "front-to-back":
            transmittance = transmittance * (1 - weight)
    image += transmittance * gaussians.background
    torch.testing.assert_close(gaussians.render(), image, rtol=0, atol=1e-4)


@pytest.mark.parametrize("blending", BLENDINGS)
def test_a_larger_image_has_the_same_colours(blending: Blending) -> None:
    gaussians = random_gaussians(blending)
    small, large = gaussians.render(), gaussians.render(3)
    assert large.shape == (90, 120, 3)
    # The centre of each pixel is the centre of the middle one of 3×3.
    torch.testing.assert_close(large[1::3, 1::3], small, rtol=0, atol=1e-3)


def test_a_wrong_number_of_columns_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"must be \(N, 8\) for additive blending, got \(5, 9\)"):
        ImageGaussians(4, 4, "additive", torch.zeros(5, 9), torch.zeros(3))
