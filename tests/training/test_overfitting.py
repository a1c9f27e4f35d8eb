"""Overfitting: the unseen views, the estimate, the rule, and the training that ends early."""

from dataclasses import replace

import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.data.dataset import Dataset
from snowsplat.data.decode import LoadedImage
from snowsplat.data.image_loader import ImageLoader
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts import overfitting
from snowsplat.training.parts.overfitting import (
    Overfitting,
    OverfittingCheck,
    UnseenView,
    estimated_psnr,
    unseen_views,
)
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.errors import UserError

from .stage import stage

BLACK = torch.zeros(3)
CONFIG = recipe("default", iterations=200, stop_overfitting=True)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return load_dataset(write_toy_dataset(folder, "colmap-bin", 12, 64, 48, n_points=800))


def views_of(dataset: Dataset, photo=None) -> list[UnseenView]:
    """The unseen views. ``photo`` changes the photos."""
    assert dataset.points is not None
    with ImageLoader(dataset.train) as images:
        if photo is not None:
            get = images.get
            images.get = lambda view, downscale: photo(get(view, downscale))  # type: ignore[method-assign]
        return unseen_views(dataset.train, dataset.points.xyz, images, BLACK)


def points_of(unseen: list[UnseenView]) -> int:
    return sum(len(view.pixels) for view in unseen)


# The unseen views


def test_the_colours_of_points_in_unseen_views(dataset):
    """The toy points are exact, so their colours are those of the surfaces."""
    unseen = views_of(dataset)
    assert len(unseen) == len(dataset.train) == 10
    assert points_of(unseen) > 500
    for view in unseen:
        assert (view.camera.width, view.camera.height) == (64, 48)
        pixel, _ = view.camera.project(dataset.points.xyz.double())
        distance, nearest = torch.cdist(view.pixels.double(), pixel).min(1)
        assert distance.max() < 1e-4
        error = (view.colors - dataset.points.rgb[nearest] / 255).abs().mean(1)
        assert error.median() < 0.05


def test_points_with_different_colours_in_two_photos_are_not_used(dataset):
    generator = torch.Generator().manual_seed(1)

    def noisy(photo: LoadedImage) -> LoadedImage:
        noise = torch.randint(0, 256, photo.planes.shape, generator=generator, dtype=torch.uint8)
        return replace(photo, planes=noise)

    assert points_of(views_of(dataset, noisy)) < 0.1 * points_of(views_of(dataset))


