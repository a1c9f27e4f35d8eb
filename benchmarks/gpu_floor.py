"""Lower bounds for the stages of a training step on a GPU, from bytes and operations.

Bytes are the least that device memory must transfer: each float32 is read once and written once. If
only some columns of a splat's row (16 numbers) are read, 32 bytes are counted, the smallest access.
Data that a stage leaves for the next one is counted, although it may be in a cache. Operations are
those of one lane, without loads, index arithmetic and idle lanes; a multiply-add counts as one.
Operations are left out for stages that have few of them compared with the bytes.

    floor of a stage = max(bytes / copy bandwidth, operations / rate of multiply-adds)

Both rates are measured on the card (`gpu_parts.py device`). The bound is that of the task, not of
the kernels: a kernel that transfers data twice has a lower ratio floor / time.
"""

from dataclasses import dataclass

from snowsplat.util.native_layout import TILE

GEOMETRY = 3 + 3 + 4 + 1  # numbers per Gaussian: mean, scales, rotation, opacity
NUMBERS = GEOMETRY + 3 + 45  # and colours of SH degree 3
ROW = 64  # bytes per splat: 16 numbers
SECTOR = 32  # bytes of the smallest memory access

#: Operations per blended pair (pixel, splat) in `native/cuda/rasterize.cu`, three colours.
BLEND = {
    "d": 2,
    "log₂α": 5,
    "2^x": 1,
    "min with 0.99": 1,
    "next T": 1,
    "α ≥ 1/255, T ≥ 1e-4": 2,
    "weight": 1,
    "select weight and T": 3,
}
FORWARD = {**BLEND, "three colours": 3}
BACKWARD = {
    **BLEND,
    "g · c": 3,
    "light of this splat, of those behind": 2,
    "q": 4,
    "whether the cap acts": 1,
    "sums of weight · g": 3,
    "moments q, q dx, q dx²": 5,
}
#: Per pixel and channel: 11 taps along both axes, over 4 maps, and over 3 for the gradient.
SSIM = 2 * 11 * (4 + 3)

SORT_PASSES = 4  # 32 bits of depth, 8 at a time


@dataclass(frozen=True)
class Frame:
    """The size of the task of a training step.

    Attributes:
        seen: Gaussians that the camera sees.
        instances: pairs of a splat and a tile that it touches.
        pairs: pairs of a pixel and a splat that is blended there.
        in_order: gradients are summed in a fixed order (`--deterministic`).
    """

    gaussians: int
    seen: int
    instances: int
    pairs: int
    width: int
    height: int
    in_order: bool = False

    @property
    def pixels(self) -> int:
        return self.width * self.height

    @property
    def tiles(self) -> int:
        return -(-self.width // TILE) * -(-self.height // TILE)


@dataclass(frozen=True)
class Work:
    """What a stage must do at least: bytes to transfer and operations to compute."""

    bytes: int
    operations: int = 0

    def seconds(self, bandwidth: float, rate: float | None) -> float:
        """Seconds, from bytes per second and operations per second (None if unknown)."""
        return max(self.bytes / bandwidth, self.operations / rate if rate else 0.0)


def works(frame: Frame) -> dict[str, Work]:
    """The work by native function, in the order of a step.

    The comment above each entry lists the data that its bytes count.
    """
    n, seen, instances, pixels = frame.gaussians, frame.seen, frame.instances, frame.pixels
    found = {
        # Geometry; an id.
        "project_cull": Work(n * (4 * GEOMETRY + 4)),
        # An id and a row; for visible Gaussians, all numbers.
        "project_fwd": Work(n * (4 + ROW) + seen * 4 * NUMBERS),
        # Columns of a row; a key.
        "splats_prepare": Work(n * (SECTOR + 4)),
        # The keys, for a histogram; then keys and values, read and written in each pass. The first
        # pass does not read the values, which are 0, 1, ….
        "splats_sort": Work(n * (4 + SORT_PASSES * 16 - 4)),
        # The order and columns of a row; four numbers for tiles_fill, one of them a running sum.
        "tiles_count": Work(n * (4 + SECTOR + 16 + 8)),
        "tiles_fill": Work(_fill_bytes(frame)),
        # The splat of an instance and its part in the tile; tiles; rows once; four planes.
        "rasterize_fwd": Work(
            instances * (4 + 1) + frame.tiles * 8 + seen * ROW + pixels * 16,
            frame.pairs * sum(FORWARD.values()),
        ),
        # Image and photo (8 bits); the gradient of the image.
        "photometric_u8": Work(pixels * (12 + 3 + 12), pixels * 3 * SSIM),
        # The same lists and rows; the image, its gradient and alpha; the sums of the gradients, in
        # rows or in slots.
        "rasterize_bwd": Work(
            instances * (4 + 1)
            + frame.tiles * 8
            + seen * ROW
            + pixels * (12 + 12 + 4)
            + (instances * (4 + ROW) if frame.in_order else seen * ROW),
            frame.pairs * sum(BACKWARD.values()),
        ),
        # An id; for visible Gaussians, columns of the gradient, and two sums, read and written.
        "accumulate_screen_statistics": Work(n * 4 + seen * (SECTOR + 16)),
        # Values and two moments, read and written; an id; the gradients of visible splats.
        "adam_step": Work(n * (NUMBERS * 4 * 6 + 4) + seen * ROW),
    }
    if frame.in_order:
        # Slots and their positions per splat; part of its row; the gradient.
        reduce = Work(instances * ROW + n * (8 + ROW) + seen * SECTOR)
        names = list(found)
        after = names.index("rasterize_bwd") + 1
        found = {
            **{name: found[name] for name in names[:after]},
            "splats_reduce": reduce,
            **{name: found[name] for name in names[after:]},
        }
    return found


def _fill_bytes(frame: Frame) -> int:
    """Bytes of tiles_fill: it reads the output of tiles_count, the order and part of the rows, and
    writes the instances and sorts them by tile."""
    n, instances = frame.gaussians, frame.instances
    bits = frame.tiles.bit_length()
    key, passes = (2 if bits <= 16 else 4), -(-bits // 8)
    pair = key + 4
    written = n * (16 + 4) + frame.seen * SECTOR + instances * pair
    ordered = instances * (key + passes * 2 * pair)
    starts = instances * key + frame.tiles * 4
    if frame.in_order:
        # The sort moves slots 0, 1, …; then each slot fetches its splat.
        return written + ordered + starts + n * 8 + instances * (4 + 4 + 4 - 4)
    return written + ordered + starts
