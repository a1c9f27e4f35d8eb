"""The kernels for GPUs: the file of each, and how it is launched."""

from dataclasses import dataclass
from typing import Protocol

from snowsplat.util.native_layout import MAX_NEIGHBOURS, SLOT_WIDTH, Fields

SWEEP_EDGE = 16  # of the tile of a block of `plane_sweep`, in pixels
NEIGHBOUR_LISTS = (1, 3, 8, MAX_NEIGHBOURS)  # numbers of neighbours that have a search kernel


@dataclass(frozen=True)
class Kernel:
    """A kernel in `native/cuda/<file>.cu`; its variant for float64 has the suffix `_f64`.

    threads: number of threads of a block, as in the SNOW_KERNEL macro.
    items: number of items that a block processes.
    """

    file: str
    threads: int
    items: int

    def blocks(self, n: int) -> int:
        """The number of blocks for n items."""
        return -(-n // self.items)


class Run(Protocol):
    """Queues a kernel. ``name``: its full name; ``fields``: those of its struct, as of a launch;
    ``blocks``: by default those for the n items of the struct; 0 queues nothing."""

    def __call__(self, name: str, fields: Fields, blocks: int | None = None, /) -> None: ...


#: By name. Most native functions are one kernel with the same name and parameters; `launches` has
#: the others.
KERNELS: dict[str, Kernel] = {
    "project_cull": Kernel("project", 256, 256),
    "project_fwd": Kernel("project", 64, 64),
    "project_bwd": Kernel("project", 64, 64),
    "project_pose_sum": Kernel("project", 512, 512),
    "accumulate_screen_statistics": Kernel("statistic", 256, 256),
    "adam_splat_of": Kernel("adam", 256, 256),
    "adam_update": Kernel("adam", 64, 64),
    "add_noise": Kernel("noise", 128, 128),
    "scan_sums": Kernel("sort", 256, 1024),
    "scan_of_sums": Kernel("sort", 256, 256),
    "scan_apply": Kernel("sort", 256, 1024),
    "sort_offsets": Kernel("sort", 256, 1024),
    "sort_count_u16": Kernel("sort", 256, 4096),
    "sort_count_u32": Kernel("sort", 256, 4096),
    "sort_count_u64": Kernel("sort", 256, 2048),
    "sort_scatter_u16": Kernel("sort", 256, 4096),
    "sort_scatter_u32": Kernel("sort", 256, 4096),
    "sort_scatter_u64": Kernel("sort", 256, 2048),
    **{
        f"sort_{step}_few_{key}": Kernel("sort", 256, 1024)
        for step in ("count", "scatter")
        for key in ("u16", "u32")
    },
    "splats_prepare": Kernel("tiles", 256, 256),
    "tiles_count": Kernel("tiles", 256, 256),
    "tiles_fill": Kernel("tiles", 256, 256),
    "tiles_start_u16": Kernel("tiles", 256, 256),
    "tiles_start_u32": Kernel("tiles", 256, 256),
    "tiles_gather": Kernel("tiles", 256, 256),
    "splats_reduce": Kernel("tiles", 256, 256 // SLOT_WIDTH),
    "rasterize_fwd": Kernel("rasterize", 256, 1),
    "rasterize_median": Kernel("rasterize", 256, 1),
    "rasterize_count": Kernel("rasterize", 256, 1),
    "rasterize_bwd": Kernel("rasterize", 256, 1),
    "background_bwd": Kernel("rasterize", 128, 1),
    "photometric_similarity": Kernel("photometric", 192, 1),
    "photometric_similarity_u8": Kernel("photometric", 192, 1),
    "photometric_gradient": Kernel("photometric", 192, 1),
    "photometric_gradient_u8": Kernel("photometric", 192, 1),
    "photometric_means": Kernel("photometric", 256, 256),
    "neighbours_codes": Kernel("neighbours", 128, 128),
    "neighbours_chunks": Kernel("neighbours", 128, 128),
    "neighbours_groups": Kernel("neighbours", 128, 128),
    **{f"neighbours_of_{k}": Kernel("neighbours", 128, 128) for k in NEIGHBOUR_LISTS},
    "plane_sweep": Kernel("plane_sweep", SWEEP_EDGE**2, 1),
    "points_in_frusta": Kernel("frusta", 128, 128),
    "points_in_spheres": Kernel("frusta", 128, 128),
    "fuse_depth": Kernel("fusion", 128, 128),
}
