"""Sorting splats into tiles on a GPU: radix sort, prefix sums, tile lists."""

import itertools
import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat.ops import native as natives
from snowsplat.ops.cuda import tiling
from snowsplat.ops.cuda.kernels import KERNELS, Run
from snowsplat.util.native_layout import TILE, Fields

from . import emulation
from .conftest import variants
from .engines import execute_on_gpu
from .scenes import (
    CUDA_FLOAT32,
    EMULATED_FLOAT32,
    Variant,
    assert_close,
    generator,
    normal,
    random_splats,
    uniform,
)

BLOCK = 4096  # keys of a block of the sort of many keys
CPU = natives.LAUNCHERS["cpu"]


@pytest.fixture(params=variants(EMULATED_FLOAT32, CUDA_FLOAT32))
def run(request: pytest.FixtureRequest) -> Run:
    """Runs GPU kernels on CPU tensors."""
    variant: Variant = request.param
    if variant.engine == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use")
    execute = emulation.execute if variant.engine == "emulated" else execute_on_gpu

    def queue(name: str, fields: Fields, blocks: int | None = None) -> None:
        kernel = KERNELS[name.removesuffix("_f64")]
        count = kernel.blocks(fields["n"]) if blocks is None else blocks
        if count > 0:
            execute(kernel, name, count, fields)

    return queue


def random_keys(seed: int, n: int, dtype: torch.dtype, distinct: int = 2**62) -> Tensor:
    """Keys with all bits random, or few different keys."""
    values = torch.randint(-(2**62), 2**62, (n,), generator=generator(seed)) * 2 + 1
    return ((values.abs() % distinct) if distinct < 2**62 else values).to(dtype)


def unsigned(keys: Tensor) -> list[int]:
    bits = 8 * keys.element_size()
    return [int(k) % 2**bits for k in keys.tolist()]


def sort(
    run: Run, keys: Tensor, bits: tuple[int, int], count: int | None = None
) -> tuple[Tensor, Tensor]:
    """The sorted keys and their original indices; the memory around the results stays unchanged."""
    n = len(keys)
    dtypes = (keys.dtype, keys.dtype, torch.int32, torch.int32)
    a, b, c, d = (torch.full((n + 8,), 99, dtype=dtype) for dtype in dtypes)
    a[:n] = keys
    there = None if count is None else torch.tensor([count])
    got, values = tiling.sort_pairs(run, n, a, b, c, d, bits, count=there, rows=True)
    for tensor in (a, b, c, d):
        assert (tensor[n:] == 99).all()
    return got[:n], values[:n]


@pytest.mark.parametrize("n", [0, 1, 2, 31, 33, 1023, 1024, 1025, BLOCK - 1, 2 * BLOCK + 77])
@pytest.mark.parametrize("dtype", [torch.int16, torch.int32, torch.int64])
def test_sort_is_a_stable_sort(run: Run, dtype: torch.dtype, n: int) -> None:
    few = n % 2 == 0
    keys = random_keys(n, n, dtype, distinct=5 if few else 2**62)
    begin, end = 0, 8 * dtype.itemsize
    if n >= BLOCK - 1 and dtype == torch.int64:  # to save time
        begin, end = (0, 16) if few else (48, 64)
    plain = [k >> begin & (2 ** (end - begin) - 1) for k in unsigned(keys)]
    got, values = sort(run, keys, (begin, end))
    wanted = sorted(range(n), key=lambda i: plain[i])
    assert values.tolist() == wanted
    assert torch.equal(got, keys[wanted])


@pytest.mark.parametrize("bits", [(0, 1), (0, 7), (3, 13), (0, 9), (8, 32), (31, 32)])
def test_sort_by_some_bits(run: Run, bits: tuple[int, int]) -> None:
    keys = random_keys(3, 300, torch.int32)
    begin, end = bits
    plain = [k >> begin & (2 ** (end - begin) - 1) for k in unsigned(keys)]
    assert sort(run, keys, bits)[1].tolist() == sorted(range(300), key=lambda i: plain[i])


