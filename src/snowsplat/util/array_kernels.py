"""Calls native functions with NumPy arrays: those of structure from motion and of undistortion.

The child process of COLMAP does not import torch, so it cannot use `snowsplat.ops`. The functions
exist for the CPU only; `native/params.h` documents their parameters.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from snowsplat.util import native_library
from snowsplat.util.native_layout import Params, layout_of
from snowsplat.util.native_library import ArrayPointer


@dataclass(slots=True, kw_only=True)
class DetectSiftParams(Params):
    """The struct of the same name in `native/params.h`."""

    width: int
    height: int
    grey: ArrayPointer
    allowed: ArrayPointer | None
    count: int
    keypoints: ArrayPointer
    descriptors: ArrayPointer


@dataclass(slots=True, kw_only=True)
class MatchDescriptorsParams(Params):
    """The struct of the same name in `native/params.h`."""

    n: int
    m: int
    first: ArrayPointer
    second: ArrayPointer
    common: int
    begin: ArrayPointer
    end: ArrayPointer
    row_index: ArrayPointer
    row_best: ArrayPointer
    row_second: ArrayPointer
    column_index: ArrayPointer
    column_best: ArrayPointer
    column_second: ArrayPointer


@dataclass(slots=True, kw_only=True)
class AlignPatchesParams(Params):
    """The struct of the same name in `native/params.h`."""

    n: int
    side: int
    patches: ArrayPointer
    pairs: ArrayPointer
    transform: ArrayPointer
    correlation: ArrayPointer


@dataclass(slots=True, kw_only=True)
class ResampleParams(Params):
    """The struct of the same name in `native/params.h`."""

    channels: int
    source_width: int
    source_height: int
    source: ArrayPointer
    wraps: bool
    columns: int
    nodes: ArrayPointer
    column: ArrayPointer
    across: ArrayPointer
    row: ArrayPointer
    down: ArrayPointer
    width: int
    height: int
    first: int
    count: int
    made: ArrayPointer


ENTRIES: dict[str, type[Params]] = {
    "detect_sift": DetectSiftParams,
    "match_descriptors": MatchDescriptorsParams,
    "align_patches": AlignPatchesParams,
    "resample": ResampleParams,
}


def call(name: str, params: Params) -> int:
    """Call a function of `ENTRIES`. Its arguments must be valid: C++ does not check them.

    Raises UserError if the native library is missing or outdated.
    """
    layout = layout_of(ENTRIES[name])
    buffer = ctypes.create_string_buffer(layout.size)
    layout.pack_into(buffer, params)
    return int(_function(name)(ctypes.addressof(buffer)))


@functools.cache
def _function(name: str) -> Callable[[int], Any]:
    native_library.check_layouts(ENTRIES)
    function = getattr(native_library.library()[1], name)
    function.restype, function.argtypes = ctypes.c_int64, (ctypes.c_void_p,)
    return function
