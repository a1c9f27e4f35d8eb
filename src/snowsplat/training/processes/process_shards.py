"""`ProcessShards`: `Shards` of several processes, with `torch.distributed`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from snowsplat.ops import scratch
from snowsplat.ops.scratch import take_rows
from snowsplat.ops.splats import COLORS, Splats2D, packed_width
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.processes.shards import Shards, share


class ProcessShards(Shards):
    """The processes of the default group of `torch.distributed`, which must be initialised.

    Attributes:
        sent_bytes: number of bytes of splats and gradients that this process has sent to other
            processes.
    """

    def __init__(self, device: torch.device, in_memory: int = 1) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self.in_memory = in_memory
        self.sent_bytes = 0
        self._device = device
        self._received: list[int] = []  # rows of the last exchange, for each sender

    # Rows

    def _counts(self, rows: int) -> list[int]:
        """The number of rows of each shard."""
        own = torch.tensor([rows], dtype=torch.int64, device=self._device)
        return [int(n) for n in self.table(own)[:, 0].tolist()]

    def total(self, rows: int) -> int:
        return sum(self._counts(rows))

    def first(self, rows: int) -> int:
        return sum(self._counts(rows)[: self.rank])

    def all_rows(self, rows: Tensor) -> Tensor:
        counts = self._counts(len(rows))
        return self._all_rows(rows, counts)

    def _all_rows(self, rows: Tensor, counts: list[int]) -> Tensor:
        whole = rows.new_empty(sum(counts), *rows.shape[1:])
        parts = list(whole.split(counts))
        rows = rows.contiguous()
        for rank, part in enumerate(parts):  # one at a time: shards have different sizes
            if rank == self.rank:
                part.copy_(rows)
            if len(part):
                dist.broadcast(part, src=rank)
        return whole

    def own_rows(self, rows: Tensor) -> Tensor:
        first, end = share(len(rows), self.rank, self.size)
        return rows[first:end].clone()

    def selection(self, index: Tensor) -> Callable[[Tensor], Tensor]:
        bounds = [share(len(index), rank, self.size) for rank in range(self.size)]
        plan: list[tuple[Tensor, list[int], list[int], Tensor]] = []

        def planned(rows: int) -> tuple[Tensor, list[int], list[int], Tensor]:
            counts = self._counts(rows)
            starts = torch.tensor([0, *counts], device=index.device).cumsum(0)
            first, end = starts[self.rank], starts[self.rank + 1]
            send, sizes = [], []
            for low, high in bounds:  # what each process needs of this shard
                wanted = index[low:high]
                mine = wanted[(wanted >= first) & (wanted < end)] - first
                send.append(mine)
                sizes.append(len(mine))
            low, high = bounds[self.rank]
            owner = torch.searchsorted(starts[1:].contiguous(), index[low:high], right=True)
            # Rows arrive in the order of their senders, and within a sender in that of `index`.
            place = torch.argsort(owner, stable=True)
            received = torch.bincount(owner, minlength=self.size).tolist()
            return torch.cat(send), sizes, received, place

        def take(rows: Tensor) -> Tensor:
            if not plan:
                plan.append(planned(len(rows)))
            send, sizes, received, place = plan[0]
            width = rows[0:1].numel() if len(rows) else rows.new_empty(1, *rows.shape[1:]).numel()
            out = rows.new_empty(sum(received), width)
            inputs = take_rows(rows, send).reshape(len(send), width)
            dist.all_to_all_single(out, inputs, received, sizes)
            result = torch.empty_like(out)
            result[place] = out
            return result.reshape(len(result), *rows.shape[1:])

        return take

    # The views of a round

    def exchange(self, splats: Sequence[Splats2D]) -> Splats2D | None:
        columns = COLORS + splats[0].channels
        sizes = [len(view) for view in splats] + [0] * (self.size - len(splats))
        counts = self.table(torch.tensor(sizes, device=self._device))
        self._received = counts[:, self.rank].tolist()
        sent = self._rows_like(splats[0].packed, sum(sizes), columns)
        parts = sent.split(sizes[: len(splats)])
        for view, part in zip(splats, parts, strict=True):
            part.copy_(view.packed.detach()[:, :columns])
        rows = self._rows_like(sent, sum(self._received), columns)
        dist.all_to_all_single(rows, sent, self._received, sizes)
        self._count(sizes, columns)
        if self.rank >= len(splats):
            return None
        packed = self._rows_like(rows, len(rows), packed_width(splats[0].channels))
        packed[:, :columns] = rows
        packed[:, columns:] = 0.0
        return Splats2D(packed, None, splats[0].channels)

    def return_gradients(
        self, blended: Splats2D | None, splats: Sequence[Splats2D], *, absolute: bool
    ) -> None:
        columns = COLORS + splats[0].channels
        width = columns + 2 * absolute
        sent = self._rows_like(splats[0].packed, 0 if blended is None else len(blended), width)
        if blended is not None:
            assert blended.packed.grad is not None
            sent[:, :columns] = blended.packed.grad[:, :columns]
            if absolute:
                assert blended.abs_grad is not None
                sent[:, columns:] = blended.abs_grad
        sizes = [len(view) for view in splats]
        rows = self._rows_like(sent, sum(sizes), width)
        sizes += [0] * (self.size - len(splats))
        dist.all_to_all_single(rows, sent, sizes, self._received)
        self._count(self._received, width)
        for view, part in zip(splats, rows.split(sizes[: len(splats)]), strict=True):
            grad = self._rows_like(rows, *view.packed.shape)
            grad[:, :columns] = part[:, :columns]
            grad[:, columns:] = 0.0
            view.packed.grad = grad
            if absolute:
                view.abs_grad = part[:, columns:].contiguous()

    @staticmethod
    def _rows_like(like: Tensor, rows: int, columns: int) -> Tensor:
        """Uninitialised memory, which every step uses again."""
        return scratch.empty((rows, columns), like.dtype, like.device)

    def _count(self, rows: list[int], columns: int) -> None:
        to_others = sum(rows) - rows[self.rank]
        self.sent_bytes += 4 * columns * to_others

    def everywhere(self, splats: Splats2D) -> Splats2D:
        splats = splats.without_empty_rows()
        return Splats2D(self.all_rows(splats.packed.detach()), None, splats.channels)

    # Values

    def table(self, values: Tensor) -> Tensor:
        parts = [torch.empty_like(values) for _ in range(self.size)]
        dist.all_gather(parts, values.contiguous())
        return torch.stack(parts)

    def any(self, flag: bool) -> bool:
        return bool(self.table(torch.tensor([flag], device=self._device)).any())

    def of_first(self, value: Any) -> Any:
        values = [value]
        dist.broadcast_object_list(values, src=0, device=self._device)
        return values[0]

    # From and to process 0

    def scattered(self, gaussians: Gaussians | None) -> Gaussians:
        shapes = self.of_first(
            None if gaussians is None else {n: t.shape for n, t in gaussians.parameters().items()}
        )
        assert shapes is not None
        count = shapes["means"][0]
        first, end = share(count, self.rank, self.size)
        if gaussians is None:
            own = {
                name: torch.empty(end - first, *shape[1:], device=self._device)
                for name, shape in shapes.items()
            }
            for tensor in own.values():
                if tensor.numel():
                    dist.recv(tensor, src=0)
            return Gaussians(*own.values())
        for tensor in gaussians.parameters().values():
            for rank in range(1, self.size):
                low, high = share(count, rank, self.size)
                if tensor[low:high].numel():
                    dist.send(tensor[low:high].contiguous(), dst=rank)
        return gaussians.map(lambda tensor: tensor[first:end].clone())

    def collected(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        whole = {}
        for name, rows in tensors.items():
            counts = self._counts(len(rows))
            if self.rank > 0:
                if rows.numel():
                    dist.send(rows.contiguous(), dst=0)
                whole[name] = rows[:0]
                continue
            parts = [rows.new_empty(n, *rows.shape[1:]) for n in counts]
            parts[0] = rows
            for rank, part in enumerate(parts):
                if rank > 0 and part.numel():
                    dist.recv(part, src=rank)
            whole[name] = torch.cat(parts)
        return whole
