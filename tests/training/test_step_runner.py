"""`StepRunner`: capacity, validity, repetition and errors, with hand-made steps.

The complete step on the kernels of a GPU is in `test_trainer_gpu`.
"""

import sys
from pathlib import Path

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import ImageSource, LoadedImage
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.finite import Diverged
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.step_runner import StepRunner
from snowsplat.training.step.view_gradient import ViewGradient

CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, torch.eye(3, 4).double())
VIEW = View("a.png", CAMERA, ImageSource(Path("a.png"), 8, 6))
PHOTO = LoadedImage(torch.zeros(3, 6, 8, dtype=torch.uint8))
GAUSSIANS = gaussians_in_box(
    torch.tensor([[-1.0, -1.0, 1.0], [1.0, 1.0, 3.0]]), 4, torch.Generator().manual_seed(0)
)


def splats_with_gradient_one() -> Splats2D:
    ones = torch.ones(4)
    ids = torch.arange(4, dtype=torch.int32)
    return Splats2D.pack(
        torch.zeros(4, 2), torch.ones(4, 3), ones, ones, torch.zeros(4, 3), ones, ids
    )


class Steps:
    """Steps that require given numbers of instances; collects their gradients."""

    def __init__(self, capacity: int, *required: int, loss: float = 0.5) -> None:
        self.runner = StepRunner(4, torch.device("cpu"))
        self.runner.capacity.instances = capacity
        self.required = list(required)
        self.loss = loss
        self.gradients: list[ViewGradient] = []

    def optimize(self) -> None:
        self.runner.capacity.required[0] = self.required.pop(0)
        splats = splats_with_gradient_one()
        with torch.enable_grad():
            splats.packed.requires_grad_()
            loss = splats.packed.sum()
            loss = loss - loss.detach() + self.loss
        self.runner.backward(loss)
        self.gradients.append(self.runner.gradient(splats, CAMERA, 0))

    def run(self, step: int = 7) -> float:
        return self.runner.run(self.optimize, step, GAUSSIANS, [VIEW], [PHOTO])[0]

    @property
    def valid(self) -> list[bool]:
        return [bool(gradient.valid) for gradient in self.gradients]


@pytest.mark.parametrize(
    ("required", "valid", "then"),
    [
        (90, [True], 100),
        (91, [True], int(1.3 * 91)),  # it grows before it is exceeded
        (100, [True], int(1.3 * 100)),
        (101, [False, True], int(1.3 * 101)),
    ],
)
def test_a_step_that_exceeds_its_capacity_is_repeated(
    required: int, valid: list[bool], then: int
) -> None:
    steps = Steps(100, *[required] * len(valid))
    assert steps.run() == 0.5
    assert steps.valid == valid
    assert steps.runner.capacity.instances == then


def test_the_initial_capacity() -> None:
    assert StepRunner(500, torch.device("cpu")).capacity.instances == sys.maxsize
    with torch.device("meta"):
        assert StepRunner(500, torch.device("meta")).capacity.instances == 2000


@pytest.mark.parametrize("loss", [torch.nan, torch.inf])
def test_a_nonfinite_loss_makes_the_step_invalid_and_raises(loss: float) -> None:
    steps = Steps(100, 10, loss=loss)
    with pytest.raises(Diverged, match=rf"^step 7, photo a\.png: the loss is {loss}, "):
        steps.run(7)
    assert steps.valid == [False]


def test_nonfinite_rows_of_a_step_make_the_next_one_invalid_and_raise() -> None:
    steps = Steps(100, 10, 10, 10)
    steps.run(7)
    rows = steps.gradients[0].nonfinite_rows
    assert rows is not None
    rows[3] += 2  # what `adam_step` does
    with pytest.raises(
        Diverged, match=r"^step 7: .* opacity_logits \(2 rows\), skipped; use lower learning rates"
    ):
        steps.run(8)
    assert steps.valid == [True, False]
    steps.runner.reset()
    steps.run(8)
    assert steps.valid[-1]


def test_nonfinite_rows_of_the_last_step_are_reported_at_the_end() -> None:
    steps = Steps(100, 10)
    steps.run(7)
    steps.runner.finish(7, GAUSSIANS)
    rows = steps.gradients[0].nonfinite_rows
    assert rows is not None
    rows[0] += 1
    with pytest.raises(Diverged, match=r"^step 7: .* means \(1 row\)"):
        steps.runner.finish(7, GAUSSIANS)


def test_an_invalid_step_changes_neither_statistics_nor_parameters_nor_moments() -> None:
    gaussians = GAUSSIANS.clone()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    steps = Steps(100, 101, 50)
    steps.run()
    sums = torch.zeros(3, 4)
    for gradient, changed in zip(steps.gradients, [False, True], strict=True):
        gradient.add_statistics(*sums)
        adam.step(gaussians, [gradient], 1)
        assert sums.any(dim=1).tolist() == 3 * [changed]
        assert torch.equal(gaussians.opacity_logits, GAUSSIANS.opacity_logits) != changed
        assert bool(adam.exp_avg["opacity_logits"].any()) == changed


@pytest.mark.isa
@pytest.mark.parametrize("abs_grad", [False, True])
def test_the_absolute_gradient_is_computed_on_request(abs_grad: bool) -> None:
    runner = StepRunner(4, torch.device("cpu"), abs_grad)
    splats = splats_with_gradient_one()
    splats.packed[:, :2] = torch.tensor([3.0, 2.0])
    with torch.enable_grad():
        loss = runner.rasterize(splats, CAMERA, torch.zeros(3)).image[0, 0, 0]
    runner.backward(loss)
    gradient = runner.gradient(splats, CAMERA, 0)
    if not abs_grad:
        assert gradient.splats.abs_grad is None
        return
    norm_sum, views = torch.zeros(2, 4)
    gradient.add_statistics(norm_sum, views, absolute=True)
    assert gradient.splats.abs_grad is not None
    assert splats.packed.grad is not None
    # All pixels are in one tile.
    assert torch.equal(gradient.splats.abs_grad, splats.packed.grad[:, :2].abs())


def test_a_gradient_is_valid_and_counts_nothing_by_default() -> None:
    """The image has 8 x 6 pixels and the gradient is (1, 1) per pixel: |(8/2, 6/2)| = 5."""
    gaussians = GAUSSIANS.clone()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    splats = splats_with_gradient_one()
    splats.packed.requires_grad_().sum().backward()
    gradient = ViewGradient(splats, CAMERA, 0)
    norm_sum, views, max_radii = torch.zeros(3, 4)
    gradient.add_statistics(norm_sum, views, max_radii)
    adam.step(gaussians, [gradient], 1)
    assert norm_sum.tolist() == 4 * [5.0]
    assert views.tolist() == 4 * [1.0]
    assert torch.equal(max_radii, splats.radii)
    assert not torch.equal(gaussians.opacity_logits, GAUSSIANS.opacity_logits)
