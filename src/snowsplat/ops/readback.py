"""`Readback`: copies values from a device to the CPU while the device continues to compute."""

import torch
from torch import Tensor


class Readback:
    """An asynchronous copy of a few numbers from a device to the CPU.

    `start` queues the copy. `wait` waits until the copy is done, but not for work that was queued
    after it. So the rest of a step can be queued on a GPU between the two calls. On the CPU, the
    copy is made immediately.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        """``count``: the number of float64 values of each copy."""
        on_gpu = device.type == "cuda"
        self._values = torch.zeros(count, dtype=torch.float64, pin_memory=on_gpu)
        self._copied = torch.cuda.Event() if on_gpu else None
        self._device = device

    def start(self, *values: Tensor) -> None:
        """Queues a copy of ``values``, tensors on the device with ``count`` elements in total."""
        gathered = torch.cat([value.detach().double().reshape(-1) for value in values])
        self._values.copy_(gathered, non_blocking=True)
        if self._copied is not None:
            self._copied.record(torch.cuda.current_stream(self._device))

    def wait(self) -> list[float]:
        """The values of the last copy."""
        if self._copied is not None:
            self._copied.synchronize()
        return self._values.tolist()
