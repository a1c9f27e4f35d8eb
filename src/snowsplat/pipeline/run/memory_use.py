"""`MemoryUse`: the memory plan of a training run, and its peak memory so far.

The flags of `train` use this module: torch is imported in the functions that need it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.util.messages import Message, message
from snowsplat.util.process_memory import peak_bytes

if TYPE_CHECKING:
    import torch

    from snowsplat.data import Dataset
    from snowsplat.training.budgets.memory_budget import MemoryPlan
    from snowsplat.training.settings.config import TrainConfig


@dataclass(frozen=True)
class MemoryUse:
    """The memory plan of a training run, and its peak memory so far."""

    device: torch.device  # whose memory is planned
    plan: MemoryPlan  # with the configuration that fits
    before: int  # resident bytes of the process before the training: Python and its libraries

    @classmethod
    def planned(
        cls,
        budget: int | str | None,
        dataset: Dataset,
        config: TrainConfig,
        device: torch.device,
        before: int,
        present: int = 0,
    ) -> MemoryUse:
        """Plan the memory of a training run.

        Args:
            budget: bytes, or a text such as "4GB"; None: no limit.
            present: number of Gaussians of the run that is resumed; 0 for a new run.

        Raises: UserError: ``budget`` is not a number of bytes, or is too small.
        """
        from snowsplat.data.photos.image_loader import available_memory
        from snowsplat.training.budgets.memory_budget import plan_memory
        from snowsplat.util.byte_size import parse_bytes

        if isinstance(budget, str):
            budget = parse_bytes(budget)
        available = available_memory(device)
        plan = plan_memory(dataset, config, device, available, budget, present)
        return cls(device, plan, before)

    def summary(self) -> Message:
        """The plan in a few words."""
        plan = self.plan.summary()
        if self.device.type == "cuda":
            return message("memory of the GPU: {plan}", plan=plan)
        return message("memory: {plan}", plan=plan)

    def peak(self) -> Message:
        """The peak memory so far, in a few words."""
        if self.device.type == "cuda":
            import torch

            peak = torch.cuda.max_memory_allocated(self.device)
            return message("at most {peak:.0f} MB of the GPU", peak=peak / 1e6)
        return message(
            "at most {peak:.0f} MB, {before:.0f} of them Python and its libraries",
            peak=peak_bytes() / 1e6,
            before=self.before / 1e6,
        )
