"""glTF files (`.glb`) with the extension KHR_gaussian_splatting, in full precision.

The splats are a primitive of points with one accessor per attribute: POSITION; ROTATION,
quaternions xyzw; SCALE, the standard deviations themselves; OPACITY in 0 … 1; SH_DEGREE_l_COEF_n,
with the basis and order of our renderer. COLOR_0 lets programs without the extension display
points. A Gaussian of SH degree 3 takes about 236 bytes.

The frame of glTF is x right, y up, z towards the viewer: our frame, rotated by 180° about x.
Readers must apply the transforms of the nodes, which place the splats in the scene. Specification:
Khronos, github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting. It has no
mark for antialiased scenes.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats import glb, packing
from snowsplat.formats.axis_conventions import UP_BACK, flip_axes
from snowsplat.formats.gaussian_arrays import GaussianArrays, decoded
from snowsplat.formats.glb import Damaged
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.safe_json import quoted

logger = logging.getLogger(__name__)

EXTENSION = "KHR_gaussian_splatting"
#: Extensions that a file may require.
_UNDERSTOOD = {EXTENSION, "KHR_mesh_quantization"}
_SPACES = ("srgb_rec709_display", "lin_rec709_display")
_LEAST_BYTES = 26  # per Gaussian, with all attributes quantised except the colour
_MOST_COPIES = 8  # maximum number of copies of the splats, by nodes that share a mesh
_MOST_PRIMITIVES = 1 << 20  # maximum number of primitives of all nodes
_MOST_PARTS = 1 << 12  # maximum number of primitives with splats
_OPACITY_RANGE = 1e-12, 1 - 2.0**-25  # 0 and 1 have no logit
_GLB_LIMIT = (1 << 32) - 1
_FLOAT, _BYTE, _POINTS, _VERTICES = 5126, 5121, 0, 34962


def is_glb(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a GLB file."""
    return head.startswith(glb.MAGIC)


