"""glTF files with the extension KHR_gaussian_splatting, in full precision.

`.glb` files are read and written, `.gltf` files, whose data may be in files beside them, are read.

The splats are a primitive of points with one accessor per attribute: POSITION; ROTATION,
quaternions xyzw; SCALE, the standard deviations themselves; OPACITY in 0 … 1; SH_DEGREE_l_COEF_n,
with the basis and order of our renderer. COLOR_0 lets programs without the extension display
points. A Gaussian of SH degree 3 takes about 236 bytes. Instead of the accessors, a buffer view may
have an .spz file, as in the tiles of Cesium (a draft: pull request 2531 of Khronos). Its numbers
are taken as those of the mesh, as by CesiumJS. Such files are read, not written.

The frame of glTF is x right, y up, z towards the viewer: our frame, rotated by 180° about x.
Readers must apply the transforms of the nodes, which place the splats in the scene. Numbers in the
JSON have float64: the translation of the node is the `scene.origin` of the splats. The unit of glTF
is the metre: the scale of the node is the `metres_per_unit` of the splats. Files of unknown scale
do not keep to that, so "metres_per_unit" in the "extras" of "asset" is 1 if it is known.
Specification: Khronos, github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
It has no mark for antialiased scenes.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats import glb, packing
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.formats.glb import Document
from snowsplat.formats.spz import parse_spz
from snowsplat.scene.length import stored_metres
from snowsplat.scene.origin import Origin
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_bytes
from snowsplat.util.safe_json import quoted
from snowsplat.util.srgb import from_linear, to_linear

logger = logging.getLogger(__name__)

EXTENSION = "KHR_gaussian_splatting"
# The names of the extension for .spz files in its drafts; the last one is not inside of EXTENSION.
_SPZ = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
)
#: Extensions that a file may require.
_UNDERSTOOD = {EXTENSION, glb.INSTANCING, "KHR_mesh_quantization", "KHR_materials_unlit", *_SPZ}
_SPACES = ("srgb_rec709_display", "lin_rec709_display")
_ROUNDING = 1e-3  # of the largest scale
_LEAST_BYTES = 26  # per Gaussian, with all attributes quantised except the colour
_MOST_COPIES = 8  # maximum number of copies of the splats, by nodes that share a mesh
_MOST_PRIMITIVES = 1 << 20  # maximum number of primitives of all nodes
_MOST_PARTS = 1 << 12  # maximum number of primitives with splats
_GLB_LIMIT = (1 << 32) - 1
_POINTS = 0  # the mode of a primitive


def is_glb(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a GLB file."""
    return head.startswith(glb.MAGIC)


