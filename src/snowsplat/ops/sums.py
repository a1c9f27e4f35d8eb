"""`sum_of_rows`: a sum that is bit-identical in every run."""

from __future__ import annotations

from torch import Tensor


def sum_of_rows(rows: Tensor) -> Tensor:
    """(R, C) → (C,), bit-identical for any number of threads of torch.

    On the CPU, rows are added in order. On a GPU, torch's sum has a fixed order; its cumsum does
    not.
    """
    if rows.is_cuda or len(rows) == 0:
        return rows.sum(0)
    return rows.cumsum(0)[-1]
