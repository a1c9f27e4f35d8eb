"""glTF files, `.glb`, with splats as KHR_gaussian_splatting stores them: in full precision.

A primitive of points with an accessor an attribute: POSITION; ROTATION, quaternions xyzw; SCALE,
the standard deviations themselves; OPACITY in 0 … 1; SH_DEGREE_l_COEF_n, whose basis and order are
the renderer's. COLOR_0 is for programs that know no splats and show points. About 236 bytes a
Gaussian of SH degree 3.

glTF's frame is x right, y up, z toward the viewer: the house frame after half a turn about x.
Scenes are placed by nodes, which readers must follow. Specification: Khronos,
github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from snowsplat.formats import glb, packing
from snowsplat.formats.frames import UP_BACK, flip_axes
from snowsplat.formats.glb import Damaged
from snowsplat.scene.edit import merge, transform
from snowsplat.scene.gaussians import SH_C0, SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import Similarity
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.safe_json import quoted

logger = logging.getLogger(__name__)

EXTENSION = "KHR_gaussian_splatting"
#: What a file may require of its readers.
_UNDERSTOOD = {EXTENSION, "KHR_mesh_quantization"}
_SPACES = ("srgb_rec709_display", "lin_rec709_display")
_LEAST_BYTES = 26  # of a Gaussian, all but its colour quantised
_MOST_COPIES = 8  # of the splats in the file, each shown by a node
_MOST_PRIMITIVES, _MOST_PARTS = 1 << 20, 1 << 12  # on all nodes
_OPACITY_ENDS = 1e-12, 1 - 2.0**-25  # 0 and 1 have no logit
_GLB_LIMIT = (1 << 32) - 1
_FLOAT, _BYTE, _POINTS, _VERTICES = 5126, 5121, 0, 34962


def is_glb(head: bytes) -> bool:
    """Whether a file begins as a GLB."""
    return head.startswith(glb.MAGIC)


@np.errstate(all="ignore")  # what is not finite is left out at the end
def read_glb(path: Path | str) -> Gaussians:
    """Read all splats of the file's scene, each where its node puts it, as one set.

    Raises:
        UserError: not readable, damaged, without splats, or with a part that we cannot show.
    """
    path = Path(path)
    data = packing.read_file(path)
    try:
        document, binary = glb.unpack(data)
        unknown = set(document.get("extensionsRequired", [])) - _UNDERSTOOD
        if unknown:
            raise Damaged(f"needs {sorted(map(str, unknown))[0][:60]}, which I do not read")
        parts = _parts(path, document, binary, _MOST_COPIES * len(data) // _LEAST_BYTES)
        if not parts and EXTENSION not in document.get("extensionsUsed", []):
            raise UserError(f"{path}: a GLB file, but without Gaussian splats ({EXTENSION})")
    except Damaged as error:
        raise UserError(f"{path}: {error}; copy or export it again") from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError(f"{path}: its JSON is no glTF; copy or export it again") from None
    scene = merge(parts) if parts else _empty()
    means, quats, sh_rest = flip_axes(
        scene.means.numpy(), scene.quats.numpy(), scene.sh_rest.numpy(), UP_BACK
    )
    kept = (scene.log_scales, scene.opacity_logits, scene.sh_dc)
    log_scales, opacity_logits, sh_dc = (tensor.numpy() for tensor in kept)
    return packing.to_gaussians(path, means, log_scales, quats, opacity_logits, sh_dc, sh_rest)


def _parts(path: Path, document: dict[str, Any], binary: memoryview, most: int) -> list[Gaussians]:
    """The splats of each primitive that has some, in the frame of the file's scene."""
    parts: list[Gaussians] = []
    seen = 0
    for mesh, world_from_mesh in glb.meshes(document):
        seen += len(mesh["primitives"])
        if seen > _MOST_PRIMITIVES:
            raise Damaged("shows more meshes than I take")
        for primitive in mesh["primitives"]:
            extension = primitive.get("extensions", {}).get(EXTENSION)
            if extension is None:
                continue
            _check(path, primitive, extension)
            part = _splats(document, binary, primitive["attributes"])
            most -= len(part)
            if most < 0 or len(parts) >= _MOST_PARTS:
                raise Damaged("shows its splats more often than I take")
            parts.append(transform(part, _similarity(world_from_mesh)))
    return parts


def _check(path: Path, primitive: dict[str, Any], extension: dict[str, Any]) -> None:
    if primitive.get("mode", 4) != _POINTS:
        raise Damaged("has splats that are no points")
    if extension.get("kernel", "ellipse") != "ellipse":
        raise Damaged(f"has splats of the kind {quoted(extension['kernel'])}, not ellipses")
    if not any(name.startswith(f"{EXTENSION}:") for name in primitive["attributes"]):
        packed = ", ".join(map(str, extension.get("extensions", {}))) or "an unknown way"
        raise Damaged(f"has its splats packed by {packed[:60]}, which I do not read")
    space = extension.get("colorSpace", _SPACES[0])
    if space != _SPACES[0]:
        logger.warning("%s: colours of %s are taken as sRGB", path, str(space)[:40])