@np.errstate(all="ignore")  # non-finite Gaussians are skipped at the end
def read_glb(path: Path | str) -> GaussianArrays:
    """Read all splats of the scene, placed by their nodes, as one set of Gaussians.

    Raises:
        UserError: the file cannot be read, is damaged, has no splats, or needs an unsupported
            feature.
    """
    path = Path(path)
    data = packing.read_file(path)
    try:
        document, binary = glb.unpack(data)
        unknown = set(document.get("extensionsRequired", [])) - _UNDERSTOOD
        if unknown:
            raise Damaged(f"it needs {sorted(map(str, unknown))[0][:60]}, which is not supported")
        parts = _parts(path, document, binary, _MOST_COPIES * len(data) // _LEAST_BYTES)
        if not parts and EXTENSION not in document.get("extensionsUsed", []):
            raise UserError(f"{path}: a GLB file without Gaussian splats ({EXTENSION})")
    except Damaged as error:
        raise UserError(f"{path}: {error}; copy or export it again") from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError(f"{path}: its JSON is not valid glTF; copy or export it again") from None
    scene = GaussianArrays.cat(parts)
    means, quats, sh_rest = flip_axes(scene.means, scene.quats, scene.sh_rest, UP_BACK)
    return decoded(path, means, scene.log_scales, quats, scene.opacity_logits, scene.sh_dc, sh_rest)


def _parts(
    path: Path, document: dict[str, Any], binary: memoryview, most: int
) -> list[GaussianArrays]:
    """The splats of each primitive that has splats, in the frame of the glTF scene.

    Raises:
        Damaged: more than ``most`` splats, or another violation of the specification.
    """
    parts: list[GaussianArrays] = []
    seen = 0
    for mesh, world_from_mesh in glb.meshes(document):
        seen += len(mesh["primitives"])
        if seen > _MOST_PRIMITIVES:
            raise Damaged(f"it has more than {_MOST_PRIMITIVES} primitives")
        for primitive in mesh["primitives"]:
            extension = primitive.get("extensions", {}).get(EXTENSION)
            if extension is None:
                continue
            _check(path, primitive, extension)
            part = _splats(document, binary, primitive["attributes"])
            most -= len(part.means)
            if most < 0 or len(parts) >= _MOST_PARTS:
                raise Damaged("its nodes repeat the splats too often")
            parts.append(_transform(part, world_from_mesh))
    return parts


def _check(path: Path, primitive: dict[str, Any], extension: dict[str, Any]) -> None:
    if primitive.get("mode", 4) != _POINTS:
        raise Damaged("its splats are not points")
    if extension.get("kernel", "ellipse") != "ellipse":
        raise Damaged(f"its splats have the kernel {quoted(extension['kernel'])}, not ellipse")
    if not any(name.startswith(f"{EXTENSION}:") for name in primitive["attributes"]):
        packed = ", ".join(map(str, extension.get("extensions", {}))) or "an unknown method"
        raise Damaged(f"its splats are compressed by {packed[:60]}, which is not supported")
    space = extension.get("colorSpace", _SPACES[0])
    if space != _SPACES[0]:
        logger.warning("%s: colours of %s are read as sRGB", path, str(space)[:40])


def _transform(part: GaussianArrays, world_from_mesh: np.ndarray) -> GaussianArrays:
    """The splats in the frame of the scene; ``world_from_mesh`` is (4, 4).

    Raises:
        Damaged: not a similarity.
    """
    if np.array_equal(world_from_mesh, np.eye(4)):
        return part  # the usual case, which does not need torch
    matrix = world_from_mesh[:3, :3]
    scale = np.linalg.norm(matrix, axis=0)
    if not np.isfinite(world_from_mesh).all() or not scale.min() > 0:
        raise Damaged("one of its nodes flattens its splats")
    if scale.max() > 1.0001 * scale.min():
        raise Damaged("one of its nodes scales its splats by different factors per axis")
    import torch

    from snowsplat.scene.edit import transform
    from snowsplat.scene.geometry import Similarity

    try:
        similarity = Similarity(
            float(scale.mean()),
            torch.from_numpy(matrix / scale),
            torch.from_numpy(world_from_mesh[:3, 3].copy()),
        )
    except ValueError:
        raise Damaged("one of its nodes shears or mirrors its splats") from None
    return GaussianArrays.from_gaussians(transform(part.to_gaussians(), similarity))


def _splats(
    document: dict[str, Any], binary: memoryview, attributes: dict[str, Any]
) -> GaussianArrays:
    """The splats of a primitive, in the frame of its mesh."""

    def read(name: str, kind: str = "VEC3") -> np.ndarray:
        return glb.accessor(document, binary, attributes[name], kind)

    means = read("POSITION")
    quats = read(f"{EXTENSION}:ROTATION", "VEC4")[:, [3, 0, 1, 2]]
    quats[(quats == 0).all(1)] = 1, 0, 0, 0
    opacity = read(f"{EXTENSION}:OPACITY", "SCALAR")[:, 0].astype(np.float64)
    opacity = np.clip(opacity, *_OPACITY_RANGE)
    names = _coefficients(3)
    present = [name for name in names if name in attributes]
    if present != names[: len(present)] or len(present) - 1 not in SH_REST_COUNTS:
        raise Damaged(f"its {len(present)} SH coefficients do not match an SH degree")
    sh = [read(name) for name in present]
    arrays = (
        means,
        packing.log_scales(read(f"{EXTENSION}:SCALE")),
        quats,
        np.log(opacity / (1 - opacity)),
        sh[0][:, None],
        np.stack(sh[1:], 1) if sh[1:] else np.zeros((len(means), 0, 3)),
    )
    if len({len(array) for array in (*arrays, *sh)}) != 1:
        raise Damaged("its attributes have different lengths")
    return GaussianArrays(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def _coefficients(degree: int) -> list[str]:
    """The attributes of the SH coefficients in the order of `GaussianArrays`: by l, then by m."""
    return [
        f"{EXTENSION}:SH_DEGREE_{level}_COEF_{n}"
        for level in range(degree + 1)
        for n in range(2 * level + 1)
    ]


@np.errstate(over="ignore", under="ignore")
def write_glb(path: Path | str, gaussians: GaussianArrays) -> None:
    """Write one mesh of splats in one node, atomically.

    Raises:
        UserError: more data than the 4 GiB that a GLB file can store.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = packing.packable(path, gaussians)
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
    degree = SH_REST_COUNTS.index(sh_rest.shape[1])
    attributes |= {name: sh[:, k] for k, name in enumerate(_coefficients(degree))}
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
    # The specification requires the bounds of POSITION, as exact float32 values.
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
    """(N, 4) uint8 RGBA: the colour without its view-dependent part, in linear light as in glTF."""
    color = np.clip(0.5 + SH_C0 * sh_dc[:, 0], 0, 1)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return packing.to_bytes(255 * np.concatenate([linear, opacity[:, None]], 1))
