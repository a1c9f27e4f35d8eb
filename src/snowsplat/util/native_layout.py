"""The structs of parameters of native functions: how a struct is filled by the names of its fields.

The structs are defined in `native/params.h`. A library describes each of them as a text (see
`native/layout.h`), so Python has no second definition. The parameters of a call are a dict, whose
keys are the names of all fields; a field of a nested struct is "camera.width". Every field has 8
bytes: a tensor, or another object with a method `data_ptr`, is passed as a data pointer, None as a
null pointer, int and bool as int64, and float as double.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any

# Constants that Python and C++ share; a library tells its own.
TILE = 16  # edge of a tile in pixels
GROUP_CHANNELS = 4  # maximum number of channels of one rasterization pass
SLOT_WIDTH = 16  # numbers of the gradient of an instance
SEGMENT = 256  # instances of a tile that a block of `rasterize_bwd` processes on a GPU
PACKED_HEADER = 8  # columns of `Splats2D.packed` before the colours
PACKED_STRIDE = 16  # the number of columns of `Splats2D.packed` is a multiple of this
POSE_SUMS = 16  # for the gradient of a pose: 9 for R, 3 for t, 3 for the position, 1 for log f
MAX_NEIGHBOURS = 64  # largest k of `nearest_neighbours.neighbours`
ALIGNMENT_RADIUS = 7  # of the window of `patches.align_patches` in pixels, without its centre
MAX_SWEEP_SOURCES = 8  # largest number of source images of `sweep.plane_sweep`
MAX_SWEEP_RADIUS = 7  # of the window of `sweep.plane_sweep` in pixels, without its centre

_CONSTANTS = "".join(
    f"{name.lower()}={value};" for name, value in globals().copy().items() if name.isupper()
)

LARGEST_STRUCT = 1024  # bytes, at most

#: The parameters of a call by the names of the fields.
Fields = Mapping[str, Any]


class Mismatch(Exception):
    """A library was built for other constants, or a struct has other fields than Python gives."""


class Layout:
    """The fields of a struct, in order.

    Attributes:
        text: that of `layout_of` in C++.
        names: the names of the fields.
        kinds: a letter for each field: p pointer, i int64, d double.
        size: bytes of the struct.
    """

    def __init__(self, text: str) -> None:
        """Raises: Mismatch: other constants."""
        constants, _, fields = text.partition("|")
        if constants != _CONSTANTS:
            raise Mismatch(f"built for {constants}")
        self.text = text
        leaves = list(_leaves(fields))
        self.names = tuple(name for name, _ in leaves)
        self.kinds = "".join(kind for _, kind in leaves)
        self._pointers = [i for i, kind in enumerate(self.kinds) if kind == "p"]
        self._format = struct.Struct("=" + self.kinds.translate({112: "Q", 105: "q", 100: "d"}))
        self.size = self._format.size

    def pack_into(self, buffer: Any, name: str, fields: Fields) -> None:
        """Write the struct to the beginning of `buffer`, which has at least `size` bytes.

        Args:
            name: of the function, for messages.

        Raises:
            Mismatch: a field is missing, or the struct has no such field.
            TypeError: the value of a field has the wrong type.
        """
        try:
            values = [fields[field] for field in self.names]
        except KeyError as error:
            raise Mismatch(f"{name}: no value for {error}") from None
        if len(fields) != len(values):
            raise Mismatch(f"{name}: has no {', '.join(fields.keys() - set(self.names))}")
        try:
            for i in self._pointers:
                values[i] = 0 if values[i] is None else values[i].data_ptr()
            self._format.pack_into(buffer, 0, *values)
        except (AttributeError, struct.error):
            raise self._wrong_kind(name, fields) from None

    def _wrong_kind(self, name: str, fields: Fields) -> TypeError:
        kinds: dict[str, tuple[type, ...]] = {"i": (int,), "d": (float, int)}
        for field, kind in zip(self.names, self.kinds, strict=True):
            value = fields[field]
            if kind == "p":
                fits = value is None or hasattr(value, "data_ptr")
            else:
                fits = isinstance(value, kinds[kind])
            if not fits:
                wanted = {"p": "a tensor or None", "i": "an int", "d": "a float"}[kind]
                return TypeError(f"{name}: {field} must be {wanted}, got {type(value).__name__}")
        return TypeError(f"{name}: an integer has more than 64 bits")


def _leaves(text: str) -> Iterator[tuple[str, str]]:
    """(name, kind) of the fields in "n:i;camera{width:d;}": "n", "camera.width"."""
    outer: list[str] = []
    for name, mark in re.findall(r"(\w*)([{}]|:[pid];)", text):
        if mark == "{":
            outer.append(name)
        elif mark == "}":
            outer.pop()
        else:
            yield ".".join([*outer, name]), mark[1]
