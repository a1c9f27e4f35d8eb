"""Training on a GPU: its kernels emulated on the CPU, fake GPU tensors, and a GPU if present."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from snowsplat import ops
from snowsplat.data import Dataset
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.cuda.launches import launch_by
from snowsplat.ops.native import LAUNCHERS
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.densification import Densification
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.step.finite import Diverged
from snowsplat.util.native_layout import Fields

from ..ops.engines import launcher
from .test_trainer import BUSY, BUSY_MCMC, dataset, every_density_control

__all__ = ["dataset"]  # a fixture

STEPS = 14  # the first densification is among them


def losses(trainer: Trainer, steps: int = STEPS) -> Tensor:
    return torch.tensor([trainer.step_once() for _ in range(steps)], dtype=torch.float64)


def with_capacity(trainer: Trainer, instances: int) -> Trainer:
    trainer.runner.capacity.instances = instances
    return trainer


@pytest.mark.emulated
@every_density_control
def test_the_kernels_of_a_gpu_train_as_those_of_the_cpu(
    dataset: Dataset, config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps whose capacity is too small are repeated, and the result is identical."""
    expected = losses(Trainer(dataset, config))
    monkeypatch.setitem(LAUNCHERS, "cpu", launcher("emulated"))
    ample = with_capacity(Trainer(dataset, config), 100_000)
    found = losses(ample)
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=0)
    narrow = with_capacity(Trainer(dataset, config), 3)
    assert torch.equal(losses(narrow), found)
    assert narrow.runner.capacity.instances > 3
    monkeypatch.undo()
    expected_state = ample.state_tensors()
    for name, tensor in narrow.state_tensors().items():  # moments and statistics too
        assert torch.equal(tensor, expected_state[name]), name


@pytest.mark.emulated
def test_a_loss_that_is_not_finite_changes_nothing(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(LAUNCHERS, "cpu", launcher("emulated"))
    trainer = with_capacity(Trainer(dataset, BUSY), 100_000)
    trainer.step_once()
    monkeypatch.setattr(trainer.background, "draw", lambda: torch.full((3,), torch.nan))
    before = {name: tensor.clone() for name, tensor in trainer.state_tensors().items()}
    with pytest.raises(Diverged, match="step 2, photo .*: the loss is nan"):
        trainer.step_once()
    assert before["density.views"].any()
    for name, tensor in trainer.state_tensors().items():
        if name != "order":  # the view was taken from it
            assert torch.equal(tensor, before[name]), name


def backward_by_hand(loss: Tensor, gradient: Tensor | None = None) -> None:
    """`loss.backward()` along a chain, in this thread: autograd's GPU threads need a real GPU."""
    node, grads = loss.grad_fn, [torch.ones_like(loss) if gradient is None else gradient]
    while "AccumulateGrad" not in type(node).__name__:
        by_us = getattr(node, "_forward_cls", None)
        found = node(*grads) if by_us is None else by_us.backward(node, *grads)
        found = found if isinstance(found, tuple) else (found,)
        edges = zip(found, node.next_functions, strict=True)
        grad, (node, output) = next(edge for edge in edges if edge[0] is not None)
        outputs = 2 if "Rasterize" in type(node).__name__ else 1
        grads = [grad if i == output else None for i in range(outputs)]
    node.variable.grad = grads[0]


@pytest.mark.parametrize(("deterministic", "batch"), [(False, 1), (True, 2)])
@every_density_control
def test_a_step_waits_for_nothing_and_mixes_no_devices(
    dataset: Dataset,
    config: TrainConfig,
    deterministic: bool,
    batch: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With fake tensors, which have a device but no values: reading one is an error."""
    seen: list[str] = []

    def record(kernel: Kernel, name: str, blocks: int, fields: Fields) -> None:
        tensors = [value for value in fields.values() if isinstance(value, Tensor)]
        assert all(tensor.device.type == "cuda" for tensor in tensors), name
        seen.append(name)

    def launch(name: str, fields: Fields) -> int:
        return launch_by(record, name, fields)

    trainer = Trainer(dataset, replace(config, batch=batch))
    view = trainer.queue.take(0, 1)[0]
    assert view.photo is not None
    monkeypatch.setitem(LAUNCHERS, "cuda", launch)
    monkeypatch.setattr(Tensor, "backward", backward_by_hand)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:

        def on_device(value: Any) -> Any:
            return mode.from_tensor(value).to("cuda") if isinstance(value, Tensor) else value

        trainer.gaussians = trainer.gaussians.map(on_device)
        for moments in (trainer.optimizer.exp_avg, trainer.optimizer.exp_avg_sq):
            moments.update({name: on_device(moment) for name, moment in moments.items()})
        for name, statistic in trainer.part(Densification).control.state_tensors().items():
            setattr(trainer.part(Densification).control, name, on_device(statistic))
        runner = trainer.runner
        runner.capacity = ops.Capacity(5000, on_device(torch.zeros(1, dtype=torch.int64)))
        runner._required = runner.capacity.required
        runner._nonfinite_rows = on_device(runner._nonfinite_rows)
        view = replace(
            view,
            camera=replace(view.camera, cam_from_world=on_device(view.camera.cam_from_world)),
            photo=LoadedImage(on_device(view.photo.planes), on_device(view.photo.mask)),
            background=on_device(torch.zeros(3)),
        )
        torch.use_deterministic_algorithms(deterministic)
        try:
            trainer._optimize(1, [view] * batch)
        finally:
            torch.use_deterministic_algorithms(False)
    order = ["project_fwd", "tiles_", "rasterize_fwd", "photometric", "rasterize_bwd", "adam_"]
    places = [min(i for i, name in enumerate(seen) if part in name) for part in order]
    assert places == sorted(places), seen
    assert ("splats_reduce" in seen) == deterministic
    assert seen.count("project_bwd") == (batch if batch > 1 else 0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use")
@every_density_control
def test_training_on_a_gpu(dataset: Dataset, config: TrainConfig) -> None:
    device = torch.device("cuda")
    config = replace(config, background="black")
    expected = losses(Trainer(dataset, config), 9)  # before the first densification
    trainer = Trainer(dataset, config, device=device)
    # A GPU draws other noise for MCMC, so only the trend is the same.
    tolerance = 0.2 if config.density == BUSY_MCMC.density else 2e-3
    torch.testing.assert_close(losses(trainer, 9), expected, rtol=tolerance, atol=0)
    trainer.run()
    assert trainer.gaussians.means.device.type == "cuda"
    assert bool(trainer.gaussians.usable_rows().all())
    again = Trainer(dataset, config, device=device)
    again.load_state({name: tensor.cpu() for name, tensor in trainer.state_tensors().items()})
    assert len(again.gaussians) == len(trainer.gaussians)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use")
def test_the_same_bits_on_a_gpu(dataset: Dataset) -> None:
    results = []
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        for _ in range(2):
            trainer = Trainer(dataset, BUSY, device=torch.device("cuda"))
            trainer.run()
            results.append(trainer.gaussians.to("cpu"))
    finally:
        torch.use_deterministic_algorithms(False)
    for name, parameter in results[0].parameters().items():
        assert torch.equal(parameter, results[1].parameters()[name]), name
