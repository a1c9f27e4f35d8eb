"""Exposures of photos: their estimate, the photos without them, and the gains that are learnt."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat import ops
from snowsplat.data import load_dataset
from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.ops.splats import COLORS, Splats2D
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.train import train
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts import exposure_start as module
from snowsplat.training.parts.exposure import Exposure
from snowsplat.training.parts.exposure_start import GAMMA, exposure_start, log_gains
from snowsplat.training.parts.neutral_photos import NeutralPhotos
from snowsplat.training.processes.shards import ALONE
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.step.batch import BatchView
from snowsplat.training.step.losses import view_loss

from .stage import stage

CONFIG = recipe("default", iterations=80, init="points", max_gaussians=1500, sh_degree=0)
CONFIG = replace(CONFIG, coarse_to_fine=(0, 0))


def with_gains(folder: Path, gains: np.ndarray) -> Dataset:
    """The toy dataset whose training photos are multiplied by exp(gains)."""
    dataset = load_dataset(folder, hold_out=8)
    for view, gain in zip(dataset.train, gains, strict=True):
        values = np.asarray(Image.open(view.image.path)) * np.exp(gain)
        Image.fromarray(np.rint(values.clip(0, 255)).astype(np.uint8)).save(view.image.path)
    return load_dataset(folder, hold_out=8)


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    return write_toy_dataset(
        tmp_path_factory.mktemp("toy") / "clean", "colmap-bin", 12, 96, 72, n_points=800
    )


@pytest.fixture(scope="module")
def gains() -> np.ndarray:
    """(V, 3) log-gains with mean 0, without clipping."""
    found = np.random.default_rng(0).uniform(-0.25, 0.25, (10, 3))
    return found - found.mean(0)


@pytest.fixture(scope="module")
def degraded(clean: Path, gains: np.ndarray) -> Dataset:
    folder = clean.with_name("degraded")
    shutil.copytree(clean, folder)
    return with_gains(folder, gains)


def start_of(dataset: Dataset):
    with ImageLoader(dataset.train) as images:
        return exposure_start(dataset, images)


# The estimate before the training


def test_gains_from_colours_with_outliers():
    generator = torch.Generator().manual_seed(1)
    true = torch.randn(9, 3, generator=generator, dtype=torch.float64) * 0.3
    true -= true.mean(0)
    logs = torch.rand(1, 200, 3, generator=generator, dtype=torch.float64) - 2.0 + true[:, None]
    logs += 0.02 * torch.randn(logs.shape, generator=generator, dtype=torch.float64)
    unknown = torch.rand(9, 200, 1, generator=generator) < 0.4
    hidden = torch.rand(9, 200, 1, generator=generator) < 0.25
    logs = torch.where(hidden, logs + 0.8, logs)
    logs = torch.where(unknown, torch.nan, logs)
    assert (log_gains(logs) - true).abs().max() < 0.02


def test_photos_with_too_few_points_have_no_gain():
    logs = torch.zeros(3, 50, 3, dtype=torch.float64)
    logs[2, 5:] = torch.nan
    found = log_gains(logs)
    assert found[:2].isfinite().all()
    assert found[2].isnan().all()


def points_start(logs: Tensor, xyz: Tensor, monkeypatch) -> module.ExposureStart:
    """The exposures of photos with these colours (V, P, 3) of points (P, 3), two at each place."""
    monkeypatch.setattr(module, "_log_colors", lambda views, points, step, images: logs)
    pairs = [[i - len(logs) // 2] for i in range(len(logs))]
    monkeypatch.setattr(module, "source_views", lambda cameras, points, count: pairs)
    views = [SimpleNamespace(image=SimpleNamespace(path=Path("no photo")), camera=None)] * len(logs)
    dataset = SimpleNamespace(train=views, points=Points(xyz, torch.zeros(len(xyz), 3)))
    return exposure_start(dataset, None)


@pytest.mark.parametrize(
    ("everywhere", "on_sides", "jump", "same"),
    [(0.2, 0.05, 0.0, True), (0.2, 0.2, 0.0, False), (0.2, 0.2, 0.2, True), (0.0, 0.2, 0.0, False)],
)
def test_shiny_surfaces_are_no_exposure(everywhere, on_sides, jump, same, monkeypatch):
    """Photos are brighter, differ on two sides of the scene, as on a table that reflects a window
    and a wall, and two photos from a place differ by twice ``jump``."""
    generator = torch.Generator().manual_seed(0)
    xyz = torch.rand(1000, 3, generator=generator)
    noise = 0.05 * torch.randn(12, 1000, 3, generator=generator, dtype=torch.float64)
    logs = torch.rand(1000, 3, generator=generator, dtype=torch.float64) - 1.5 + noise
    brighter = torch.randn(2, 6, 1, 1, generator=generator, dtype=torch.float64).repeat(1, 2, 1, 1)
    logs += everywhere * brighter[0] + on_sides * brighter[1] * (2.0 * (xyz[:, :1] < 0.5) - 1.0)
    logs += torch.tensor([jump, -jump]).repeat_interleave(6)[:, None, None]
    assert points_start(logs, xyz, monkeypatch).everywhere == same


def test_the_exposures_of_a_dataset(clean, degraded, gains):
    before, after = start_of(load_dataset(clean, hold_out=8)), start_of(degraded)
    assert before.spread is not None
    assert before.spread < 0.05
    assert str(after.source) == "points"
    assert after.spread == pytest.approx(GAMMA / math.log(2) * gains.std(), rel=0.1)
    assert np.abs(after.log_gains.numpy() - gains).max() < 0.05


@pytest.mark.parametrize(("known", "enough"), [(25, True), (15, False)])
def test_photos_that_show_few_points_do_not_hide_the_exposures_of_others(
    known, enough, monkeypatch
):
    """Of 60 photos, 35 or 45 show none of the points; 20 points are compared for each photo."""
    generator = torch.Generator().manual_seed(2)
    xyz = torch.rand(5000, 3, generator=generator)
    true = 0.2 * torch.randn(known, 3, generator=generator, dtype=torch.float64)
    logs = torch.full((60, 1000, 3), torch.nan, dtype=torch.float64)
    logs[:known] = -1.0 + true[:, None]
    logs[:known] += 0.02 * torch.randn(logs[:known].shape, generator=generator)
    start = points_start(logs, xyz, monkeypatch)
    assert (start.spread is not None) == enough
    if enough:
        assert start.everywhere
        expected = true - true.mean(0)
        assert (start.log_gains[:known] - expected).abs().max() < 0.02
        assert not start.log_gains[known:].any()


def test_exif_data_are_used_without_points(degraded, tmp_path):
    views = []
    for i, view in enumerate(degraded.train):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: 0.01 * 2 ** (i % 2), 0x829D: 4.0, 0x8827: 100})
        path = tmp_path / f"{i}.jpg"
        Image.open(view.image.path).save(path, exif=exif)
        views.append(replace(view, image=replace(view.image, path=path)))
    found = start_of(replace(degraded, train=views, points=None))
    assert (str(found.source), found.spread) == ("EXIF data", pytest.approx(0.5))
    assert found.log_gains[:2, 0].tolist() == pytest.approx(
        [-0.5 * math.log(2) / GAMMA, 0.5 * math.log(2) / GAMMA]
    )
    unknown = start_of(replace(degraded, points=None))
    assert unknown.spread is None
    assert not unknown.log_gains.any()


def test_neutral_photos(clean, degraded, gains):
    start = start_of(degraded)
    view, original = degraded.train[3], load_dataset(clean, hold_out=8).train[3]
    with ImageLoader([view]) as images:
        neutral = NeutralPhotos(images, degraded.train, start.log_gains).get(view, 1).rgb
        changed, expected = images.get(view).rgb, images.get(original).rgb
    assert (neutral.float() - expected).abs().mean() < 3
    assert (changed.float() - expected).abs().mean() > 10


# The gains


def initial(dataset: Dataset) -> Gaussians:
    """One Gaussian for each point."""
    return Trainer(dataset, replace(CONFIG, initial_opacity=0.7, exposure="off")).gaussians


def exposure_of(setting: str, dataset: Dataset, notes: list[str] | None = None) -> Exposure:
    exposure = Exposure(setting)
    with ImageLoader(dataset.train) as images:
        run = stage(dataset=dataset, images=images, shards=ALONE, resumed=False)
        run.note = lambda line: None if notes is None else notes.append(str(line))
        exposure.prepare(run)
    return exposure


def exposed(exposure: Exposure, render, photo: LoadedImage, behind: Tensor, black: bool = False):
    """The image of view 0, and its gains. ``render``: a background → an image."""
    run = SimpleNamespace(config=SimpleNamespace(background="black" if black else "random"))
    view = BatchView(0, None, None, photo, behind, torch.tensor([0]))
    image = render(exposure.background(run, view, behind))
    return exposure.image(run, view, image, photo), exposure._present[view]


def test_the_decision(clean, degraded):
    same = load_dataset(clean, hold_out=8)
    notes: list[str] = []
    assert exposure_of("auto", degraded, notes).active
    assert "one gain for each photo and channel is learnt" in notes[-1]
    assert not exposure_of("auto", same, notes).active
    assert notes[-1].endswith("(standard deviation, from points); no gains are learnt")
    assert exposure_of("on", same, notes).active
    assert not exposure_of("auto", replace(degraded, points=None), notes).active
    assert "not known" in notes[-1]
    assert len(notes) == 4
    off = Trainer(same, replace(CONFIG, exposure="off"), note=lambda line: notes.append(str(line)))
    assert off.part(Exposure) is None
    assert len(notes) == 4


def test_a_training_without_gains_is_told_that_exposures_differ(clean, degraded, tmp_path):
    notes: list[str] = []
    observer = Observer()
    observer.note = lambda line: notes.append(str(line))

    def told(folder: Path, recipe: str = "classic", **settings: object) -> bool:
        notes.clear()
        options = TrainOptions(recipe=recipe, settings={"iterations": 1, **settings})
        train(folder, tmp_path / "out", options, overwrite=True, observer=observer)
        return any("no gains are learnt, because exposure is off" in note for note in notes)

    differing = clean.with_name("degraded")
    assert (told(clean), told(differing), told(differing, exposure="off")) == (False, True, False)
    assert not told(differing, "default", init="points")
    assert any("one gain for each photo and channel is learnt" in note for note in notes)


@pytest.mark.parametrize("background", [(0.3, 0.9, 0.6), (0.0, 0.0, 0.0)])
def test_the_gradients_of_the_gains_and_of_the_splats(degraded, background):
    """Those of a scene in float64 whose colours are multiplied by the gains."""
    exposure, view = exposure_of("on", degraded), degraded.train[0]
    with ImageLoader(degraded.train) as images:
        photo = images.get(view)
    dark = LoadedImage(photo.planes.clamp(max=253))
    scene, behind = initial(degraded), torch.tensor(background)
    size = view.camera.width, view.camera.height
    exposure.log_gains[0] = at = torch.tensor([0.1, -0.2, 0.05])

    splats = project(scene, view.camera, 0)
    splats.packed.requires_grad_()
    image, present = exposed(
        exposure,
        lambda color: ops.rasterize(splats, *size, color)[0],
        dark,
        behind,
        black=not any(background),
    )
    value = view_loss(image, dark, behind, 0.2)
    value.backward()

    exact = project(scene.to(dtype=torch.float64), view.camera, 0)
    exact.packed.requires_grad_()
    gains = at.double().requires_grad_()
    factors = torch.ones(exact.packed.shape[1], dtype=torch.float64)
    factors = factors.index_copy(0, torch.arange(COLORS, COLORS + 3), gains.exp())
    colored = Splats2D(exact.packed * factors, exact.ids, 3)
    image, _, _ = ops.rasterize(colored, *size, behind.double())
    expected = ops.photometric_loss(image, dark.over(behind).double(), 0.2)
    expected.backward()

    assert value.item() == pytest.approx(expected.item(), rel=1e-5)
    assert torch.equal(splats.ids, exact.ids)
    for found, true in (
        (splats.packed.grad, exact.packed.grad),
        (present.grad, gains.grad),
    ):
        assert (found - true).abs().max() < 1e-4 * true.abs().max()


@pytest.mark.parametrize("bright_rows", [1, 4])  # with 4, the positions are not kept
def test_overexposed_pixels_count_only_if_the_image_is_darker(degraded, bright_rows):
    exposure = exposure_of("on", degraded)
    exposure.log_gains[0] = 0.0
    planes = torch.full((3, 4, 5), 200, dtype=torch.uint8)
    planes[:, :bright_rows, :3] = 255
    values = 0.5 + torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(6))
    weights = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(7))
    photo = LoadedImage(planes)
    bright = (photo.rgb == 255) & (values.permute(1, 2, 0) > 1.0)
    assert 0 < int(bright.sum()) < bright_rows * 9
    for _ in range(2):  # the second time, the positions may be known
        image = values.permute(1, 2, 0).clone().requires_grad_()
        found, present = exposed(exposure, lambda color: image, photo, torch.zeros(3))  # noqa: B023
        assert torch.equal(found, torch.where(bright, 1.0, image))
        (found * weights).sum().backward()
        assert torch.equal(image.grad, weights * ~bright)
        expected = (image.detach() * weights * ~bright).sum((0, 1))
        assert torch.allclose(present.grad, expected, atol=1e-5)


@pytest.mark.slow
def test_the_training_learns_the_gains(degraded, gains):
    """They stay near the true gains, and the colours of the scene are neutral."""
    trainer = Trainer(degraded, replace(CONFIG, iterations=200, exposure="on"))
    trainer.run()
    exposure = trainer.part(Exposure)
    found = exposure.log_gains
    assert found.mean(0).abs().max() < 1e-6
    assert 0.0 < (found - exposure.start).abs().mean() < 0.03
    assert np.corrcoef(found.flatten(), gains.flatten())[0, 1] > 0.98
    without = Trainer(degraded, replace(CONFIG, iterations=200, exposure="off"))
    without.run()
    assert trainer.evaluate().psnr > without.evaluate().psnr + 1.0


def test_a_resumed_run_has_the_same_bits(degraded, tmp_path):
    config = replace(CONFIG, iterations=30, exposure="auto", batch=3, background="random")
    whole, first = Trainer(degraded, config), Trainer(degraded, config)
    whole.run()
    first.run(until=15)
    path = checkpoint.save(tmp_path, 15, first.state_tensors(), {})
    second = Trainer(degraded, config, state=checkpoint.load(path).tensors)
    assert second.part(Exposure).active
    second.run()
    assert torch.equal(second.part(Exposure).log_gains, whole.part(Exposure).log_gains)
    for name, tensor in whole.gaussians.parameters().items():
        assert torch.equal(tensor, second.gaussians.parameters()[name]), name


def test_no_bit_changes_if_the_exposures_are_equal(clean):
    dataset = load_dataset(clean, hold_out=8)
    auto, off = (Trainer(dataset, replace(CONFIG, exposure=s)) for s in ("auto", "off"))
    auto.run(until=20)
    off.run(until=20)
    assert torch.equal(auto.gaussians.means, off.gaussians.means)
    assert torch.equal(auto.gaussians.sh_dc, off.gaussians.sh_dc)
