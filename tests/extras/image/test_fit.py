"""`Fitter`: both blendings approximate a photo; the result is reproducible."""

from __future__ import annotations

import pytest
import torch

from snowsplat import ops
from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.image.fit import Fitter, ImageGaussians
from snowsplat.extras.image.options import Blending, FitOptions
from snowsplat.util.errors import SettingError

from .photos import photo
from .test_model import BLENDINGS


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


@pytest.mark.parametrize("blending", BLENDINGS)
def test_the_error_decreases(blending: Blending) -> None:
    fitter = Fitter(photo(), FitOptions(60, blending, steps=100))
    fitter.step()
    first = fitter.mse
    while not fitter.finished:
        fitter.step()
    assert fitter.steps_done == 100
    assert fitter.mse < 0.02 * first


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