@pytest.mark.parametrize("n", [700, BLOCK, BLOCK + 1, 2 * BLOCK + 77])
@pytest.mark.parametrize("dtype", [torch.int16, torch.int32, torch.int64])
@pytest.mark.parametrize("most_added", [0, 2])
def test_sort_as_for_many_keys(
    run: Run, dtype: torch.dtype, n: int, most_added: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More keys per block; a kernel of its own adds the counts of the blocks."""
    monkeypatch.setattr(tiling, "FEW", 0)
    monkeypatch.setattr(tiling, "MOST_ADDED", most_added)
    keys = random_keys(n, n, dtype)
    plain = [k & 0xFFFF for k in unsigned(keys)]
    got, values = sort(run, keys, (0, 16))
    wanted = sorted(range(n), key=lambda i: plain[i])
    assert values.tolist() == wanted
    assert torch.equal(got, keys[wanted])


@pytest.mark.parametrize("most_added", [0, 128])
@pytest.mark.parametrize("count", [0, 1, 700, BLOCK, BLOCK + 5, 2 * BLOCK, 10**12])
def test_sort_of_a_count_on_the_device(
    run: Run, count: int, most_added: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiling, "MOST_ADDED", most_added)
    keys = random_keys(4, 2 * BLOCK, torch.int16, distinct=50)
    there = min(count, 2 * BLOCK)
    got, values = sort(run, keys, (0, 6), count)
    wanted = sorted(range(there), key=lambda i: int(keys[i]))
    assert values[:there].tolist() == wanted
    assert torch.equal(got[:there], keys[wanted])


def test_sort_of_given_values(run: Run) -> None:
    keys, values = random_keys(5, 500, torch.int32), torch.arange(500, dtype=torch.int32) * 7 - 900
    order = torch.tensor(sorted(range(500), key=lambda i: unsigned(keys)[i]))
    wanted = values[order]
    spare = torch.empty_like(keys), torch.empty_like(values)
    got = tiling.sort_pairs(run, 500, keys.clone(), spare[0], values.clone(), spare[1], (0, 32))
    assert torch.equal(got[0], keys[order])
    assert torch.equal(got[1], wanted)


@pytest.mark.parametrize("n", [0, 1, 3, 4, 1023, 1024, 1025, 5000])
@pytest.mark.parametrize("in_place", [False, True])
def test_exclusive_scan(run: Run, n: int, in_place: bool) -> None:
    values = torch.randint(0, 1000, (n + 1,), generator=generator(n), dtype=torch.int32)
    wanted = [0, *values[:n].cumsum(0).tolist()]
    out = values if in_place else torch.full_like(values, 77)
    margin = int(out[n])
    total = torch.full((1,), -5)
    tiling.exclusive_scan(run, n, values, out, total)
    assert out.tolist() == [*wanted[:n], margin]
    assert total.item() == wanted[n]


def test_exclusive_scan_of_more_blocks_than_threads(run: Run) -> None:
    n = 300 * 1024 + 5
    values, out = torch.ones(n, dtype=torch.int32), torch.empty(n, dtype=torch.int32)
    total = torch.zeros(1, dtype=torch.int64)
    tiling.exclusive_scan(run, n, values, out, total)
    assert torch.equal(out, torch.arange(n, dtype=torch.int32))
    assert total.item() == n


def test_exclusive_scan_beyond_32_bits(run: Run) -> None:
    most = 2**31 - 1
    values, out = torch.full((2000,), most, dtype=torch.int32), torch.zeros(2000, dtype=torch.int32)
    total = torch.zeros(1, dtype=torch.int64)
    tiling.exclusive_scan(run, 2000, values, out, total)
    assert unsigned(out) == [min(i * most, 2**32 - 1) for i in range(2000)]
    assert total.item() == 2000 * most


# ---- Splats into tiles ---------------------------------------------------------------------------


@dataclass
class Binned:
    """The input of the compositing, and the number of instances that it needs."""

    rows: list[list[int]]  # rows of the splats of each tile, in order
    slots: list[list[int]] | None  # the numbers of these instances
    ranges: list[list[int]] | None  # of the slots of each row
    needed: int


def bin_splats(
    native: Variant,
    packed: Tensor,
    width: int,
    height: int,
    *,
    capacity: int = -1,
    with_slots: bool = True,
    surplus: int = 0,
) -> Binned:
    """Sort splats into tiles as `rasterize` does; the memory around the results stays unchanged.

    The CPU has no slots. On a GPU, `surplus` more tiles are counted for the farthest splat.
    """
    with_slots &= native.engine != "native"
    with_slots |= native.engine == "webgpu"  # it always has them
    suffix = "" if native.dtype == torch.float32 else "_f64"
    packed = packed.to(native.dtype).contiguous()
    m, stride = packed.shape
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tiles = tiles_x * tiles_y
    guarded: list[tuple[Tensor, int]] = []

    def empty(size: int, dtype: torch.dtype = torch.int32) -> Tensor:
        tensor = torch.full((size + 8,), 99, dtype=dtype)
        guarded.append((tensor, size))
        return tensor

    def launch(name: str, **fields: Any) -> int:
        return natives.launch(name + suffix, **fields)

    columns = torch.tensor([8, 9, 10, -1])
    key = torch.int32 if native.dtype == torch.float32 else torch.int64
    keys, keys2, order, order2 = empty(m, key), empty(m, key), empty(m), empty(m)
    records = empty(
        m * natives.query_size("splat_record_bytes" + suffix, packed.device), torch.uint8
    )
    launch(
        "splats_prepare",
        n=m,
        packed=packed,
        stride=stride,
        width=width,
        height=height,
        columns=columns,
        records=records,
        keys=keys,
    )
    launch("splats_sort", n=m, keys=keys, keys2=keys2, order=order, order2=order2)
    assert sorted(order[:m].tolist()) == list(range(m))
    parts = natives.query_size("tiles_parts", packed.device, m)
    size = natives.query_size("tiles_workspace_bytes", packed.device, m, tiles, parts)
    workspace, tile_start = torch.empty(size, dtype=torch.uint8), empty(tiles + 1)
    needed = torch.full((1,), -5)
    binning = {
        "order": order,
        "packed": packed,
        "stride": stride,
        "records": records,
        "tiles_x": tiles_x,
        "tiles_y": tiles_y,
        "parts": parts,
        "workspace": workspace,
        "tile_start": tile_start,
    }
    count = launch("tiles_count", n=m, binning=binning, capacity=capacity, required=needed)
    if native.engine != "native" and capacity >= 0:
        assert count == capacity
    if surplus:
        workspace[:8].view(torch.int64).add_(surplus)
        counts = 0 if native.engine == "webgpu" else 2  # the row of the workspace
        workspace[16:].view(torch.int32).view(4, m)[counts, -1] += surplus
        count += surplus
    instance_splat, instance_slot, slot_range = empty(count), empty(count), empty(2 * m)
    launch(
        "tiles_fill",
        n=m,
        binning=binning,
        capacity=count,
        instance_splat=instance_splat,
        instance_slot=instance_slot if with_slots else None,
        slot_range=slot_range if with_slots else None,
    )
    for tensor, length in guarded:
        assert (tensor[length:] == 99).all()
    start = tile_start[: tiles + 1].tolist()
    assert start[0] == 0
    if capacity < 0:
        assert start[tiles] == needed.item() == count - surplus
    spans = list(itertools.pairwise(start))
    splats, slots = instance_splat.tolist(), instance_slot.tolist()
    return Binned(
        [splats[begin:end] for begin, end in spans],
        [slots[begin:end] for begin, end in spans] if with_slots else None,
        slot_range[: 2 * m].view(m, 2).tolist() if with_slots else None,
        int(needed.item()),
    )


def least_on_edge(a: float, b: float, c: float, fixed: float, low: float, high: float) -> float:
    """The minimum of a f² + 2 b f t + c t² for t in [low, high]."""
    t = min(max(-b * fixed / c, low), high)
    return a * fixed * fixed + 2 * b * fixed * t + c * t * t


def touched_tiles(row: list[float], width: int, height: int, margin: float) -> set[int]:
    """The definition: tiles whose pixel centres span a rectangle in which α reaches about 1/255.

    Only the tiles of the rectangle around the ellipse α ≥ 1/255 are considered. If this is a single
    tile, it counts as touched. A margin > 0 adds tiles that are nearly touched; a margin < 0
    removes tiles that are barely touched.
    """
    x, y, a, b, c, opacity = row[:6]
    tiles_x = -(-width // TILE)
    det = a * c - b * b
    if not (opacity >= 1 / 255 and det > 0 and math.isfinite(x + y)):
        return set()
    reach = 2 * math.log(255 * opacity)
    ex, ey = math.sqrt(reach * c / det) + margin, math.sqrt(reach * a / det) + margin
    x0, x1 = max(x - ex - 0.5, 0), min(x + ex - 0.5, width - 1)
    y0, y1 = max(y - ey - 0.5, 0), min(y + ey - 0.5, height - 1)
    if x1 < x0 or y1 < y0:
        return set()
    columns = range(int(x0) // TILE, int(x1) // TILE + 1)
    rows = range(int(y0) // TILE, int(y1) // TILE + 1)
    slack = 2 * math.log(2) * 1e-3
    touched = set()
    for j in rows:
        for i in columns:
            left, top = i * TILE + 0.5 - x, j * TILE + 0.5 - y
            right, bottom = left + TILE - 1, top + TILE - 1
            inside = left <= 0 <= right and top <= 0 <= bottom
            edges = [least_on_edge(a, b, c, u, top, bottom) for u in (left, right)]
            edges += [least_on_edge(c, b, a, v, left, right) for v in (top, bottom)]
            least = 0.0 if inside else min(edges)
            if least <= reach + slack + margin or len(columns) * len(rows) == 1:
                touched.add(j * tiles_x + i)
    return touched


def check_binning(native: Variant, packed: Tensor, width: int, height: int) -> Binned:
    """Each tile has the splats that touch it, in order of depth; slots are numbered by splat."""
    got = bin_splats(native, packed, width, height)
    rows = packed.to(native.dtype).double().tolist()
    margin = 1e-3 if native.dtype == torch.float32 else 1e-9
    whole = [-(-size // TILE) * TILE for size in (width, height)]
    of_row: dict[int, dict[int, int]] = {row: {} for row in range(len(rows))}
    all_slots = got.rows if got.slots is None else got.slots
    for tile, (splats, slots) in enumerate(zip(got.rows, all_slots, strict=True)):
        if not splats:
            continue
        assert splats == sorted(splats, key=lambda row: (rows[row][6], row)), f"tile {tile}"
        for row, slot in zip(splats, slots, strict=True):
            assert tile not in of_row[row]
            of_row[row][tile] = slot
    for row, tiles in of_row.items():
        values = rows[row]
        assert tiles.keys() >= touched_tiles(values, width, height, -margin), f"row {row}"
        assert tiles.keys() <= touched_tiles(values, whole[0], whole[1], margin), f"row {row}"
        if got.ranges is not None:
            begin, end = got.ranges[row]
            assert list(tiles.values()) == list(range(begin, end)), f"row {row}"
    assert sum(len(tiles) for tiles in of_row.values()) == got.needed
    if got.ranges is None:
        return got
    ranges = sorted(span for span in got.ranges if span[0] < span[1])
    assert [begin for begin, _ in ranges] == [0, *(end for _, end in ranges)][: len(ranges)]
    return got


@pytest.mark.parametrize("count", [0, 1, 31, 33, 255, 256, 257, 600])
def test_tiles_have_the_splats_that_touch_them(native: Variant, count: int) -> None:
    check_binning(native, random_splats(count, count, 96, 80).packed, 96, 80)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 33), (640, 3), (5, 333)])
def test_tiles_of_images_of_any_size(native: Variant, width: int, height: int) -> None:
    check_binning(native, random_splats(width, 90, width, height).packed, width, height)


@pytest.mark.parametrize("pixels", [15.0, 60.0, 400.0])
def test_tiles_of_large_splats(native: Variant, pixels: float) -> None:
    """Large ellipses at different angles, between small ones; there are more of them than warps."""
    splats = random_splats(6, 20, 320, 240, pixels=pixels).packed
    small = random_splats(7, 20, 320, 240).packed
    mixed = torch.stack([splats, small], dim=1).flatten(0, 1)
    got = check_binning(native, mixed, 320, 240)
    largest = max(Counter(itertools.chain(*got.rows)).values())
    assert largest > 32


def test_tiles_are_those_of_the_cpu(native: Variant, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lists are equal, except for rounding where a splat barely touches a tile."""
    splats = random_splats(15, 6000, 640, 368, pixels=8.0).packed
    got = bin_splats(native, splats, 640, 368)
    monkeypatch.setitem(natives.LAUNCHERS, "cpu", CPU)
    wanted = bin_splats(native, splats, 640, 368)
    pairs = zip(got.rows, wanted.rows, strict=True)
    different = sum(len(set(a) ^ set(b)) for a, b in pairs)
    assert different <= (1e-4 * wanted.needed if native.dtype == torch.float32 else 0)
    if different == 0:
        assert got.rows == wanted.rows


@pytest.mark.parametrize("across", [1, 2, 31, 32, 33, 70])
def test_tiles_of_a_splat_as_wide(native: Variant, across: int) -> None:
    """Rectangles of one row or column of tiles, near the limit of what one thread tests."""
    wide = 1e-9
    packed = torch.zeros(2, 16, dtype=torch.float64)
    packed[:, :7] = torch.tensor([2.0, 3.0, wide, 0, wide, 0.5, 1.0])
    for size in ((across * TILE, TILE), (TILE, across * TILE), (across * TILE, 2 * TILE)):
        got = check_binning(native, packed, *size)
        assert got.needed == 2 * len(got.rows)


@pytest.mark.slow
def test_tiles_beyond_16_bits(native: Variant) -> None:
    size = 16 * 260
    packed = random_splats(8, 60, size, size, pixels=20.0).packed
    packed[:2, 2:5] = torch.tensor([2e-4, 1e-4, 3e-4])
    packed[0, :2] = torch.tensor([size - 100.0, size - 200.0])
    got = check_binning(native, packed, size, size)
    assert len(got.rows) > 2**16
    assert max(tile for tile, rows in enumerate(got.rows) if rows) > 2**16


def test_tiles_order_of_depths(native: Variant) -> None:
    """Splats of equal depth are ordered by row. Depths may be negative or infinite."""
    splats = random_splats(9, 300, 48, 32, pixels=6.0).packed
    depths = torch.tensor([2.0, 1.0, -3.0, math.inf, -math.inf, 1e-30, 1e30], dtype=torch.float64)
    splats[:, 6] = depths[torch.randint(0, len(depths), (300,), generator=generator(0))]
    check_binning(native, splats, 48, 32)


def test_tiles_of_invisible_splats(native: Variant) -> None:
    splats = random_splats(10, 60, 64, 48, opacity=(0.5, 1.0)).packed
    splats[0] = 0  # an empty row
    splats[1, 5] = 0.0039  # below 1/255
    splats[2, :2] = torch.tensor([-500.0, 20.0])
    splats[3, :2] = torch.tensor([20.0, 900.0])
    splats[4, 2:5] = torch.tensor([1.0, 2.0, 1.0])  # not an ellipse
    odd = [(c, v) for c in range(5) for v in (math.nan, math.inf, -math.inf)] + [(5, math.nan)]
    for row, (column, value) in enumerate(odd, start=5):
        if native.engine == "native":  # which has no such splats
            splats[row] = 0
        else:
            splats[row, column] = value
    got = bin_splats(native, splats, 64, 48)
    assert all(row > 20 for rows in got.rows for row in rows)
    seen = {row for rows in got.rows for row in rows}
    if got.ranges is not None:
        assert seen == {row for row, (begin, end) in enumerate(got.ranges) if begin < end}
    assert len(seen) > 20


def test_tiles_all_invisible(native: Variant) -> None:
    got = bin_splats(native, torch.zeros(5, 16), 40, 40)
    assert got.needed == 0
    assert got.ranges is None or all(begin == end for begin, end in got.ranges)


def test_tiles_that_are_counted_but_not_found(native: Variant) -> None:
    """Because of rounding, the two kernels may disagree: the splat then has fewer slots."""
    if native.engine == "native":
        pytest.skip("the CPU has no slots")
    splats = random_splats(11, 70, 64, 160, pixels=3.0, opacity=(0.5, 1.0)).packed
    splats[:, :2] = splats[:, :2].clamp(0, 60)  # all are visible
    splats[3, 2:5] = 1e-9 * torch.tensor([1.0, 0.0, 1.0])  # touches all 40 tiles
    splats[3, 6] = 100.0
    got, expected = (bin_splats(native, splats, 64, 160, surplus=n) for n in (2, 0))
    assert got == expected


@pytest.mark.parametrize("capacity", [0, 1, 100, 137, 10_000])
def test_tiles_with_a_small_capacity(native: Variant, capacity: int) -> None:
    """Only the instances whose slots are within the capacity are stored."""
    splats = random_splats(11, 70, 64, 80, pixels=8.0).packed
    splats[:3, 2:5] = 1e-9 * torch.tensor([1.0, 0.0, 1.0])
    splats[0, 6] = 0.1
    whole = bin_splats(native, splats, 64, 80)
    got = bin_splats(native, splats, 64, 80, capacity=capacity)
    assert got.needed == whole.needed > 140
    if whole.slots is None or whole.ranges is None:  # on the CPU there is always enough
        assert got == whole
        return
    pairs = [list(zip(*both, strict=True)) for both in zip(whole.rows, whole.slots, strict=True)]
    expected = [[(row, slot) for row, slot in pair if slot < capacity] for pair in pairs]
    assert got.rows == [[row for row, _ in pair] for pair in expected]
    assert got.slots == [[slot for _, slot in pair] for pair in expected]
    assert got.ranges == [[min(end, capacity) for end in span] for span in whole.ranges]


@pytest.mark.parametrize("size", [64, 300])
def test_tiles_without_slots(native: Variant, size: int) -> None:
    """If the order of gradient sums is not fixed, there are no slots; the lists are the same."""
    if native.engine == "native":
        pytest.skip("the CPU never has slots")
    splats = random_splats(12, 200, size, size, pixels=5.0).packed
    whole = bin_splats(native, splats, size, size)
    got = bin_splats(native, splats, size, size, with_slots=False)
    assert got.rows == whole.rows


# ---- Gradients of splats from those of their tiles -----------------------------------------------


@pytest.mark.parametrize("add", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
@pytest.mark.parametrize("absolute", [False, True])
def test_reduce(native: Variant, absolute: bool, count: int, channels: int, add: bool) -> None:
    if native.engine == "native":
        pytest.skip("the CPU has no slots")
    g = generator(count)
    dtype, suffix = native.dtype, "" if native.dtype == torch.float32 else "_f64"
    packed = random_splats(13, count, 50, 50, channels=20).packed.to(dtype)
    stride = packed.shape[1]
    lengths = torch.randint(0, 9, (count,), generator=g)
    lengths[::7], lengths[3::7] = 0, 70
    ends = lengths.cumsum(0)
    starts = ends - lengths
    slots = normal(g, int(lengths.sum()), 16)
    before = uniform(g, -1, 1, count, stride)
    columns = torch.tensor([12, 9, 6, 27])
    grad = torch.full((count + 1, stride), 99.0, dtype=dtype)
    grad[:count] = before if add else math.nan
    abs_before = uniform(g, 0, 1, count + 1, 2)
    abs_grad = abs_before.to(dtype, copy=True)
    natives.launch(
        f"splats_reduce{suffix}",
        n=count,
        slots=slots.to(dtype),
        slot_range=torch.stack([starts, ends], dim=1).int(),
        packed=packed,
        stride=stride,
        channels=channels,
        columns=columns,
        add=add,
        grad_packed=grad,
        abs_grad=abs_grad if absolute else None,
    )
    assert (grad[count:] == 99).all()
    wanted = before if add else torch.zeros(count, stride, dtype=torch.float64)
    first = 3 if channels <= 3 else 4
    splat_of_slot = torch.arange(count).repeat_interleave(lengths)
    total = torch.zeros(count, 16, dtype=torch.float64).index_add(0, splat_of_slot, slots)
    opacity = packed[:, 5].double()
    q, qxx, qxy, qyy = total[:, [first, *range(first + 3, first + 6)]].unbind(dim=1)

    def grad_of_means(conics: Tensor, moments: Tensor) -> Tensor:
        (a, b, c), (_, qx, qy) = conics.unbind(dim=1), moments.unbind(dim=1)
        return torch.stack([a * qx + b * qy, b * qx + c * qy], dim=1)

    conics, of_moments = packed[:, 2:5].double(), slice(first, first + 3)
    wanted[:, :2] += grad_of_means(conics, total[:, of_moments])
    wanted[:, 2:6] += torch.stack([-0.5 * qxx, -qxy, -0.5 * qyy, q / opacity], dim=1)
    wanted[:, columns[:channels]] += total[:, :channels]
    assert_close(grad[:count], wanted, 10 * native.forward if count else 0)
    if absolute:
        of_slots = grad_of_means(conics[splat_of_slot], slots[:, of_moments])
        abs_before.index_add_(0, splat_of_slot, of_slots.abs())
    assert_close(abs_grad, abs_before, native.forward)
