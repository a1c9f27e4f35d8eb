"""Floors for the stages of a training step on a GPU: the bytes that have to move, the operations.

Bytes are those that device memory moves at least, each number read once and written once, float32;
where some columns of a splat's row (16 numbers) are read, 32 bytes, the least that memory gives.
What a stage leaves for the next one is counted, though caches may hold some of it. Operations are
those of one lane, without loads, index arithmetic, and lanes that lie idle; a multiply-add is one.
Where they are few beside the bytes, they are left out.

    floor of a stage = max(bytes / copy bandwidth, operations / rate of multiply-adds)

with both rates measured on the card (`gpu_parts.py device`). The floor is that of the work, not of
the kernels: what these move twice shows in their share of it.
"""

from __future__ import annotations

from dataclasses import dataclass

TILE = 16
GEOMETRY = 3 + 3 + 4 + 1  # numbers of a Gaussian: mean, scales, rotation, opacity
NUMBERS = GEOMETRY + 3 + 45  # and colours of degree 3
ROW = 64  # bytes of a splat: 16 numbers
SECTOR = 32  # bytes

#: Operations for a blended pair (pixel, splat) in `native/cuda/blend.cu`, three colours.
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
#: Of a pixel and channel: 11 taps along both axes, over 4 maps, and over 3 for the gradient.
SSIM = 2 * 11 * (4 + 3)

SORT_PASSES = 4  # 32 bits of depth, 8 at a time


@dataclass(frozen=True)
class Frame:
    """What a step has to do.

    Attributes:
        seen: Gaussians that the camera sees.
        instances: pairs of a splat and a tile that it touches.
        pairs: of a pixel and a splat that is blended there.
        in_order: the sums of gradients are added in a fixed order (`--deterministic`).
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
    bytes: int
    operations: int = 0

    def seconds(self, bandwidth: float, rate: float | None) -> float:
        """Of bytes a second; of operations a second, or None where that is not known."""
        return max(self.bytes / bandwidth, self.operations / rate if rate else 0.0)


def works(frame: Frame) -> dict[str, Work]:
    """By native function, in the order of a step."""
    n, seen, instances, pixels = frame.gaussians, frame.seen, frame.instances, frame.pixels
    found = {
        # The geometry, ids.
        "project_cull": Work(n * (4 * GEOMETRY + 4)),
        # ids and a row for each, all numbers of those that are seen.
        "project_fwd": Work(n * (4 + ROW) + seen * 4 * NUMBERS),
        # Columns of a row, a key.
        "splats_prepare": Work(n * (SECTOR + 4)),
        # A histogram of the keys; then keys and values in and out. The first values are 0, 1, ….
        "splats_sort": Work(n * (4 + SORT_PASSES * 16 - 4)),
        # The order and columns of a row; four numbers for tiles_fill, one of them summed up.
        "tiles_count": Work(n * (4 + SECTOR + 16 + 8)),
        "tiles_fill": Work(_fill_bytes(frame)),
        # An instance's splat, and what of the tile it touches; tiles; rows once; four planes.
        "blend_fwd": Work(
            instances * (4 + 1) + frame.tiles * 8 + seen * ROW + pixels * 16,
            frame.pairs * sum(FORWARD.values()),
        ),
        # Image and photo (8 bits), the gradient.
        "photometric_u8": Work(pixels * (12 + 3 + 12), pixels * 3 * SSIM),
        # The same lists, rows, image, its gradient and alpha; the sums, in rows or in slots.
        "blend_bwd": Work(
            instances * (4 + 1)
            + frame.tiles * 8
            + seen * ROW
            + pixels * (12 + 12 + 4)
            + (instances * (4 + ROW) if frame.in_order else seen * ROW),
            frame.pairs * sum(BACKWARD.values()),
        ),
        # Ids; of those that are seen, columns of the gradient, and two sums in and out.
        "accumulate_screen_statistics": Work(n * 4 + seen * (SECTOR + 16)),
        # Values and two moments in and out, ids, gradients of the splats.
        "adam_step": Work(n * (NUMBERS * 4 * 6 + 4) + seen * ROW),
    }
    if frame.in_order:
        # Slots, where those of a splat lie, some of its row; the gradient.
        reduce = Work(instances * ROW + n * (8 + ROW) + seen * SECTOR)
        names = list(found)
        after = names.index("blend_bwd") + 1
        found = {
            **{name: found[name] for name in names[:after]},
            "splats_reduce": reduce,
            **{name: found[name] for name in names[after:]},
        }
    return found


def _fill_bytes(frame: Frame) -> int:
    """What tiles_count left, the order, some of the rows; instances written, and sorted by tile."""
    n, instances = frame.gaussians, frame.instances
    bits = frame.tiles.bit_length()
    key, passes = (2 if bits <= 16 else 4), -(-bits // 8)
    pair = key + 4
    written = n * (16 + 4) + frame.seen * SECTOR + instances * pair
    ordered = instances * (key + passes * 2 * pair)
    starts = instances * key + frame.tiles * 4
    if frame.in_order:
        # What is sorted are slots, numbered 0, 1, …; then each fetches its splat.
        return written + ordered + starts + n * 8 + instances * (4 + 4 + 4 - 4)
    return written + ordered + starts
