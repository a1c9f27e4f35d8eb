"""The PLY container: a header that declares elements, followed by their rows.

The reader supports any order and scalar type of properties, ASCII and both byte orders, and files
with several elements. It does not interpret the values. Before it allocates memory for a count in
the header, it checks that the file is large enough. So damaged and malicious files only cause a
one-line error.
"""

import io
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from snowsplat.util.errors import UserError
from snowsplat.util.files import reading

# Largest size of a header in bytes.
_HEADER_LIMIT = 1 << 20
# Largest size of an ASCII row in bytes: _LINE_LIMIT plus _NUMBER_LIMIT for each number.
_LINE_LIMIT = 1 << 12
_NUMBER_LIMIT = 1 << 10
# Rows are converted in blocks of this size, which fit into the CPU cache.
_CHUNK_BYTES = 4 << 20
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_NAMES = (
    ("char", "uchar", "short", "ushort", "int", "uint", "float", "double"),
    ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"),
)
_SCALARS = {name: code for names in _NAMES for name, code in zip(names, _CODES, strict=True)}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    properties: dict[str, str]  # name -> numpy type code, in the order of the file
    has_list: bool = False

    @property
    def row_bytes(self) -> int:
        return sum(int(code[1]) for code in self.properties.values())


@dataclass
class PlyTable:
    """One element of a PLY file whose header has been read. `rows` reads its rows.

    Invariant: the file is large enough for ``count`` rows; for ASCII, for rows of minimal size.
    """

    path: Path  # for messages, and the file to read if there is no ``data``
    format: str  # a key of `_BYTE_ORDERS`
    count: int  # number of rows
    columns: dict[str, str]  # name -> numpy type code, in the order of the file
    elements: tuple[str, ...]  # the names of all elements in the file
    comments: tuple[str, ...]  # of the header, without the word "comment"; words are single-spaced
    _before: list[_Element]  # the elements before this one
    _data_start: int  # size of the header in bytes
    _data: bytes | None = None  # the content, if it is not in a file of its own

    def rows(self) -> Iterator[tuple[int, np.ndarray]]:
        """The rows in blocks: pairs (index of the first row, structured array of the columns).

        The columns have their declared types; in ASCII files, all floating-point columns are
        float64.

        Raises: UserError: the file ends early, or an ASCII value is not a number.
        """
        order = _BYTE_ORDERS[self.format]
        # A text may have more digits than the declared type, and often has.
        codes = {"f4": "f8"} if self.format == "ascii" else {}
        dtype = np.dtype(
            [(name, order + codes.get(code, code)) for name, code in self.columns.items()]
        )
        with _open(self.path, self._data) as file:
            file.seek(self._data_start)
            chunk = max(1, _CHUNK_BYTES // max(1, dtype.itemsize))  # there may be no columns
            if self.format != "ascii":
                file.seek(sum(e.count * e.row_bytes for e in self._before), os.SEEK_CUR)
                read = self._read_binary
            else:
                for _ in range(sum(e.count for e in self._before)):
                    if not file.readline():
                        raise _truncated(self.path)
                read = self._read_ascii
            for start in range(0, self.count, chunk):
                yield start, read(file, dtype, min(chunk, self.count - start))

    def _read_binary(self, file: BinaryIO, dtype: np.dtype, count: int) -> np.ndarray:
        data = file.read(count * dtype.itemsize)
        if len(data) < count * dtype.itemsize:
            raise _truncated(self.path)
        return np.frombuffer(data, dtype) if dtype.itemsize else np.empty(count, dtype)

    def _read_ascii(self, file: BinaryIO, dtype: np.dtype, count: int) -> np.ndarray:
        limit = _LINE_LIMIT + _NUMBER_LIMIT * len(self.columns)
        lines = (self._line(file, limit) for _ in range(count))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # numpy warns if there are no rows; checked below
                values = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
        except ValueError:
            raise UserError(
                "{path}: a row of the PLY file is not {columns} numbers",
                path=self.path,
                columns=len(self.columns),
            ) from None
        if len(values) < count:
            raise _truncated(self.path)
        if values.shape[1] != len(self.columns):
            raise UserError(
                "{path}: the PLY file has {shape} numbers per row, but its header declares "
                "{columns}",
                path=self.path,
                shape=values.shape[1],
                columns=len(self.columns),
            )
        rows = np.empty(count, dtype)
        with np.errstate(invalid="ignore", over="ignore"):
            for column, name in enumerate(self.columns):
                rows[name] = values[:, column]
        return rows

    def _line(self, file: BinaryIO, limit: int) -> bytes:
        line = file.readline(limit)
        if len(line) == limit:
            raise UserError(
                "{path}: a row of the PLY file is too long; export it again", path=self.path
            )
        return line


def _truncated(path: Path) -> UserError:
    return UserError(
        "{path}: the PLY file ends before its last row; copy or export it again", path=path
    )


def _open(path: Path, data: bytes | None) -> BinaryIO:
    return open(path, "rb") if data is None else io.BytesIO(data)


def open_table(path: Path | str, element: str = "vertex", data: bytes | None = None) -> PlyTable:
    """Read the header of a PLY file and check that the file is large enough for ``element``.

    ``data``: the content of the file, if it is not at ``path`` but, for example, inside of a zip
    file; then ``path`` is for messages.

    Raises: UserError: the file is missing, truncated, or not a PLY file, or its header is invalid.
    """
    path = Path(path)
    with reading(path), _open(path, data) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        lines = _header_lines(path, file)
        data_start = file.tell()

    format, elements = _parse_header(path, lines)
    names = [e.name for e in elements]
    if names.count(element) != 1:
        raise UserError(
            "{path}: the PLY file has {count} '{element}' elements, not one",
            path=path,
            count=names.count(element),
            element=element,
        )
    position = names.index(element)
    before, wanted = elements[:position], elements[position]
    if wanted.has_list:
        raise UserError(
            "{path}: the PLY file has a list property in its '{element}' element",
            path=path,
            element=element,
        )
    if format == "ascii":
        # A number and its separator have at least two bytes. The last separator may be missing.
        needed = sum(e.count for e in before) + 2 * wanted.count * len(wanted.properties) - 1
    else:
        if any(e.has_list and e.count for e in before):
            raise UserError(
                "{path}: the PLY file has a list element before '{element}'; save it again with "
                "'{element}' first",
                path=path,
                element=element,
            )
        needed = sum(e.count * e.row_bytes for e in [*before, wanted])
    if wanted.count and needed > size - data_start:
        raise _truncated(path)
    comments = tuple(" ".join(words[1:]) for words in lines if words[0] == "comment")
    layout = (path, format, wanted.count, wanted.properties, tuple(names), comments)
    return PlyTable(*layout, before, data_start, data)


def _header_lines(path: Path, file: BinaryIO) -> list[list[str]]:
    """The words of each header line. The file position is then after the line ``end_header``."""
    if file.readline(16).rstrip(b"\r\n") != b"ply":
        raise UserError("{path}: not a PLY file (its first line must be 'ply')", path=path)
    lines: list[list[str]] = []
    while file.tell() < _HEADER_LIMIT:
        line = file.readline(4096)
        if not line.endswith(b"\n"):
            break
        words = line.decode("ascii", errors="replace").split()
        if words == ["end_header"]:
            return lines
        if words:
            lines.append(words)
    raise UserError("{path}: the PLY header has no end; the file is damaged", path=path)


def _parse_header(path: Path, lines: list[list[str]]) -> tuple[str, list[_Element]]:
    format = None
    elements: list[_Element] = []
    for words in lines:
        match words:
            case ["comment" | "obj_info", *_]:
                pass
            case [
                "format",
                ("ascii" | "binary_little_endian" | "binary_big_endian") as name,
                "1.0",
            ]:
                format = name
            case ["element", name, count] if (
                count.isascii() and count.isdigit() and len(count) < 16
            ):
                elements.append(_Element(name, int(count), {}))
            case ["property", "list", size, item, _] if (
                elements and {size, item} <= _SCALARS.keys()
            ):
                elements[-1].has_list = True
            case ["property", kind, name] if elements and kind in _SCALARS:
                if name in elements[-1].properties:
                    raise UserError(
                        "{path}: the PLY header declares the property '{name}' twice",
                        path=path,
                        name=name,
                    )
                elements[-1].properties[name] = _SCALARS[kind]
            case _:
                shown = " ".join(words)[:60]
                raise UserError(
                    "{path}: the PLY header has an invalid line: {shown!r}", path=path, shown=shown
                )
    if format is None:
        raise UserError("{path}: the PLY header has no format line", path=path)
    return format, elements


def header_of(
    elements: Sequence[tuple[str, int, list[tuple[str, str]]]], comments: Sequence[str] = ()
) -> bytes:
    """The header of a little-endian file.

    Args:
        elements: one tuple per element: its name, its count, and pairs (PLY type, name).
        comments: ASCII, one line each.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    for name, count, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {column}" for kind, column in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
