"""The layout of structs of parameters: packs them for a kernel, and checks that libraries match.

A struct is a dataclass that inherits from `Params`; `native/params.h` has the same struct in C++.
Every field has 8 bytes: a tensor, or another object with a method `data_ptr`, is passed as a data
pointer, None as a null pointer, int and bool as int64, float as double, and a nested struct as its
fields. `Layout.hash` is a hash of the names, kinds and offsets of the fields; `layout_of` in
`native/layout.h` computes the same hash.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from operator import attrgetter
from types import UnionType
from typing import Any, get_args, get_type_hints

# Constants that Python and C++ share; they are part of the hash.
TILE = 16  # edge of a tile in pixels
GROUP_CHANNELS = 4  # maximum number of channels of one rasterization pass
SLOT_WIDTH = 16  # numbers of the gradient of an instance
PACKED_HEADER = 8  # columns of `Splats2D.packed` before the colours
PACKED_STRIDE = 16  # the number of columns of `Splats2D.packed` is a multiple of this
POSE_SUMS = 16  # for the gradient of a pose: 9 for R, 3 for t, 3 for the position, 1 for log f
MAX_NEIGHBOURS = 64  # largest k of `nearest_neighbours.neighbours`
ALIGNMENT_RADIUS = 7  # of the window of `patches.align_patches` in pixels, without its centre
MAX_SWEEP_SOURCES = 8  # largest number of source images of `sweep.plane_sweep`
MAX_SWEEP_RADIUS = 7  # of the window of `sweep.plane_sweep` in pixels, without its centre

_CONSTANTS = {
    "tile": TILE,
    "group_channels": GROUP_CHANNELS,
    "slot_width": SLOT_WIDTH,
    "packed_header": PACKED_HEADER,
    "packed_stride": PACKED_STRIDE,
    "pose_sums": POSE_SUMS,
    "max_neighbours": MAX_NEIGHBOURS,
    "alignment_radius": ALIGNMENT_RADIUS,
    "max_sweep_sources": MAX_SWEEP_SOURCES,
    "max_sweep_radius": MAX_SWEEP_RADIUS,
}

_WORD = 8  # bytes of a field
LARGEST_PARAMS = 1024  # bytes of a struct, at most


class Params:
    """The parameters of an operation: the base class of dataclasses with one field per member."""

    __slots__ = ()


class Layout:
    """The layout of one subclass of `Params`; see `layout_of`."""

    def __init__(self, params: type[Params]) -> None:
        leaves = list(_leaves(params))
        names = [name for name, _ in leaves]
        self.name = params.__name__
        self.names = tuple(names)
        self.kinds = "".join(kind for _, kind in leaves)
        self.size = _WORD * len(leaves)
        # Indices of the fields that are tensors.
        self.pointers = tuple(i for i, kind in enumerate(self.kinds) if kind == "p")
        #: Returns the values of all fields of a struct.
        self.values: Callable[[Params], tuple[Any, ...]] = _getter(names)
        self._format = struct.Struct("=" + self.kinds.translate({112: "Q", 105: "q", 100: "d"}))
        text = "".join(f"{name}={value};" for name, value in _CONSTANTS.items())
        self.hash = _fnv1a(text + _describe(params))

    def pack_into(self, buffer: Any, params: Params) -> Any:
        """Writes the struct to the beginning of `buffer`, which has at least `size` bytes.

        Returns the first tensor, or None.

        Raises: TypeError: the value of a field has the wrong type.
        """
        values = list(self.values(params))
        first = None
        try:
            for i in self.pointers:
                tensor = values[i]
                if tensor is None:
                    values[i] = 0
                else:
                    first = tensor if first is None else first
                    values[i] = tensor.data_ptr()
            self._format.pack_into(buffer, 0, *values)
        except (AttributeError, struct.error):
            raise self._wrong_kind(params) from None
        return first

    def _wrong_kind(self, params: Params) -> TypeError:
        kinds: dict[str, tuple[type, ...]] = {"i": (int,), "d": (float, int)}
        for name, kind, value in zip(self.names, self.kinds, self.values(params), strict=True):
            if kind == "p":
                fits = value is None or hasattr(value, "data_ptr")
            else:
                fits = isinstance(value, kinds[kind])
            if not fits:
                wanted = {"p": "a tensor or None", "i": "an int", "d": "a float"}[kind]
                return TypeError(
                    f"{self.name}: {name} must be {wanted}, got {type(value).__name__}"
                )
        return TypeError(f"{self.name}: an integer has more than 64 bits")


def _getter(names: Sequence[str]) -> Callable[[Params], tuple[Any, ...]]:
    if len(names) == 1:  # attrgetter of one name does not return a tuple
        one = attrgetter(names[0])
        return lambda params: (one(params),)
    return attrgetter(*names)


_layouts: dict[type[Params], Layout] = {}


def layout_of(params: type[Params]) -> Layout:
    """The layout of a struct of parameters."""
    layout = _layouts.get(params)
    if layout is None:
        layout = _layouts[params] = Layout(params)
    return layout


def _leaves(params: type[Params], prefix: str = "") -> Iterator[tuple[str, str]]:
    """(dotted name, kind) of every field that is not a struct, in order."""
    for name, kind in _fields(params):
        if isinstance(kind, str):
            yield prefix + name, kind
        else:
            yield from _leaves(kind, f"{prefix}{name}.")


def _describe(params: type[Params]) -> str:
    """The text that is hashed: "n:i@0;values:p@8;#16"."""
    text, offset = "", 0
    for name, kind in _fields(params):
        if isinstance(kind, str):
            text += f"{name}:{kind}@{offset};"
            offset += _WORD
        else:
            text += f"{name}:{{{_describe(kind)}}}@{offset};"
            offset += _WORD * sum(1 for _ in _leaves(kind))
    return f"{text}#{offset}"


def _fields(params: type[Params]) -> Iterator[tuple[str, str | type[Params]]]:
    """(name, kind) of the fields. Kinds: "p" pointer, "i" int64, "d" double, or a nested struct."""
    hints = get_type_hints(params)
    for field in fields(params):  # type: ignore[arg-type]  # every subclass is a dataclass
        yield field.name, _kind(hints[field.name])


def _kind(hint: Any) -> str | type[Params]:
    if isinstance(hint, UnionType):
        (hint,) = (one for one in get_args(hint) if one is not type(None))
    if issubclass(hint, Params):
        return hint
    return {int: "i", bool: "i", float: "d"}.get(hint, "p")


def _fnv1a(text: str) -> int:
    value = 14695981039346656037
    for byte in text.encode():
        value = (value ^ byte) * 1099511628211 % 2**64
    return value
