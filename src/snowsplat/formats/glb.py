"""The containers of glTF, `.glb` and `.gltf`: buffers, accessors as arrays, nodes as matrices.

Sizes in the JSON are compared with the size of the buffers before memory is allocated. A buffer is
the binary chunk of the file, a data URI, or a file inside of the folder of the JSON.
Specification: Khronos, glTF 2.0, sections 3.6 and 4.4.
"""

import base64
import binascii
import json
import struct
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from snowsplat.formats.damage import Damaged
from snowsplat.util.errors import cause_of
from snowsplat.util.safe_json import inside, is_file, parse_json, quoted

MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MOST_NODES = 1 << 16  # a node takes several microseconds
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
#: The component types of glTF: code -> NumPy type, and divisor of normalised values.
_COMPONENTS = {
    5120: ("<i1", 127.0),
    5121: ("<u1", 255.0),
    5122: ("<i2", 32767.0),
    5123: ("<u2", 65535.0),
    5126: ("<f4", 1.0),
}
#: The component types of the arrays that are written.
_CODES = {("f", 4): 5126, ("u", 1): 5121, ("u", 2): 5123, ("u", 4): 5125}
#: The component types of the indices of a sparse accessor.
_INDICES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}
#: The extension of nodes that draw their mesh several times.
INSTANCING = "EXT_mesh_gpu_instancing"
_VERTICES, _TRIANGLES = 34962, 34963  # the targets of buffer views


