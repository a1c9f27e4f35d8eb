"""The pool of memory: tensors do not overlap, and freed memory is used again."""

import random

import pytest
import torch

from snowsplat.ops import scratch


@pytest.fixture(autouse=True)
def _own_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "_pool", None)
    monkeypatch.setattr(scratch, "_SMALLEST", 1 << 20)


def numbers(count: int) -> torch.Tensor:
    return scratch.empty((count,), torch.float32)


def holes() -> list[tuple[int, int]]:
    assert scratch._pool is not None
    while scratch._returned:
        segment, begin, end = scratch._returned.popleft()
        segment.give(begin, end)
    return scratch._pool.holes


def test_tensors_keep_their_values() -> None:
    """Tensors of many sizes, deleted in any order, while the pool grows several times."""
    choose = random.Random(0)
    held: dict[int, torch.Tensor] = {}
    sizes = set()
    for number in range(600):
        tensor = numbers(choose.randrange(1, 60_000)).fill_(number)
        assert tensor.data_ptr() % 64 == 0
        held[number] = tensor.view(1, -1)[:, :]  # a view keeps the memory, too
        assert scratch._pool is not None
        sizes.add(len(scratch._pool.memory))
        while len(held) > 5 + number // 5:
            value, old = held.popitem() if choose.random() < 0.5 else _first(held)
            assert (old == value).all()
    assert all((tensor == number).all() for number, tensor in held.items())
    assert len(sizes) > 2


def _first(held: dict[int, torch.Tensor]) -> tuple[int, torch.Tensor]:
    number = next(iter(held))
    return number, held.pop(number)


def test_freed_memory_is_used_again_and_adjacent_parts_are_joined() -> None:
    tensors = [numbers(50_000) for _ in range(4)]
    pool = scratch._pool
    first = tensors[0].data_ptr()
    del tensors
    assert numbers(190_000).data_ptr() == first  # as large as the four together
    assert scratch._pool is pool


def test_the_smallest_hole_is_used() -> None:
    large, _between, small, _after = numbers(80_000), numbers(5000), numbers(20_000), numbers(5000)
    place, room = small.data_ptr(), large.data_ptr()
    del large, small
    again = numbers(19_000)
    assert again.data_ptr() == place
    assert numbers(79_000).data_ptr() == room


def test_a_pool_that_is_too_small_is_replaced_and_its_memory_is_returned() -> None:
    kept = numbers(200_000).fill_(7.0)
    old = scratch._pool
    assert old is not None
    more = numbers(2_000_000)
    new = scratch._pool
    assert new is not None
    assert new is not old
    assert len(new.memory) >= 2 * len(old.memory)
    assert (kept == 7.0).all()
    before = holes()
    del kept  # in the old segment: the new one does not get its parts
    assert holes() == before
    del more
    assert holes() == [(0, len(new.memory))]


def test_small_tensors_are_not_in_the_pool() -> None:
    assert numbers(100).shape == (100,)
    assert scratch._pool is None
