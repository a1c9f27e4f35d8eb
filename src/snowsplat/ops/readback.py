"""`Readback`: figures of a device on their way to the CPU, while the device goes on."""

from __future__ import annotations

import torch
from torch import Tensor


class Readback:
    """Carries numbers from a device to the CPU behind the work that is queued there already.

    `post` queues the copy; `wait` waits for it, not for what was queued afterwards: between the two
    a GPU can be given the rest of a step. On the CPU both are immediate.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        """``count``: how many float64 numbers go at a time."""
        on_gpu = device.type == "cuda"
        self._numbers = torch.zeros(count, dtype=torch.float64, pin_memory=on_gpu)
        self._arrived = torch.cuda.Event() if on_gpu else None
        self._device = device

    def post(self, *numbers: Tensor) -> None:
        """``numbers``: tensors on the device, with ``count`` elements together."""
        gathered = torch.cat([number.detach().double().reshape(-1) for number in numbers])
        self._numbers.copy_(gathered, non_blocking=True)
        if self._arrived is not None:
            self._arrived.record(torch.cuda.current_stream(self._device))

    def wait(self) -> list[float]:
        """What was posted last."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return self._numbers.tolist()
