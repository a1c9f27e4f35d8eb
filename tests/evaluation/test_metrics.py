"""Image metrics: analytic values, the reference implementation, and views on disk."""

import json
import math

import pytest
import torch
from PIL import Image

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.evaluation.metrics import (
    Evaluation,
    ViewMetrics,
    color_aligned,
    color_fit,
    compare,
    evaluate_views,
    psnr,
)
from snowsplat.ops import reference
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians


def planar(height: int, width: int, seed: int) -> torch.Tensor:
    """A random image (H, W, 3), planar in memory like all images of the program."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(3, height, width, generator=generator).permute(1, 2, 0)


def test_psnr_of_known_errors():
    target = torch.full((4, 5, 3), 0.5)
    assert psnr(target, target) == math.inf
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-5)
    one_pixel = target.clone()
    one_pixel[2, 3] += 0.2  # a twentieth of the pixels
    assert psnr(one_pixel, target) == pytest.approx(10 * math.log10(20 / 0.04), abs=1e-5)
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[2, 3:] = True
    assert psnr(one_pixel, target, mask) == pytest.approx(10 * math.log10(2 / 0.04), abs=1e-5)
    assert psnr(one_pixel, target, torch.zeros_like(mask)) == math.inf


def test_compare_clamps_and_agrees_with_the_reference():
    image, target = 1.5 * planar(23, 31, 0) - 0.25, planar(23, 31, 1)
    metrics = compare(image, target, name="a")
    clamped = image.clamp(0, 1)
    assert metrics.psnr == pytest.approx(
        -10 * math.log10(float((clamped - target).square().mean()))
    )
    assert metrics.ssim == pytest.approx(
        float(reference.ssim(clamped.double(), target.double())), rel=1e-4
    )
    assert metrics.lpips is None
    assert metrics.name == "a"


def test_a_mask_does_not_raise_the_ssim():
    """The SSIM of a photo of which most is masked is that of the rest, but for its border."""
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 160, 160, 3, generator=generator)
    mask = torch.zeros(160, 160, dtype=torch.bool)
    mask[40:120, 40:120] = True
    whole, part = compare(image, target), compare(image, target, mask)
    assert part.ssim == pytest.approx(whole.ssim, abs=0.06)
    assert compare(target, target, mask).ssim == pytest.approx(1.0, abs=1e-6)
    assert compare(image, target, torch.ones_like(mask)).ssim == pytest.approx(whole.ssim)


def test_masked_pixels_are_ignored():
    target = planar(20, 20, 2)
    image = target.clone()
    image[:, :10] = 0.0
    mask = torch.ones(20, 20, dtype=torch.bool)
    assert compare(image, target, mask).psnr < 20
    mask[:, :10] = False
    metrics = compare(image, target, mask)
    assert metrics.psnr == math.inf
    assert metrics.ssim == pytest.approx(1.0)


def test_views_without_visible_gaussians(tmp_path):
    """The rendered image is the background, so all metrics are known. Photos of one colour, or
    without a pixel, judge nothing: they are named and do not count."""
    camera = Camera(16, 12, 20.0, 20.0, 8.0, 6.0, torch.eye(3, 4, dtype=torch.float64))
    black, noise = Image.new("RGB", (16, 12)), Image.new("RGB", (16, 12), (40, 41, 40))
    noise.putpixel((3, 3), (42, 40, 40))
    half, masked = Image.new("RGB", (16, 12), (204, 204, 204)), Image.new("L", (16, 12))
    half.paste((102, 102, 102), (0, 0, 8, 12))
    clear = Image.new("RGBA", (16, 12), (9, 9, 9, 0))  # shows the background
    masked.save(tmp_path / "mask.png")
    mask = ImageSource(tmp_path / "mask.png", 16, 12)
    views = []
    for i, photo in enumerate((black, half, noise, half, clear)):
        photo.save(tmp_path / f"{i}.png")
        source = ImageSource(tmp_path / f"{i}.png", 16, 12)
        views.append(View(f"{i}.png", camera, source, mask if i == 3 else None))
    behind = Gaussians(
        means=torch.tensor([[0.0, 0.0, -5.0]]),
        log_scales=torch.zeros(1, 3),
        quats=torch.ones(1, 4),
        opacity_logits=torch.zeros(1),
        sh_dc=torch.zeros(1, 1, 3),
        sh_rest=torch.zeros(1, 0, 3),
    )
    seen = []
    evaluation = evaluate_views(behind, views, background=(1.0, 1.0, 1.0), on_view=seen.append)
    assert seen == evaluation.views
    assert [view.name for view in seen] == ["1.png"]
    assert evaluation.psnr == pytest.approx(-10 * math.log10((0.2**2 + 0.6**2) / 2), abs=1e-4)
    assert evaluation.unjudged == ("0.png", "2.png", "3.png", "4.png")
    assert "0.png, 2.png, 3.png and 1 more" in str(evaluation.line_of_unjudged())
    assert all(math.isfinite(x) for x in (evaluation.psnr_aligned, evaluation.ssim))


def test_the_explained_share_does_not_depend_on_exposure_and_contrast():
    photo = torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(0))
    noise = 0.1 * torch.randn(30, 40, 3, generator=torch.Generator().manual_seed(1))
    same = compare(0.5 * photo + 0.2, photo).explained
    assert same == pytest.approx(1.0, abs=1e-9)
    # The variance of the photo is 1/12; the least squares fit explains 1 / (1 + 12 · 0.01) of it.
    clear = compare(0.3 + 0.4 * photo + 0.4 * noise, photo).explained
    assert clear == pytest.approx(1 / 1.12, abs=0.01)
    dull = compare(0.3 + 0.4 * photo + 0.4 * noise, 0.45 + 0.1 * photo).explained
    assert dull == pytest.approx(clear, abs=0.01)  # the fit is clipped at 0 and 1
    mask = torch.zeros(30, 40, dtype=torch.bool)
    assert compare(photo, photo, mask).explained == 0.0  # no pixel
    assert compare(photo, torch.full_like(photo, 0.5)).explained == 0.0  # no contrast


def test_contours_of_a_hazy_image_and_of_a_shifted_one():
    """A haze changes brightness over large areas; a shift doubles contours."""
    y, x = torch.meshgrid(torch.arange(200.0), torch.arange(300.0), indexing="ij")
    photo = 0.5 + 0.1 * torch.sign(torch.sin(x / 5) * torch.sin(y / 5))[:, :, None].expand(
        -1, -1, 3
    )
    haze = photo + 0.12 * torch.sin(x / 60)[:, :, None]
    hazy, shifted = compare(haze, photo), compare(photo.roll(8, 1), photo)
    assert hazy.contours > 0.75 > 0.6 > hazy.explained
    assert shifted.contours < 0.3
    mask = x < 150
    wrong = torch.where(mask[:, :, None], photo, 1.0 - photo)
    assert compare(wrong, photo, mask).contours == pytest.approx(1.0)
    # The border of a mask is no contour.
    assert compare(photo.roll(8, 1), photo, mask).contours < 0.3
    assert compare(photo, torch.full_like(photo, 0.5)).contours == 0.0  # none


def test_means_and_json():
    evaluation = Evaluation(
        [ViewMetrics("a", 20.0, 0.5, 21.0, 0.25), ViewMetrics("b", 30.0, 0.75, 33.0, 0.5, 0.9)]
    )
    assert (evaluation.psnr, evaluation.ssim, evaluation.lpips) == (25.0, 0.625, 0.375)
    values = json.loads(json.dumps(evaluation.as_json()))
    assert values["psnr"] == 25.0
    assert values["views"]["b"] == {
        "psnr": 30.0,
        "ssim": 0.75,
        "psnr_aligned": 33.0,
        "lpips": 0.5,
        "explained": 0.9,
        "contours": None,
        "size": None,
    }
    assert values["psnr_aligned"] == 27.0
    assert math.isnan(Evaluation([]).psnr)
    assert Evaluation([]).lpips is None


def test_an_evaluation_says_the_size_of_its_images():
    photos = [planar(height, width, 0) for height, width in ((20, 30), (20, 30), (40, 30))]
    views = [compare(photo, photo) for photo in photos]
    assert views[0].size == (30, 20)
    assert Evaluation(views[:2]).size == "30x20"
    assert Evaluation(views[::-1]).size == "30x20 to 30x40"
    assert Evaluation(views[:2]).as_json()["size"] == "30x20"
    assert Evaluation([]).size == "an unknown size"


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