@pytest.mark.parametrize("kind", ["mask", "alpha"])
def test_masked_and_transparent_pixels_are_not_used(dataset, kind):
    def halved(photo: LoadedImage) -> LoadedImage:
        left = torch.zeros(photo.planes.shape[1:], dtype=torch.bool)
        left[:, : left.shape[1] // 2] = True
        if kind == "mask":
            return replace(photo, mask=left)
        return replace(photo, planes=torch.cat([photo.planes, 255 * left[None].to(torch.uint8)]))

    def nothing(photo: LoadedImage) -> LoadedImage:
        return replace(photo, mask=torch.zeros(photo.planes.shape[1:], dtype=torch.bool))

    assert 0 < points_of(views_of(dataset, halved)) < 0.7 * points_of(views_of(dataset))
    assert views_of(dataset, nothing) == []


# The estimate


def test_a_known_estimate(dataset):
    """Colours that differ by 0.1 from the rendering: 20 dB; without a difference: 60 dB. Larger
    differences count as 0.2."""
    gaussians = Trainer(dataset, CONFIG).gaussians
    camera = dataset.train[0].camera
    pixels = torch.tensor([[10.5, 20.5], [30.5, 7.5]])
    image = overfitting.render(gaussians, camera, BLACK).image.clamp(0, 1)
    colors = image[pixels[:, 1].long(), pixels[:, 0].long()]
    exact = UnseenView(camera, pixels, colors)
    assert estimated_psnr(gaussians, [exact], BLACK, 3) == pytest.approx(60.0, abs=1e-6)
    other = replace(exact, colors=colors + torch.tensor([0.1, -0.1, 0.1]))
    assert estimated_psnr(gaussians, [other], BLACK, 3) == pytest.approx(20.0, abs=1e-3)
    hidden = replace(exact, colors=colors + 0.5)
    assert estimated_psnr(gaussians, [hidden], BLACK, 3) == pytest.approx(13.979, abs=1e-3)
    both = [exact, hidden]
    assert estimated_psnr(gaussians, both, BLACK, 3) == pytest.approx(16.990, abs=1e-3)


def test_the_estimate_tells_fog_that_no_photo_shows(dataset):
    """A Gaussian directly in front of an unseen view, and behind the camera of the photo."""
    trainer = Trainer(dataset, CONFIG)
    unseen = views_of(dataset)
    before = estimated_psnr(trainer.gaussians, unseen, BLACK, 0)
    fog = {name: p[:1].clone() for name, p in trainer.gaussians.parameters().items()}
    world_from_cam = unseen[0].camera.world_from_cam.float()
    fog["means"] = (world_from_cam[:, 3] + 0.3 * world_from_cam[:, 2])[None]
    fog["log_scales"] = torch.full((1, 3), -2.5)
    fog["opacity_logits"] = torch.tensor([2.0])
    fog["sh_dc"] = torch.full((1, 1, 3), -1.5)
    own = trainer.gaussians.parameters()
    foggy = Gaussians(**{name: torch.cat([own[name], fog[name]]) for name in own})
    assert estimated_psnr(foggy, unseen, BLACK, 0) < before - 0.1


# The rule


def check_with(monkeypatch, estimates: list[float], iterations: int = 1000) -> OverfittingCheck:
    """Run all steps of a schedule with given estimates."""
    given = iter(estimates)
    monkeypatch.setattr(overfitting, "unseen_views", lambda *args: [None])
    monkeypatch.setattr(overfitting, "estimated_psnr", lambda *args: next(given))
    run = stage(views=0, iterations=iterations, photos=None)
    check = OverfittingCheck()
    check.begin(run)
    while run.step < run.schedule.iterations:
        check.between(run)
        run.step += 1
    return check


@pytest.mark.parametrize(
    ("estimates", "step"),
    [
        ([20.0, 19.75, 19.5, 19.25], 600),
        ([20.0, 20.5, 20.25, 20.25, 20.25], 650),
        ([20.0, 19.5, 20.0, 19.5, 19.5, 19.9, 19.7, 19.6, 19.5], 850),
    ],
)
def test_three_lower_estimates_in_a_row_end_the_training(monkeypatch, estimates, step):
    check = check_with(monkeypatch, estimates)
    assert check.found == Overfitting(step, 1000)
    # The rest of the schedule is completed in a quarter of the steps.
    schedule = check._run.schedule
    assert schedule.iterations == step + -(-(1000 - step) // 4)
    assert schedule.share(schedule.iterations) == 1.0
    assert schedule.share(step) == pytest.approx(step / 1000)


@pytest.mark.parametrize(
    "estimates",
    [
        [24.68, 24.66, 24.64, 24.71, 24.70, 24.75, 24.81, 24.85, 24.84],  # fern
        [25.56, 25.65, 25.66, 25.70, 25.56, 25.62, 25.78, 25.75, 25.79],  # fox at 270×480
        [20.0, 19.5, 19.5, 20.0, 19.5, 19.5, 20.0, 19.5, 19.5],
        [20.0 + 0.1 * i for i in range(9)],
    ],
)
def test_other_estimates_do_not_end_the_training(monkeypatch, estimates):
    check = check_with(monkeypatch, estimates)
    assert check.found is None
    assert check._estimates == len(estimates) == 9
    assert check._run.schedule == Schedule(1000)


def test_at_most_12_unseen_views(dataset):
    with ImageLoader(dataset.train) as images:
        unseen = unseen_views(3 * dataset.train, dataset.points.xyz, images, BLACK)
    assert len(unseen) == 10  # every third one of 30


def test_a_training_of_few_epochs_is_not_checked(dataset, monkeypatch):
    """5% of the steps are less than the 10 steps of an epoch."""
    monkeypatch.setattr(overfitting, "unseen_views", None)
    check = OverfittingCheck()
    check.between(stage(step=150, iterations=199, dataset=dataset))
    assert check._estimates == 0


def test_without_points_nothing_is_estimated(dataset, monkeypatch):
    monkeypatch.setattr(overfitting, "estimated_psnr", None)
    with ImageLoader(dataset.train) as images:
        without = replace(dataset, points=None)
        check = OverfittingCheck()
        check.between(stage(step=100, iterations=200, dataset=without, photos=images))
    assert check._estimates == 1


# The training


def run(dataset: Dataset, config: TrainConfig) -> Trainer:
    trainer = Trainer(dataset, config)
    trainer.run()
    return trainer


def assert_identical(a: Gaussians, b: Gaussians) -> None:
    for name, parameter in a.parameters().items():
        assert torch.equal(parameter, b.parameters()[name]), name


@pytest.mark.slow
def test_the_check_changes_no_bit_if_the_scene_does_not_overfit(dataset):
    checked, unchecked = (
        run(dataset, replace(CONFIG, stop_overfitting=on)) for on in (True, False)
    )
    check = checked.part(OverfittingCheck)
    assert check.found is None
    assert check._estimates == 9
    assert check._best > 15.0
    assert unchecked.part(OverfittingCheck) is None
    assert_identical(checked.gaussians, unchecked.gaussians)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [99, 109, 110, 111, 120])
def test_a_resumed_run_ends_at_the_same_step_with_the_same_scene(
    dataset, tmp_path, monkeypatch, stop
):
    monkeypatch.setattr(overfitting, "_DIFFERENCE", -100.0)  # every estimate is worse
    uninterrupted = run(dataset, CONFIG)
    assert uninterrupted.part(OverfittingCheck).found == Overfitting(110, 200)
    assert uninterrupted.step == 110 + 23
    first = Trainer(dataset, CONFIG)
    first.run(until=stop)
    path = checkpoint.save(tmp_path, stop, first.state_tensors(), {})
    state = checkpoint.load(path).tensors
    second = Trainer(dataset, CONFIG, replace(first.schedule), state=state)
    second.run()
    assert second.step == 133
    assert second.part(OverfittingCheck).found == Overfitting(110, 200)
    assert_identical(second.gaussians, uninterrupted.gaussians)


def test_the_state_is_complete(dataset):
    checks = [OverfittingCheck(), OverfittingCheck()]
    checks[1].begin(stage(iterations=133))
    checks[0]._estimates, checks[0]._best, checks[0]._worse = 4, 20.5, 2
    for found in (None, Overfitting(110, 200)):
        checks[0].found = found
        checks[1].load(checks[0].state())
        assert (checks[1]._estimates, checks[1]._best, checks[1]._worse) == (4, 20.5, 2)
        assert checks[1].found == found


def test_a_checkpoint_without_the_setting_is_as_before(dataset):
    state = Trainer(dataset, replace(CONFIG, stop_overfitting=False)).state_tensors()
    assert not any(name.startswith("overfitting") for name in state)


@pytest.mark.parametrize(
    ("name", "value"),
    [("counts", torch.zeros(3, dtype=torch.int64)), ("counts", torch.zeros(4)), ("best", None)],
)
def test_a_damaged_state_is_rejected(dataset, name, value):
    trainer = Trainer(dataset, CONFIG)
    state = trainer.state_tensors()
    state.pop(f"overfitting.{name}")
    if value is not None:
        state[f"overfitting.{name}"] = value
    with pytest.raises(UserError, match="another dataset or recipe"):
        trainer.load_state(state)
