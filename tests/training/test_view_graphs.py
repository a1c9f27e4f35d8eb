"""Recorded gradients: on the CPU, a recording runs the same Python code again on its own memory."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from snowsplat.data import Dataset
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.scene.render import RenderOutput
from snowsplat.training.core.run import Run
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.core.view_graphs import MOST_RECORDINGS, ViewGraphs, recordable
from snowsplat.training.parts.exposure import Exposure
from snowsplat.training.parts.part import Part
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.step.batch import BatchView

from .test_trainer import BUSY, CALM, dataset, every_density_control

__all__ = ["dataset"]  # a fixture

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


class Masked(Part):
    """Ignores half of the pixels of every second view."""

    def target(self, run: Run, view: BatchView, photo: LoadedImage) -> LoadedImage:
        if view.index % 2 == 0:
            return photo
        mask = torch.zeros(photo.planes.shape[1:], dtype=torch.bool, device=photo.planes.device)
        mask[: len(mask) // 2] = True
        return replace(photo, mask=mask)


class Brighter(Part):
    def image(self, run: Run, view: BatchView, image: Tensor, photo: LoadedImage) -> Tensor:
        return 1.1 * image


class Counted:
    """A `Recorder` that counts. The work runs when it is queued, not when it is recorded."""

    def __init__(self) -> None:
        self.recorded = self.queued = self.forgotten = 0

    def __call__(self, work: Callable[[], None]) -> Callable[[], None]:
        self.recorded += 1

        def queue() -> None:
            self.queued += 1
            work()

        return queue

    def forget(self) -> None:
        self.forgotten += 1


class Failing(Counted):
    def __call__(self, work: Callable[[], None]) -> Callable[[], None]:
        raise RuntimeError("no memory\nat line 3")


def losses(trainer: Trainer, steps: int) -> list[float]:
    return [trainer.step_once() for _ in range(steps)]


def with_masks(trainer: Trainer) -> Trainer:
    trainer.parts.append(Masked())
    return trainer


@every_density_control
def test_recordings_change_nothing(dataset: Dataset, config: TrainConfig) -> None:
    """Over changes of the Gaussians, of the image size, of the SH degree, and of the masks. A part
    may have a rendering of its own beside them."""
    config = replace(config, surfaces=True)
    expected = losses(with_masks(Trainer(dataset, config)), 60)
    record = Counted()
    trainer = with_masks(Trainer(dataset, config))
    trainer.graphs = ViewGraphs(record, note=pytest.fail)
    assert losses(trainer, 60) == expected
    assert record.recorded > 4  # two for each recording
    assert record.queued > record.recorded
    assert record.forgotten > 1  # densification replaced the Gaussians


def mixed(dataset: Dataset) -> Dataset:
    """Views with different intrinsics."""
    train = [
        replace(view, camera=replace(view.camera, fx=26.0 + i, fy=24.0 - i, cx=12.0 + 0.1 * i))
        for i, view in enumerate(dataset.train)
    ]
    return replace(dataset, train=train)


@pytest.mark.parametrize("exposure", ["off", "on"])
def test_a_recording_is_for_all_intrinsics_and_exposures(dataset: Dataset, exposure: str) -> None:
    """The learnt gains are the same, too."""
    config = replace(CALM, exposure=exposure, background="random")
    plain = Trainer(mixed(dataset), config)
    expected = losses(plain, 30)
    record = Counted()
    trainer = Trainer(mixed(dataset), config)
    assert recordable(trainer.parts)
    trainer.graphs = ViewGraphs(record, note=pytest.fail)
    assert losses(trainer, 30) == expected
    assert record.recorded == 2
    assert record.queued == 2 * 29  # all but the first step
    if exposure == "on":
        gains = [each.part(Exposure).log_gains for each in (plain, trainer)]
        assert torch.equal(*gains)
        assert gains[0].any()


def test_the_least_recently_used_recording_is_replaced(dataset: Dataset) -> None:
    trainer = Trainer(dataset, CALM)
    record = Counted()
    trainer.graphs = graphs = ViewGraphs(record, note=pytest.fail)
    capacity = trainer.runner.capacity

    def steps_with(instances: int) -> int:
        capacity.instances = instances
        before = record.recorded
        losses(trainer, 2)
        return record.recorded - before

    first = 10**9  # the CPU ignores the capacity
    assert all(steps_with(first + i) == 2 for i in range(MOST_RECORDINGS))
    assert steps_with(first + MOST_RECORDINGS - 1) == 0
    assert steps_with(first) == 0  # now the last one used
    assert steps_with(first + MOST_RECORDINGS) == 2
    assert len(graphs._recordings) == MOST_RECORDINGS
    assert steps_with(first) == 0
    assert steps_with(first + 1) == 2


def test_a_failed_recording_is_reported_once(dataset: Dataset) -> None:
    notes: list[str] = []
    expected = losses(Trainer(dataset, BUSY), 9)
    trainer = Trainer(dataset, BUSY)
    trainer.graphs = ViewGraphs(Failing(), lambda line: notes.append(str(line)))
    assert losses(trainer, 9) == expected
    assert notes == ["training continues without CUDA graphs, more slowly: no memory"]


def test_parts_between_the_projection_and_the_loss_are_not_recorded() -> None:
    class Darker(Part):
        def loss(self, run: Run, view: BatchView, rendered: RenderOutput) -> Tensor | None:
            return None

    class Recorded(Brighter):
        recordable = True

    assert recordable([Masked()])
    assert recordable([Masked(), Recorded()])
    assert not recordable([Masked(), Brighter()])
    assert not recordable([Darker()])


def test_a_trainer_with_its_own_loss_is_not_recorded(dataset: Dataset) -> None:
    class Doubled(Trainer):
        def _loss(self, view: BatchView, rendered: RenderOutput) -> Tensor:
            return 2.0 * super()._loss(view, rendered)

    record = Counted()
    trainer = Doubled(dataset, BUSY)
    trainer.graphs = ViewGraphs(record, note=pytest.fail)
    losses(trainer, 9)
    assert record.recorded == 0


@pytest.mark.gpu
@needs_gpu
@every_density_control
@pytest.mark.parametrize(
    ("background", "exposure"), [("black", "on"), ("random", "off"), ("random", "on")]
)
def test_graphs_of_a_gpu_change_nothing(
    dataset: Dataset, config: TrainConfig, background: str, exposure: str
) -> None:
    """The losses and the parameters have the same bits as without graphs."""
    config, dataset = replace(config, background=background, exposure=exposure), mixed(dataset)
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        plain = with_masks(Trainer(dataset, config, device=torch.device("cuda")))
        plain.graphs = None
        expected = losses(plain, 60)
        trainer = with_masks(
            Trainer(dataset, config, device=torch.device("cuda"), note=pytest.fail)
        )
        assert trainer.graphs is not None
        assert losses(trainer, 60) == expected
        assert trainer.graphs._recordings
    finally:
        torch.use_deterministic_algorithms(False)
    for name, parameter in plain.gaussians.parameters().items():
        assert torch.equal(parameter, trainer.gaussians.parameters()[name]), name