def _similarity(world_from_mesh: np.ndarray) -> Similarity:
    matrix = world_from_mesh[:3, :3]
    scale = np.linalg.norm(matrix, axis=0)
    if not np.isfinite(world_from_mesh).all() or not scale.min() > 0:
        raise Damaged("has a node that squeezes its splats flat")
    if scale.max() > 1.0001 * scale.min():
        raise Damaged("has a node that stretches its splats more one way than another")
    try:
        return Similarity(
            float(scale.mean()),
            torch.from_numpy(matrix / scale),
            torch.from_numpy(world_from_mesh[:3, 3].copy()),
        )
    except ValueError:
        raise Damaged("has a node that shears or mirrors its splats") from None


def _splats(document: dict[str, Any], binary: memoryview, attributes: dict[str, Any]) -> Gaussians:
    def read(name: str, kind: str = "VEC3") -> np.ndarray:
        return glb.accessor(document, binary, attributes[name], kind)

    means = read("POSITION")
    quats = read(f"{EXTENSION}:ROTATION", "VEC4")[:, [3, 0, 1, 2]]
    opacity = read(f"{EXTENSION}:OPACITY", "SCALAR")[:, 0].astype(np.float64)
    opacity = np.clip(opacity, *_OPACITY_ENDS)
    names = _coefficients(3)
    there = [name for name in names if name in attributes]
    if there != names[: len(there)] or len(there) - 1 not in SH_REST_COUNTS:
        raise Damaged(f"has {len(there)} SH coefficients, which are no SH degree")
    sh = [read(name) for name in there]
    arrays = (
        means,
        packing.log_scales(read(f"{EXTENSION}:SCALE")),
        quats,
        np.log(opacity / (1 - opacity)),
        sh[0][:, None],
        np.stack(sh[1:], 1) if sh[1:] else np.zeros((len(means), 0, 3)),
    )
    if len({len(array) for array in (*arrays, *sh)}) != 1:
        raise Damaged("has attributes of different lengths")
    return Gaussians(
        *(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays)
    )


def _coefficients(degree: int) -> list[str]:
    """The attributes of the SH coefficients in the order of `Gaussians`: by l, then by m."""
    return [
        f"{EXTENSION}:SH_DEGREE_{level}_COEF_{n}"
        for level in range(degree + 1)
        for n in range(2 * level + 1)
    ]


def _empty() -> Gaussians:
    shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, 0, 3))
    return Gaussians(*(torch.zeros(shape) for shape in shapes))


@np.errstate(over="ignore", under="ignore")
def write_glb(path: Path | str, gaussians: Gaussians) -> None:
    """Write one mesh of splats in a node of its own, atomically.

    Raises:
        UserError: more than the 4 GiB that a GLB holds.
        OSError: the folder is absent or not writable, or the disk is full.
    """
    path = Path(path)
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = packing.to_arrays(path, gaussians)
    means, quats, sh_rest = flip_axes(means, quats, sh_rest, UP_BACK)
    opacity = (1 / (1 + np.exp(-opacity_logits))).astype("<f4")
    largest = np.finfo(np.float32).max
    attributes: dict[str, np.ndarray] = {
        "POSITION": means,
        "COLOR_0": _point_colors(sh_dc, opacity),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.minimum(np.exp(log_scales), largest),
        f"{EXTENSION}:OPACITY": opacity[:, None],
    }
    sh = np.concatenate([sh_dc, sh_rest], 1)
    attributes |= {name: sh[:, k] for k, name in enumerate(_coefficients(gaussians.sh_degree))}
    arrays = [
        np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        for values in attributes.values()
    ]
    if sum(array.nbytes for array in arrays) > _GLB_LIMIT - (1 << 20):
        raise UserError(f"{path}: {len(means)} Gaussians are too many for .glb; write .ply or .spz")
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "snowsplat"}}
    document["extensionsUsed"] = [EXTENSION]
    if len(means):
        document |= _contents(list(attributes), arrays)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines(glb.pack(document, arrays))


def _contents(names: list[str], arrays: list[np.ndarray]) -> dict[str, Any]:
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for array in arrays:
        count, width = array.shape
        colors = array.dtype == np.uint8
        views.append(
            {
                "buffer": 0,
                "byteOffset": offset,
                "byteLength": array.nbytes,
                "target": _VERTICES,
            }
        )
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": _BYTE if colors else _FLOAT,
                "count": count,
                "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width],
                **({"normalized": True} if colors else {}),
            }
        )
        offset += array.nbytes
    # Of POSITION alone the bounds must be told, as the floats that they are.
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}
    primitive = {
        "attributes": {name: index for index, name in enumerate(names)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": _SPACES[0]}},
    }
    return {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "splats"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def _point_colors(sh_dc: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """(N, 4) uint8: the colour without its view-dependent part, in linear light as glTF has it."""
    color = np.clip(0.5 + SH_C0 * sh_dc[:, 0], 0, 1)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return packing.to_bytes(255 * np.concatenate([linear, opacity[:, None]], 1))