def is_gltf(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a glTF file in JSON, with splats."""
    return head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{") and EXTENSION.encode() in head


@reads
def read_gltf(path: Path) -> GaussianArrays:
    """Read all splats of the scene, placed by their nodes, as one set of Gaussians.

    Raises: UserError: the file cannot be read, is damaged, has no splats, or needs an unsupported
    feature.
    """
    document = glb.Document(path, path.read_bytes())
    notes: set[str] = set()
    try:
        unknown = set(document.json.get("extensionsRequired", [])) - _UNDERSTOOD
        if unknown:
            raise Damaged(
                "it needs {extension}, which is not supported",
                extension=sorted(map(str, unknown))[0][:60],
            )
        parts = _parts(path, document, notes)
        if not parts and EXTENSION not in document.json.get("extensionsUsed", []):
            raise Unsupported(
                "a glTF file without Gaussian splats ({extension})",
                extension=EXTENSION,
            )
        if _are_logarithms([part.log_scales for part, _ in parts]):
            notes.add(
                "SCALE has negative values, so it is read as logarithms, as in the draft of "
                f"{EXTENSION}"
            )
        else:
            parts = [
                (replace(part, log_scales=packing.log_scales(part.log_scales)), matrix)
                for part, matrix in parts
            ]
        placed = [place_in_scene(part, matrix) for part, matrix in parts]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError):
        raise Damaged("its JSON is not valid glTF") from None
    for note in sorted(notes):
        logger.warning("%s: %s", path, note)
    scene = GaussianArrays.cat(placed)
    if any(any(part.origin) for part in placed):
        scene = replace(scene, means=np.concatenate([part.world_means() for part in placed]))
    found = usable_gaussians(path, *packing.flip_axes(scene), antialiased=scene.antialiased)
    try:
        metres = stored_metres(document.json["asset"]["extras"]["metres_per_unit"])
    except (KeyError, IndexError, TypeError):
        metres = None
    return replace(found, metres_per_unit=metres)


def _parts(
    path: Path, document: Document, notes: set[str]
) -> list[tuple[GaussianArrays, np.ndarray]]:
    """The splats of each primitive that has splats, and ``world_from_mesh`` (4, 4).

    The log scales are SCALE as it is stored; ``notes`` gets what is not read as it is meant.

    Raises: Damaged: more splats than the file can have, or another violation of the specification.
    """
    parts: list[tuple[GaussianArrays, np.ndarray]] = []
    seen = count = 0
    for mesh, world_from_mesh in glb.meshes(document):
        seen += len(mesh["primitives"])
        if seen > _MOST_PRIMITIVES:
            raise Damaged(
                "it has more than {most_primitives} primitives", most_primitives=_MOST_PRIMITIVES
            )
        for primitive in mesh["primitives"]:
            extensions = primitive.get("extensions", {})
            inner = extensions.get(EXTENSION, {}).get("extensions", {}) | extensions
            packed = next((inner[name] for name in _SPZ if name in inner), None)
            if packed is not None:
                part = _unpacked(path, document, packed["bufferView"])
            elif EXTENSION in extensions:
                _check(primitive, extensions[EXTENSION], notes)
                part = _splats(document, primitive["attributes"], notes)
            else:
                continue
            count += len(part.means)
            if count > _MOST_COPIES * document.size // _LEAST_BYTES or len(parts) >= _MOST_PARTS:
                raise Damaged("its nodes repeat the splats too often")
            parts.append((part, world_from_mesh))
    return parts


def _unpacked(path: Path, document: Document, view: int) -> GaussianArrays:
    """As `_splats`, of an .spz file."""
    scene = packing.flip_axes(parse_spz(path, bytes(glb.view(document, view))))
    return replace(scene, log_scales=np.exp(scene.log_scales))


def _check(primitive: dict[str, Any], extension: dict[str, Any], notes: set[str]) -> None:
    if primitive.get("mode", 4) != _POINTS:
        raise Damaged("its splats are not points")
    if not any(name.startswith(f"{EXTENSION}:") for name in primitive["attributes"]):
        if "_SCALE" in primitive["attributes"]:
            raise Damaged("its splats are those of an early draft, which is not supported")
        packed = ", ".join(map(str, extension.get("extensions", {}))) or "an unknown method"
        raise Damaged(
            "its splats are compressed by {packed}, which is not supported", packed=packed[:60]
        )
    kernel = extension.get("kernel", "ellipse")
    if kernel != "ellipse":
        notes.add(f"splats of the unknown kernel {quoted(kernel)} are read as ellipses")
    space = extension.get("colorSpace", _SPACES[0])
    if space != _SPACES[0]:
        notes.add(f"colours of {str(space)[:40]} are read as sRGB")


def _are_logarithms(scales: list[np.ndarray]) -> bool:
    """Whether the SCALE of all primitives together is logarithms: it has negative values.

    Standard deviations are never negative; those of a draft of the extension, logarithms, usually
    are. Negative values of less than 0.1% of the largest one are taken for rounding errors.
    """
    values = [part[np.isfinite(part)] for part in scales]
    low = min((float(part.min(initial=0)) for part in values), default=0.0)
    high = max((float(part.max(initial=0)) for part in values), default=0.0)
    return low < -_ROUNDING * high


def place_in_scene(part: GaussianArrays, world_from_mesh: np.ndarray) -> GaussianArrays:
    """The splats in the frame of the scene; ``world_from_mesh`` is (4, 4).

    Positions are relative to an origin: float32 may not be able to store the translation.

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
    x, y, z = world_from_mesh[:3, 3].tolist()
    if not np.array_equal(matrix, np.eye(3)):
        import torch

        from snowsplat.scene.edit import transform
        from snowsplat.scene.geometry import Similarity

        try:
            turn = Similarity(
                float(scale.mean()),
                torch.from_numpy(matrix / scale),
                torch.zeros(3, dtype=torch.float64),
            )
        except ValueError:
            raise Damaged("one of its nodes shears or mirrors its splats") from None
        part = GaussianArrays.from_gaussians(transform(part.to_gaussians(), turn))
    return replace(part, origin=(x, y, z))


def _splats(document: Document, attributes: dict[str, Any], notes: set[str]) -> GaussianArrays:
    """The splats of a primitive, in the frame of its mesh; the log scales are SCALE as stored."""

    def read(name: str, *kinds: str) -> np.ndarray:
        return glb.accessor(document, attributes[name], *(kinds or ("VEC3",)))

    means = read("POSITION")
    names = _coefficients(3)
    present = [name for name in names if name in attributes]
    if not present and "COLOR_0" in attributes:
        notes.add("it has no SH coefficients; the colours are those of COLOR_0")
        sh = [(from_linear(read("COLOR_0", "VEC3", "VEC4")[:, :3]) - 0.5) / SH_C0]
    elif present != names[: len(present)] or len(present) - 1 not in SH_REST_COUNTS:
        raise Damaged(
            "its {present} SH coefficients do not match an SH degree", present=len(present)
        )
    else:
        sh = [read(name) for name in present]
    arrays = (
        means,
        read(f"{EXTENSION}:SCALE"),
        packing.quats_of_xyzw(read(f"{EXTENSION}:ROTATION", "VEC4")),
        packing.logits(read(f"{EXTENSION}:OPACITY", "SCALAR")[:, 0]),
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
    scene = packing.flip_axes(packing.packable(path, gaussians))
    means = scene.means
    cut = packing.Cut(path, "glTF", len(means))
    scales, opacity, sh = packing.linear_values(cut, scene)
    attributes: dict[str, np.ndarray] = {
        "POSITION": means,
        "COLOR_0": _point_colors(scene.sh_dc, opacity),
        f"{EXTENSION}:ROTATION": scene.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacity[:, None],
    }
    degree = SH_REST_COUNTS.index(sh.shape[1] - 1)
    attributes |= {name: sh[:, k] for k, name in enumerate(_coefficients(degree))}
    attributes = {
        name: np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        for name, values in attributes.items()
    }
    if sum(array.nbytes for array in attributes.values()) > _GLB_LIMIT - (1 << 20):
        raise UserError(
            "{path}: {means} Gaussians are too many for .glb; write .ply or .spz",
            path=path,
            means=len(means),
        )
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "snowsplat"}}
    document["extensionsUsed"] = [EXTENSION]
    if gaussians.metres_per_unit:
        document["asset"]["extras"] = {"metres_per_unit": 1.0}
    arrays: list[np.ndarray] = []
    if len(means):
        splats = {"kernel": "ellipse", "colorSpace": _SPACES[0]}
        primitive = {"mode": _POINTS, "extensions": {EXTENSION: splats}}
        node = _node(gaussians.origin, gaussians.metres_per_unit or 1.0)
        contents, arrays = glb.contents(node, primitive, attributes)
        document |= contents
    write_bytes(path, glb.pack(document, arrays))
    cut.report(".ply keeps them")


def _node(origin: Origin, metres: float) -> dict[str, Any]:
    """The node that places the splats, in metres."""
    x, y, z = origin
    node: dict[str, Any] = {"mesh": 0, "name": "splats"}
    if any(origin):
        node["translation"] = [metres * x, -metres * y, -metres * z]
    return node | ({"scale": [metres] * 3} if metres != 1 else {})


def _point_colors(sh_dc: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """(N, 4) uint8 RGBA: the colour without its view-dependent part, in linear light as in glTF."""
    color = np.clip(0.5 + SH_C0 * sh_dc[:, 0], 0, 1)
    return packing.to_bytes(255 * np.concatenate([to_linear(color), opacity[:, None]], 1))
