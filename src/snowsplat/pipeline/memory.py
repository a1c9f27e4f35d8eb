"""The flag `--memory`: what a training takes, said before it starts, and what it took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.cli.progress import peak_bytes

if TYPE_CHECKING:
    import torch

    from snowsplat.data import Dataset
    from snowsplat.training.config import TrainConfig
    from snowsplat.training.memory_budget import MemoryPlan


@dataclass(frozen=True)
class MemoryBudget:
    """What one training takes.

    Attributes:
        device: whose memory.
        plan: with the configuration that fits.
        before: bytes that the process held when only Python and PyTorch were there.
    """

    device: torch.device
    plan: MemoryPlan
    before: int

    @classmethod
    def of(
        cls,
        asked: str | None,
        dataset: Dataset,
        config: TrainConfig,
        device: torch.device,
        before: int,
        present: int = 0,
    ) -> MemoryBudget:
        """``asked``: the flag; ``present``: Gaussians of a training that goes on.

        Raises:
            UserError: no number of bytes, or too few.
        """
        from snowsplat.data.image_loader import available_memory
        from snowsplat.training.memory_budget import parse_bytes, plan_memory

        budget = None if asked is None else parse_bytes(asked)
        available = available_memory(device)
        plan = plan_memory(dataset, config, device, available, budget, present)
        return cls(device, plan, before)

    def __str__(self) -> str:
        where = "memory of the GPU" if self.device.type == "cuda" else "memory"
        return f"{where}: {self.plan}"

    def taken(self) -> str:
        """What it took, in words."""
        if self.device.type == "cuda":
            import torch

            peak = torch.cuda.max_memory_allocated(self.device)
            return f"at most {peak / 1e6:.0f} MB of the GPU"
        peak, before = peak_bytes(), self.before
        return f"at most {peak / 1e6:.0f} MB, {before / 1e6:.0f} of them Python and PyTorch"
