"""Views that the scene does not explain: the measure, the rule, and the training without them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.data.dataset import Dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.unexplained import Unexplained, explanation_of, standing_out
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.errors import UserError

from ..gaussians import assert_identical

COUNT = 24
WRONG = 7


def photo(height: int = 12, width: int = 16) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(3))


# The measure


def test_exposure_and_white_balance_do_not_count():
    image = photo()
    other = image * torch.tensor([0.5, 0.9, 1.3]) + torch.tensor([0.2, 0.0, -0.1])
    psnr, explained = explanation_of(image, other)
    assert psnr > 59
    assert explained > 0.999999


def test_an_unrelated_or_negative_image_explains_nothing():
    image = photo()
    other = torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(4))
    psnr, explained = explanation_of(image, other)
    assert explained < 0.05
    assert psnr == pytest.approx(-10 * math.log10(float(other.var((0, 1)).mean())), abs=0.5)
    assert explanation_of(image, 1 - image)[1] == 0.0


def test_half_of_the_variance():
    """The image is the photo plus noise of the same variance."""
    generator = torch.Generator().manual_seed(5)
    image = torch.randn(200, 200, 3, generator=generator)
    noise = torch.randn(200, 200, 3, generator=generator)
    assert explanation_of(image, 0.1 * (image + noise) + 0.5)[1] == pytest.approx(0.5, abs=0.01)


def test_masked_pixels_do_not_count():
    image, mask = photo(), torch.zeros(12, 16, dtype=torch.bool)
    mask[:6] = True
    other = image.clone()
    other[6:] = 0.0
    assert explanation_of(image, other)[1] < 0.9
    assert explanation_of(image, other, mask) == pytest.approx((60.0, 1.0))


def test_a_photo_of_one_colour_is_explained():
    assert explanation_of(photo(), torch.full((12, 16, 3), 0.5)) == (60.0, 1.0)
    assert explanation_of(photo(), photo(), torch.zeros(12, 16, dtype=torch.bool)) == (60.0, 1.0)


# The rule


def ring(count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    """Positions and directions of cameras on a circle that look at its centre."""
    angles = 2 * np.pi * np.arange(count) / count
    positions = 3 * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    return positions, -positions / 3


def usual(count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    """PSNR and explained share of views with right poses."""
    random = np.random.default_rng(0)
    return 24 + random.normal(0, 0.7, count), 0.9 + random.uniform(-0.05, 0.05, count)


def test_no_view_stands_out():
    assert standing_out(*usual(), *ring()) == ()


@pytest.mark.parametrize("wrong", [[7], [0, 23], [4, 5, 6, 8, 9], [1, 9, 16, 20]])
def test_wrong_views_stand_out_also_beside_each_other(wrong):
    psnr, explained = usual()
    psnr[wrong], explained[wrong] = 12.0, 0.2
    assert standing_out(psnr, explained, *ring()) == tuple(wrong)


def test_the_views_around_a_camera_look_in_its_direction():
    """At one place, half of the cameras look at a part of the scene that is not explained."""
    psnr, explained = usual()
    positions, directions = np.zeros((COUNT, 3)), np.tile([1.0, 0.0, 0.0], (COUNT, 1))
    directions[1::2] *= -1
    psnr[1::2] -= 9.0
    explained[1::2] = 0.3
    assert standing_out(psnr, explained, positions, directions) == ()
    psnr[4], explained[4] = 14.0, 0.3
    assert standing_out(psnr, explained, positions, directions) == (4,)


def test_a_hard_part_of_the_scene_does_not_stand_out():
    psnr, explained = usual()
    hard = np.cos(2 * np.pi * np.arange(COUNT) / COUNT)
    assert standing_out(psnr + 6 * hard, explained - 0.25 + 0.25 * hard, *ring()) == ()


@pytest.mark.parametrize(
    ("psnr", "explained", "stands_out"),
    [
        (12.0, 0.65, False),  # a little less than the others
        (12.0, 0.55, True),
        # Flat: its variance is mostly noise, which no scene explains.
        (32.0, 0.1, False),
        # A plain wall at the end of a corridor, whose few details are not there yet.
        (20.5, 0.2, False),
        (19.5, 0.2, True),
    ],
)
def test_how_wrong_a_view_must_be(psnr, explained, stands_out):
    psnrs, shares = usual()
    psnrs[WRONG], shares[WRONG] = psnr, explained
    assert standing_out(psnrs, shares, *ring()) == ((WRONG,) if stands_out else ())


def test_no_view_stands_out_if_there_are_few_or_if_many_would():
    positions, directions = ring(9)
    psnr, explained = usual(9)
    psnr[2], explained[2] = 12.0, 0.2
    assert standing_out(psnr, explained, positions, directions) == ()
    psnr, explained = usual()
    psnr[:18:3], explained[:18:3] = 12.0, 0.2
    assert standing_out(psnr, explained, *ring()) == tuple(range(0, 18, 3))
    psnr[18], explained[18] = 12.0, 0.2
    assert standing_out(psnr, explained, *ring()) == ()


# The training

CONFIG = recipe("default", iterations=200, leave_out_after=0.5)


@pytest.fixture(scope="module")
def right(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return load_dataset(write_toy_dataset(folder, "colmap-bin", COUNT, 64, 48, n_points=800))


@pytest.fixture(scope="module")
def wrong(right) -> Dataset:
    """The camera of view 7 is where view 13 is, on the other side of the scene."""
    train = list(right.train)
    train[WRONG] = replace(train[WRONG], camera=train[13].camera)
    return replace(right, train=train)


@pytest.fixture(scope="module")
def uninterrupted(wrong) -> Trainer:
    trainer = Trainer(wrong, CONFIG)
    trainer.run(until=130)
    return trainer


@pytest.mark.slow
def test_the_check_changes_no_bit_if_all_poses_are_right(right):
    checked, unchecked = (Trainer(right, replace(CONFIG, leave_out_after=w)) for w in (0.5, 0))
    for each in (checked, unchecked):
        each.run(until=110)
    assert checked.part(Unexplained)._decided
    assert checked.excluded == ()
    assert_identical(checked.gaussians, unchecked.gaussians)


@pytest.mark.slow
def test_a_view_with_a_wrong_pose_is_not_used_after_the_check(wrong, monkeypatch):
    trainer, used = Trainer(wrong, CONFIG), []
    take = trainer.queue.take

    def recorded(after, step):
        chosen = take(after, step)
        used.append((step, chosen[0].view.name))
        return chosen

    monkeypatch.setattr(trainer.queue, "take", recorded)
    trainer.run(until=100)
    assert trainer.excluded == ()  # it is decided before step 101
    trainer.run()
    assert trainer.excluded == (WRONG,)
    name = wrong.train[WRONG].name
    assert max(step for step, each in used if each == name) <= 100
    assert {each for step, each in used if step > 150} == {
        view.name for view in wrong.train if view.name != name
    }


@pytest.mark.slow
@pytest.mark.parametrize("stop", [100, 110])
def test_a_resumed_run_keeps_the_decision(wrong, uninterrupted, tmp_path, stop):
    first = Trainer(wrong, CONFIG)
    first.run(until=stop)
    path = checkpoint.save(tmp_path, stop, first.state_tensors(), {})
    second = Trainer(wrong, CONFIG)
    second.load_state(checkpoint.load(path).tensors)
    second.run(until=130)
    assert second.excluded == uninterrupted.excluded == (WRONG,)
    assert_identical(second.gaussians, uninterrupted.gaussians)


@pytest.mark.slow
def test_the_decision_is_made_once(wrong):
    trainer = Trainer(wrong, CONFIG)
    trainer.run(until=101)
    assert trainer.excluded == (WRONG,)
    trainer.queue.excluded = ()
    trainer.run(until=110)
    assert trainer.excluded == ()


@pytest.mark.parametrize("excluded", [[COUNT], [-1], list(range(COUNT))])
def test_a_damaged_decision_is_rejected(right, excluded):
    trainer = Trainer(right, CONFIG)
    state = trainer.state_tensors() | {"unexplained.left_out": torch.tensor(excluded)}
    with pytest.raises(UserError, match="another dataset or recipe"):
        trainer.load_state(state)
