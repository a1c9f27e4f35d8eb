"""Sorting splats into tiles on a GPU: the sort and the prefix sums, and what is made of them."""

from __future__ import annotations


import pytest
import torch
from torch import Tensor

from snowsplat.ops.cuda import sorting
from snowsplat.ops.cuda.kernels import Argument, Run
from snowsplat.ops.cuda.launches import KERNELS

from . import emulation
from .conftest import variants
from .engines import execute_there
from .scenes import CUDA_FLOAT32, EMULATED_FLOAT32, Variant, generator

BLOCK = 4096  # keys of a block of the sort


@pytest.fixture(params=variants(EMULATED_FLOAT32, CUDA_FLOAT32))
def run(request: pytest.FixtureRequest) -> Run:
    """Runs the kernels of a GPU on CPU tensors."""
    variant: Variant = request.param
    if variant.engine == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use")
    execute = emulation.execute if variant.engine == "emulated" else execute_there

    def queue(name: str, blocks: int, *args: Argument) -> None:
        if blocks > 0:
            execute(KERNELS[name.removesuffix("_f64")], name, blocks, args)

    return queue


def random_keys(seed: int, n: int, dtype: torch.dtype, distinct: int = 2**62) -> Tensor:
    """Of all bits, or few different ones."""
    values = torch.randint(-(2**62), 2**62, (n,), generator=generator(seed)) * 2 + 1
    return ((values.abs() % distinct) if distinct < 2**62 else values).to(dtype)


def unsigned(keys: Tensor) -> list[int]:
    bits = 8 * keys.element_size()
    return [int(k) % 2**bits for k in keys.tolist()]


def sort(
    run: Run, keys: Tensor, bits: tuple[int, int], count: int | None = None
) -> tuple[Tensor, Tensor]:
    """The sorted keys and the numbers they had, from memory with a margin that nobody may touch."""
    n = len(keys)
    pairs = [torch.full((n + 8,), 99, dtype=dtype) for dtype in 2 * [keys.dtype, torch.int32]]
    pairs[0][:n] = keys
    there = None if count is None else torch.tensor([count])
    in_order = [pairs[0], pairs[2], pairs[1], pairs[3]]
    got, values = sorting.sort_pairs(run, n, *in_order, bits, count=there, rows=True)
    for tensor in pairs:
        assert (tensor[n:] == 99).all()
    return got[:n], values[:n]


@pytest.mark.parametrize("n", [1, 2, 31, 33, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 77])
@pytest.mark.parametrize("dtype", [torch.int16, torch.int32, torch.int64])
def test_sort_is_a_stable_sort(run: Run, dtype: torch.dtype, n: int) -> None:
    bits = 16 if n > BLOCK and dtype == torch.int64 else 8 * dtype.itemsize  # for time's sake
    keys = random_keys(n, n, dtype, distinct=2**62 if n % 2 else 5)
    plain = [k % 2**bits for k in unsigned(keys)]
    got, values = sort(run, keys, (0, bits))
    wanted = sorted(range(n), key=lambda i: plain[i])
    assert values.tolist() == wanted
    assert torch.equal(got, keys[wanted])


@pytest.mark.parametrize("bits", [(0, 1), (0, 7), (3, 13), (0, 9), (8, 32), (31, 32)])
def test_sort_by_some_bits(run: Run, bits: tuple[int, int]) -> None:
    keys = random_keys(3, 300, torch.int32)
    begin, end = bits
    plain = [k >> begin & (2 ** (end - begin) - 1) for k in unsigned(keys)]
    assert sort(run, keys, bits)[1].tolist() == sorted(range(300), key=lambda i: plain[i])


@pytest.mark.parametrize("count", [0, 1, 700, BLOCK, BLOCK + 5, 2 * BLOCK, 10**12])
def test_sort_of_as_many_as_there_are(run: Run, count: int) -> None:
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
    got = sorting.sort_pairs(run, 500, keys.clone(), spare[0], values.clone(), spare[1], (0, 32))
    assert torch.equal(got[0], keys[order])
    assert torch.equal(got[1], wanted)


def test_sort_of_nothing(run: Run) -> None:
    keys, values = sort(run, torch.empty(0, dtype=torch.int32), (0, 32))
    assert len(keys) == len(values) == 0


@pytest.mark.parametrize("n", [0, 1, 3, 4, 1023, 1024, 1025, 5000])
@pytest.mark.parametrize("in_place", [False, True])
def test_exclusive_scan(run: Run, n: int, in_place: bool) -> None:
    values = torch.randint(0, 1000, (n + 1,), generator=generator(n), dtype=torch.int32)
    wanted = [0, *values[:n].cumsum(0).tolist()]
    out = values if in_place else torch.full_like(values, 77)
    margin = int(out[n])
    total = torch.full((1,), -5)
    sorting.exclusive_scan(run, n, values, out, total)
    assert out.tolist() == [*wanted[:n], margin]
    assert total.item() == wanted[n]


def test_exclusive_scan_of_more_blocks_than_threads(run: Run) -> None:
    n = 300 * 1024 + 5
    values, out = torch.ones(n, dtype=torch.int32), torch.empty(n, dtype=torch.int32)
    total = torch.zeros(1, dtype=torch.int64)
    sorting.exclusive_scan(run, n, values, out, total)
    assert torch.equal(out, torch.arange(n, dtype=torch.int32))
    assert total.item() == n


def test_exclusive_scan_beyond_32_bits(run: Run) -> None:
    most = 2**31 - 1
    values, out = torch.full((2000,), most, dtype=torch.int32), torch.zeros(2000, dtype=torch.int32)
    total = torch.zeros(1, dtype=torch.int64)
    sorting.exclusive_scan(run, 2000, values, out, total)
    assert unsigned(out) == [min(i * most, 2**32 - 1) for i in range(2000)]
    assert total.item() == 2000 * most
