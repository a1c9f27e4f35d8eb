"""A mesh as USDZ, for augmented reality on phones: AR Quick Look puts it on the floor.

Phones ignore the colours of vertices. So the file has a texture with 2×2 pixels for each triangle:
three have the colours of its corners, and the fourth continues them. Between the centres of these
pixels, a bilinear interpolation of the texture is the linear one of the corners. `mesh.usda` has
what all files share. The package usd-core writes the file: `pip install "snowsplat[usd]"`.
"""

import math
from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.formats.usd import open_usd
from snowsplat.scene.mesh import Mesh, y_up
from snowsplat.util.files import new_entries

#: Metres: the width of a scene whose true scale is unknown.
_WIDTH = 0.6


def write_usdz(path: Path, mesh: Mesh) -> None:
    """Write a mesh whose lowest point is at height 0, atomically; y is up.

    Raises:
        UserError: usd-core is missing.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    places = (mesh.vertices @ y_up(mesh.up).T).astype(np.float32)
    low, high = places.min(0), places.max(0)
    floor = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    width = float(max(high[0] - low[0], high[2] - low[2], 1e-9))
    pixels, corners = _texture(mesh)
    with (
        open_usd(path) as (Usd, UsdGeom, UsdUtils, _, Sdf, Vt),
        new_entries(path.parent, [path.name]) as new,
    ):
        inner, made = new / "scene.usdc", new / "made.usdz"
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.ImportFromString(Path(__file__).with_name("mesh.usda").read_text("utf-8"))
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageMetersPerUnit(stage, mesh.metres_per_unit or _WIDTH / width)
        shape = UsdGeom.Mesh.Get(stage, "/scene/mesh")
        shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy((places - floor).astype(np.float32)))
        extent = np.stack([low - floor, high - floor]).astype(np.float32)
        shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        counts = np.full(len(mesh.faces), 3, np.int32)
        shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
        rows = np.ascontiguousarray(mesh.faces.ravel(), np.int32)
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(rows))
        UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Set(Vt.Vec2fArray.FromNumpy(corners))
        Image.fromarray(pixels).save(new / "colours.png")
        layer.Export(str(inner))
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(inner)), str(made))
        made.replace(new / path.name)


def _texture(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The texture (S, S, 3) uint8, and where the corners of the triangles are in it, (3 F, 2)
    float32 from 0 to 1 with y up."""
    side = math.ceil(math.sqrt(len(mesh.faces)))
    a, b, c = np.moveaxis(mesh.colors[mesh.faces].astype(np.int16), 1, 0)
    squares = np.zeros((side * side, 4, 3), np.uint8)
    squares[: len(a)] = np.stack([a, b, c, np.clip(b + c - a, 0, 255)], 1)
    pixels = squares.reshape(side, side, 2, 2, 3).transpose(0, 2, 1, 3, 4)
    row, column = np.divmod(np.arange(len(a)), side)
    at = np.stack([2 * column, 2 * row], 1)[:, None] + [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]]
    at = at.reshape(-1, 2) / (2 * side)
    at[:, 1] = 1 - at[:, 1]
    return np.ascontiguousarray(pixels.reshape(2 * side, 2 * side, 3)), at.astype(np.float32)