class Document:
    """A glTF file: its JSON, and its buffers, which are read when they are needed.

    Attributes:
        json: the JSON object.
        size: bytes of the file and of the buffers that were read so far.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        """Raises: Damaged: neither GLB 2 nor JSON, or chunks that exceed the file."""
        self._folder = path.parent
        self._buffers: dict[str | None, memoryview] = {}
        text = data
        if data[:4] == MAGIC:
            text, self._buffers[None] = _chunks(data)
        try:
            document = parse_json(text)
        except ValueError:
            document = None
        if not isinstance(document, dict):
            raise Damaged("its JSON is invalid")
        self.json: dict[str, Any] = document
        self.size = len(data)

    def buffer(self, index: int) -> memoryview:
        """The content of a buffer.

        Raises:
            Damaged: it is missing, cannot be read, or is outside of the folder.
            KeyError, IndexError, TypeError, ValueError: the JSON is not valid glTF.
        """
        uri = _item(self.json, "buffers", index).get("uri")
        if uri is None and index != 0:
            raise Damaged("its buffer {index} has no data", index=index)
        if uri not in self._buffers:
            content = self._read(uri)
            self.size += len(content)
            self._buffers[uri] = memoryview(content)
        return self._buffers[uri]

    def _read(self, uri: str | None) -> bytes:
        if uri is None:
            return b""
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                return base64.b64decode(text, validate=True) if head.endswith(";base64") else b""
            except (binascii.Error, ValueError):
                raise Damaged("one of its data URIs is not base64") from None
        name = unquote(uri)
        path = None if "://" in name else inside(self._folder, name)
        if path is None:
            raise Damaged("it refers to {name}, which is outside of its folder", name=quoted(name))
        if not is_file(path):
            raise Damaged("its data file {name} is missing", name=quoted(name))
        try:
            return path.read_bytes()
        except OSError as error:
            raise Damaged(
                "{name} cannot be read ({strerror})",
                name=quoted(name),
                strerror=cause_of(error),
            ) from None


def _chunks(data: bytes) -> tuple[bytes, memoryview]:
    """The JSON text and the binary chunk (empty if there is none) of a GLB file.

    Raises: Damaged: not GLB 2, or chunks that exceed the file.
    """
    if len(data) < 20:
        raise Damaged("not a GLB file")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise Damaged("GLB version {version}; supported is 2", version=version)
    if length > len(data):
        raise Damaged("the file is truncated")
    chunks, position = [], 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<II", data, position)
        if size > length - position - 8:
            raise Damaged("one of its chunks exceeds the file")
        chunks.append((kind, memoryview(data)[position + 8 : position + 8 + size]))
        position += 8 + size
    if not chunks or chunks[0][0] != _JSON:
        raise Damaged("its first chunk is not JSON")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == _BIN else memoryview(b"")
    return bytes(chunks[0][1]), binary


def contents(
    node: dict[str, Any],
    primitive: dict[str, Any],
    attributes: dict[str, np.ndarray],
    rows: np.ndarray | None = None,
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The JSON of a scene of one ``node`` with one ``primitive``, and the arrays for `pack`.

    Args:
        attributes: (N, C) little-endian float32, or unsigned integers, which are normalised;
            POSITION is the first.
        rows: (M, 1) uint32, the corners of triangles.
    """
    arrays = [*attributes.values(), *([] if rows is None else [rows])]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for array in arrays:
        target = _TRIANGLES if array is rows else _VERTICES
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target}
        accessor = {
            "bufferView": len(views),
            "componentType": _CODES[array.dtype.kind, array.itemsize],
            "count": len(array),
            "type": next(name for name, width in _WIDTHS.items() if width == array.shape[1]),
        }
        if array.dtype.kind == "u" and array is not rows:
            accessor["normalized"] = True
        views.append(view)
        accessors.append(accessor)
        offset += array.nbytes
    # The specification requires the bounds of POSITION, as exact float32 values.
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}
    used: dict[str, Any] = {"attributes": {name: k for k, name in enumerate(attributes)}}
    if rows is not None:
        used["indices"] = len(attributes)
    document = {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [used | primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    return document, arrays


def pack(document: dict[str, Any], arrays: list[np.ndarray]) -> Iterator[bytes]:
    """The parts of a GLB file; ``arrays``, each a multiple of 4 bytes, are its binary chunk."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(array.nbytes for array in arrays)
    yield struct.pack("<4sII", MAGIC, 2, 12 + 8 + len(text) + (8 + size if size else 0))
    yield struct.pack("<II", len(text), _JSON) + text
    if size:
        yield struct.pack("<II", size, _BIN)
        for array in arrays:
            yield array.tobytes()


def view(document: Document, index: int) -> memoryview:
    """The bytes of a buffer view.

    Raises:
        Damaged: it exceeds its buffer.
        KeyError, IndexError, TypeError, ValueError: the JSON is not valid glTF.
    """
    entry = _item(document.json, "bufferViews", index)
    data = document.buffer(entry["buffer"])
    start, length = _non_negative(entry.get("byteOffset", 0)), _non_negative(entry["byteLength"])
    if start + length > len(data):
        raise Damaged("its buffer view {index} exceeds the file", index=index)
    return data[start : start + length]


def accessor(document: Document, index: int, *kinds: str) -> np.ndarray:
    """The (count, width) float32 values of an accessor whose type is one of ``kinds``, as "VEC3".

    Raises:
        Damaged: another type, or data outside of its buffer.
        KeyError, IndexError, TypeError, ValueError: the JSON is not valid glTF.
    """
    entry = _item(document.json, "accessors", index)
    if entry["type"] not in kinds or entry["componentType"] not in _COMPONENTS:
        raise Damaged("its accessor {index} does not have the type of its attribute", index=index)
    code, divisor = _COMPONENTS[entry["componentType"]]
    dtype, width, count = np.dtype(code), _WIDTHS[entry["type"]], _non_negative(entry["count"])
    sparse = entry.get("sparse")
    if "bufferView" in entry or sparse is None:
        result = _rows(document, entry, dtype, width, count).astype(np.float32)
    elif count * width > document.size:  # zeros, of which the file has no bytes
        raise Damaged("its accessor {index} exceeds the file", index=index)
    else:
        result = np.zeros((count, width), np.float32)
    if sparse is not None:
        changed, where = _non_negative(sparse["count"]), sparse["indices"]
        rows = _rows(document, where, np.dtype(_INDICES[where["componentType"]]), 1, changed)
        result[rows[:, 0]] = _rows(document, sparse["values"], dtype, width, changed)
    if entry.get("normalized", False) and divisor != 1.0:
        # The most negative integer also means -1.
        result = np.maximum(result / np.float32(divisor), np.float32(-1))
    return result


def _rows(
    document: Document, entry: dict[str, Any], dtype: np.dtype, width: int, count: int
) -> np.ndarray:
    """(count, width) values of a buffer view, as an accessor or a part of it describes them."""
    index = entry["bufferView"]
    data = view(document, index)
    row = width * dtype.itemsize
    stride = _item(document.json, "bufferViews", index).get("byteStride", row)
    offset = _non_negative(entry.get("byteOffset", 0))
    needed = offset + (_non_negative(stride) * (count - 1) + row if count else 0)
    if stride < row or needed > len(data):
        raise Damaged("an accessor exceeds its buffer view {index}", index=index)
    return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))


def meshes(file: Document) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The meshes of the scene, each with ``world_from_mesh`` (4, 4) float64, for every node and
    every instance of it.

    Raises:
        Damaged: the nodes do not form trees; see also `accessor`.
        KeyError, IndexError, TypeError, ValueError: the JSON is not valid glTF.
    """
    document = file.json
    nodes = document.get("nodes", [])
    if document.get("scenes"):
        roots = _item(document, "scenes", document.get("scene", 0)).get("nodes", [])
    else:
        inner = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in inner]
    if max(len(nodes), len(roots)) > _MOST_NODES:
        raise Damaged("it has more than {most_nodes} nodes", most_nodes=_MOST_NODES)
    waiting = deque((root, np.eye(4)) for root in roots)
    visits = 0
    while waiting:
        index, world_from_parent = waiting.popleft()
        node = _item(document, "nodes", index)
        visits += 1
        children = node.get("children", [])
        # In a tree no node is visited twice.
        if visits + len(waiting) + len(children) > len(nodes):
            raise Damaged("its nodes do not form trees")
        world_from_node = world_from_parent @ _local(node)
        if "mesh" in node:
            mesh = _item(document, "meshes", node["mesh"])
            for local in _instances(file, node):
                yield mesh, world_from_node @ local
        waiting.extend((child, world_from_node) for child in children)


def _instances(document: Document, node: dict[str, Any]) -> Iterator[np.ndarray]:
    """(4, 4) ``node_from_mesh`` of each instance."""
    attributes = node.get("extensions", {}).get(INSTANCING, {}).get("attributes")
    if attributes is None:
        yield np.eye(4)
        return
    columns = {name: accessor(document, each, "VEC3", "VEC4") for name, each in attributes.items()}
    for values in zip(*columns.values(), strict=True):
        yield _local({name.lower(): v for name, v in zip(columns, values, strict=True)})


def _local(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) ``parent_from_node``."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column-major
    local = np.eye(4)
    if "rotation" in node:
        import torch  # imported only here, because such nodes are rare and the import takes time

        from snowsplat.scene.geometry import rotation_from_quat

        x, y, z, w = (float(v) for v in node["rotation"])
        local[:3, :3] = rotation_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64)).numpy()
    local[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
    local[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    return local


def _item(document: dict[str, Any], name: str, index: Any) -> dict[str, Any]:
    """An element of one of the top-level arrays."""
    entry = document[name][_non_negative(index)]
    if not isinstance(entry, dict):
        raise TypeError
    return entry


def _non_negative(value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError
    return value
