"""`Shards`: the Gaussians of a training run, distributed over processes.

Each process has a *shard*: a contiguous range of the rows of all Gaussians, with the same rows of
the moments and statistics. A step needs an exchange twice: the splats of a view go to the process
that blends the view, and their gradients come back. Everything else in a step is computed row by
row, and each process computes its own rows.

The rows of all shards in the order of the processes are the rows that a single process would have.
So a view is blended from the same rows in the same order, and the result is the same, to the bit.

`Shards` is the case of one process: its shard contains all rows, and nothing is exchanged.
`process_shards.ProcessShards` is the case of several processes.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from snowsplat import ops
from snowsplat.ops.scratch import take_rows
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer, RenderOutput, project


class Shards:
    """One process. Subclasses define several processes; each method is called by all of them.

    Attributes:
        rank: the number of this process.
        size: the number of processes.
        in_memory: the number of processes that use the memory of the device of this process.
    """

    rank = 0
    size = 1
    in_memory = 1

    # Rows

    def total(self, rows: int) -> int:
        """The number of rows of all shards; ``rows``: those of this shard."""
        return rows

    def first(self, rows: int) -> int:
        """The position of the first row of this shard in all rows."""
        return 0

    def all_rows(self, rows: Tensor) -> Tensor:
        """The rows (n, …) of each shard, one after the other, in every process."""
        return rows

    def own_rows(self, rows: Tensor) -> Tensor:
        """The part (n, …) for this process of rows that every process has."""
        return rows

    def selection(self, index: Tensor) -> Callable[[Tensor], Tensor]:
        """A function that replaces the rows of all shards by their rows ``index``, in this order.

        ``index``: (M,) int64, rows of all shards; the same in every process.

        Returns: A function from the old rows of this shard to its new ones.
        """
        return lambda rows: take_rows(rows, index)

    def select_(self, gaussians: Gaussians, index: Tensor) -> None:
        """Replace the Gaussians of all shards by their rows ``index``, in place."""
        take = self.selection(index)
        for name in tuple(gaussians.parameters()):
            setattr(gaussians, name, take(getattr(gaussians, name)))

    # The views of a round: process i blends view i.

    def exchange(self, splats: Sequence[Splats2D]) -> Splats2D | None:
        """The splats of all Gaussians in the view of this process; None if it has no view.

        ``splats``: the splats of this shard in each view of the round, at most one view for each
        process.
        """
        return splats[0]

    def return_gradients(
        self, blended: Splats2D | None, splats: Sequence[Splats2D], *, absolute: bool
    ) -> None:
        """The backward pass of `exchange`: sets ``packed.grad``, and ``abs_grad`` if it is used.

        Args:
            blended: the result of `exchange`, with its gradients.
            splats: the argument of `exchange`.
            absolute: whether ``abs_grad`` is used.
        """

    def everywhere(self, splats: Splats2D) -> Splats2D:
        """The splats of all shards in a view, in every process; without gradient."""
        return splats

    # Values

    def table(self, values: Tensor) -> Tensor:
        """(size, C): the values (C,) of each process, in every process."""
        return values[None]

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in at least one process."""
        return flag

    def of_first(self, value: Any) -> Any:
        """The value of process 0, in every process."""
        return value

    # From and to process 0

    def scattered(self, gaussians: Gaussians | None) -> Gaussians:
        """The shard of this process of the Gaussians that process 0 has; None in the others."""
        assert gaussians is not None
        return gaussians

    def collected(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The rows of all shards, by name, in process 0; the other processes get no rows."""
        return dict(tensors)

    def collect(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians of all shards in process 0; the other processes get no rows."""
        return gaussians.with_parameters(self.collected(gaussians.parameters()))


#: The only process.
ALONE = Shards()


def share(rows: int, rank: int, size: int) -> tuple[int, int]:
    """The first row of the shard of a process, and the first row after it.

    Shards begin at multiples of 64 rows. Vectorised functions of torch process the last elements of
    an array differently, with other rounding; so these must be the last rows of all shards.
    """
    blocks = -(-rows // _ALIGNMENT)
    first, end = (_ALIGNMENT * (blocks * r // size) for r in (rank, rank + 1))
    return min(first, rows), min(end, rows)


_ALIGNMENT = 64


def sharded_render(shards: Shards, *, with_depth: bool = False) -> Renderer:
    """A function that renders the Gaussians of all processes; each process must call it."""

    def render(
        gaussians: Gaussians, camera: Camera, background: Tensor, sh_degree: int | None
    ) -> RenderOutput:
        splats = shards.everywhere(project(gaussians, camera, sh_degree))
        image, alpha, depth = ops.rasterize(
            splats, camera.width, camera.height, background, with_depth=with_depth
        )
        return RenderOutput(image, alpha, depth, splats)

    return render
