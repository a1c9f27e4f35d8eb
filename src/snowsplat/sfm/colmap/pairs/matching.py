"""Matches SIFT descriptors by exact nearest neighbours, the ratio test and the cross check.

The criteria are those of COLMAP's exact matching on the CPU. This module is imported by the child
process of COLMAP, so it does not import torch.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from snowsplat.util.native_library import call_with_arrays, check_array

#: Number of values of a descriptor.
LENGTH = 128

_MAX_ANGLE = np.float32(0.7)  # radians between the two descriptors of a match
_MAX_RATIO = np.float32(0.8)  # angle to the nearest descriptor / angle to the second nearest
_NORM = 512  # Euclidean norm of a uint8 descriptor, except for rounding


class Nearest(NamedTuple):
    """For each of N descriptors, the two nearest descriptors of another photo; all (N,) int32."""

    which: NDArray[np.int32]  # index of the nearest; the smallest index if several are equally near
    best: NDArray[np.int32]  # dot product of the descriptor and the nearest
    second: NDArray[np.int32]  # dot product with the second nearest; 0 if there is none


class Searched(NamedTuple):
    """Descriptors of the second photo with which each of the N of the first one is compared.

    These are the first ``common`` ones, and those from ``begin`` to ``end`` - 1; both (N,) int32.
    """

    common: int
    begin: NDArray[np.int32]
    end: NDArray[np.int32]


def match_descriptors(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Matches (K, 2) between descriptors ``first`` (N, 128) and ``second`` (M, 128).

    A row of the result has an index into ``first`` and one into ``second``, ascending in the first.
    Two descriptors match if each is the nearest one of the other, the angle between them is at most
    0.7 rad, and this angle is less than 0.8 times the angle to the second nearest descriptor, in
    both directions (Lowe 2004, section 7.1).

    Raises:
        ValueError: a wrong shape or dtype.
        UserError: the native library is missing or outdated.
    """
    return mutual(*two_nearest(first, second))


def mutual(rows: Nearest, columns: Nearest) -> NDArray[np.uint32]:
    """The matches (K, 2), as in `match_descriptors`, of the results of `two_nearest`."""
    forth, back = _accept(rows), _accept(columns)
    (found,) = np.nonzero(forth >= 0)
    found = found[back[forth[found]] == found]
    return np.stack([found, forth[found]], 1).astype(np.uint32)


def look_alikes(descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(N,) dot product of each of ``descriptors`` (N, 128) with the nearest of the others; 0 if
    there is none. Raises as `two_nearest`."""
    count = len(descriptors)
    later = Searched(0, np.arange(1, count + 1, dtype=np.int32), np.full(count, count, np.int32))
    rows, columns = two_nearest(descriptors, descriptors, later)
    return np.maximum(np.maximum(rows.best, columns.best), 0)


def two_nearest(
    first: NDArray[np.uint8], second: NDArray[np.uint8], searched: Searched | None = None
) -> tuple[Nearest, Nearest]:
    """The nearest of ``second`` (M, 128) for each of ``first`` (N, 128), and vice versa.

    The nearest descriptor is the one with the largest dot product. If there are no descriptors in
    which to search, indices and dot products are -1. The results are exact. ``searched``: which
    descriptors are compared, in both directions; None: all.

    Raises:
        ValueError: a wrong shape or dtype, or ranges beyond ``second``.
        UserError: the native library is missing or outdated.
    """
    n, m = len(first), len(second)
    check_array("first", first, (n, LENGTH), np.uint8)
    check_array("second", second, (m, LENGTH), np.uint8)
    if searched is None:
        searched = Searched(0, np.zeros(n, np.int32), np.full(n, m, np.int32))
    for name, ends in (("begin", searched.begin), ("end", searched.end)):
        check_array(name, ends, (n,), np.int32)
        if n and not (ends.min() >= 0 and ends.max() <= m):
            raise ValueError(f"{name} must be from 0 to {m}")
    if not 0 <= searched.common <= m:
        raise ValueError(f"common must be from 0 to {m}, got {searched.common}")
    rows, columns = (Nearest(*(np.empty(k, np.int32) for _ in range(3))) for k in (n, m))
    call_with_arrays(
        "match_descriptors",
        n=n,
        m=m,
        first=np.ascontiguousarray(first),
        second=np.ascontiguousarray(second),
        common=searched.common,
        begin=np.ascontiguousarray(searched.begin),
        end=np.ascontiguousarray(searched.end),
        row_index=rows.which,
        row_best=rows.best,
        row_second=rows.second,
        column_index=columns.which,
        column_best=columns.best,
        column_second=columns.second,
    )
    return rows, columns


def _accept(nearest: Nearest) -> NDArray[np.int32]:
    """(N,) the index of the nearest descriptor, or -1 where the angle or the ratio is too large."""
    angle, second = (_angle(product) for product in (nearest.best, nearest.second))
    return np.where(
        (angle <= _MAX_ANGLE) & (angle < _MAX_RATIO * second), nearest.which, np.int32(-1)
    )


def _angle(product: NDArray[np.int32]) -> NDArray[np.float32]:
    cosine = product.astype(np.float32) * np.float32(1 / _NORM**2)
    return np.arccos(np.clip(cosine, np.float32(0), np.float32(1)))
