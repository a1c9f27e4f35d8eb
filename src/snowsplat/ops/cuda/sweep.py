"""`plane_sweep` on a GPU."""

from __future__ import annotations

from collections.abc import Callable

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.params import PlaneSweepParams

_EDGE = 16  # of the tile of a block, in pixels

KERNELS: dict[str, Kernel] = {
    "plane_sweep": Kernel("plane_sweep", PlaneSweepParams, threads=_EDGE**2, items=1)
}


def plane_sweep(run: Run, suffix: str, p: PlaneSweepParams) -> int:
    run("plane_sweep" + suffix, -(-p.width // _EDGE) * -(-p.height // _EDGE), p)
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {"plane_sweep": plane_sweep}
