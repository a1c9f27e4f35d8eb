"""Training on the device webgpu: as on the CPU, resumed with the same bits, and what is refused."""

from dataclasses import replace

import pytest
import torch

from snowsplat import ops
from snowsplat.data import Dataset
from snowsplat.ops.webgpu import adapter
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.density.mcmc import McmcDensity
from snowsplat.training.settings.config import TrainConfig
from snowsplat.util.errors import UserError

from .test_trainer import BUSY, BUSY_MCMC, dataset, every_density_control
from .test_trainer_gpu import STEPS, losses

__all__ = ["dataset"]  # a fixture

pytestmark = [pytest.mark.webgpu, pytest.mark.slow]


@pytest.fixture(scope="module")
def device() -> torch.device:
    if (why := adapter.why_unusable()) is not None:
        pytest.skip(f"webgpu: {why}")
    return ops.resolve_device("webgpu")


def tolerance(config: TrainConfig) -> float:
    """Of the losses. With MCMC, the random numbers of a GPU are not those of the CPU."""
    return 2e-2 if isinstance(config.density, McmcDensity) else 2e-3


@every_density_control
def test_it_trains_as_the_cpu(dataset: Dataset, config: TrainConfig, device: torch.device) -> None:
    on_cpu, there = Trainer(dataset, config), Trainer(dataset, config, device=device)
    torch.testing.assert_close(losses(there), losses(on_cpu), rtol=tolerance(config), atol=0)
    assert there.gaussians.means.device == device


@pytest.mark.parametrize("config", [BUSY, BUSY_MCMC], ids=["default", "mcmc"])
def test_resumed_with_the_same_bits_also_after_a_repeated_step(
    dataset: Dataset, config: TrainConfig, device: torch.device
) -> None:
    whole, first = (Trainer(dataset, config, device=device) for _ in range(2))
    first.runner.capacity.instances = 3
    expected = losses(whole)
    assert torch.equal(losses(first, 9), expected[:9])
    state = {name: tensor.cpu() for name, tensor in first.state_tensors().items()}
    second = Trainer(dataset, config, device=device, state=state)
    second.step = first.step
    assert torch.equal(losses(second, STEPS - 9), expected[9:])
    for name, tensor in second.state_tensors().items():
        assert torch.equal(tensor, whole.state_tensors()[name]), name
    on_cpu = Trainer(dataset, config, state=state)  # a checkpoint is for every device
    on_cpu.step = first.step
    torch.testing.assert_close(losses(on_cpu, 2), expected[9:11], rtol=tolerance(config), atol=0)


@pytest.mark.parametrize(
    ("changes", "flag"), [({"batch": 2}, "--batch"), ({"refine_poses": True}, "--refine-poses")]
)
def test_what_is_missing_is_refused_by_name(
    dataset: Dataset, device: torch.device, changes: dict[str, object], flag: str
) -> None:
    with pytest.raises(UserError, match=f"^{flag}: the device webgpu"):
        Trainer(dataset, replace(BUSY, **changes), device=device)
