"""Files of meshes and point clouds: PLY, GLB, OBJ, USDZ, LAS and LAZ.

PLY and LAS keep the frame of the scene. In GLB, OBJ and USDZ, y is up, as other programs expect it
of these formats.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats import glb, mesh_usdz
from snowsplat.scene.mesh import Mesh, y_up
from snowsplat.scene.origin import HERE
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.ply import header_of
from snowsplat.util.srgb import to_linear

MESH_SUFFIXES = (".ply", ".glb", ".obj", ".usdz")
POINTS_SUFFIXES = (".ply", ".las", ".laz")
#: What the suffixes need, by the names of modules.
_PACKAGES = {".las": ("laspy",), ".laz": ("laspy", "lazrs"), ".usdz": ("pxr",)}
_GLB_LIMIT = (1 << 32) - (1 << 20)
_OBJ_ROWS = 1 << 16


def check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raises UserError: another suffix, or a package that it needs is missing."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise UserError(
            "{path}: unknown format; use {suffixes} or {suffixes2}",
            path=path,
            suffixes=", ".join(suffixes[:-1]),
            suffixes2=suffixes[-1],
        )
    for package in _PACKAGES.get(suffix, ()):
        if find_spec(package) is None:
            raise UserError(
                "{suffix} needs the package {package}: pip install 'snowsplat[{extra}]'; or use "
                ".ply",
                suffix=suffix,
                package=package,
                extra="usd" if suffix == ".usdz" else "mesh",
            )


def write_mesh(path: Path, mesh: Mesh, comments: list[str]) -> None:
    """Write a mesh, or a cloud of points, in the format of the suffix, atomically.

    ``comments``: ASCII lines, for formats that have comments.

    Raises:
        UserError: an unknown suffix, or a mesh too large for the format.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    if path.suffix.lower() == ".usdz":
        mesh_usdz.write_usdz(path, mesh)
        return
    write = {".ply": _write_ply, ".glb": _write_glb, ".obj": _write_obj}.get(path.suffix.lower())
    if write is None:
        check_suffix(path, POINTS_SUFFIXES)
        write = _write_las
    with atomic_path(path) as temporary:
        write(temporary, mesh, comments)


def _world(mesh: Mesh) -> np.ndarray:
    """(V, 3) positions in the world: float64 if float32 would not be precise enough."""
    if mesh.origin == HERE:
        return mesh.vertices
    return mesh.vertices.astype(np.float64) + np.array(mesh.origin)


def _write_ply(path: Path, mesh: Mesh, comments: list[str]) -> None:
    places = _world(mesh)
    real, code = ("float", "<f4") if places.dtype == np.float32 else ("double", "<f8")
    columns = [*((real, code, n) for n in "xyz"), *(("float", "<f4", f"n{n}") for n in "xyz")]
    columns += [("uchar", "u1", n) for n in ("red", "green", "blue")]
    rows = np.empty(len(places), [(name, code) for _, code, name in columns])
    for values, names in (
        (places, "x y z"),
        (mesh.normals, "nx ny nz"),
        (mesh.colors, "red green blue"),
    ):
        for k, name in enumerate(names.split()):
            rows[name] = values[:, k]
    elements = [("vertex", len(rows), [(kind, name) for kind, _, name in columns])]
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("rows", "<i4", 3)])
    faces["count"], faces["rows"] = 3, mesh.faces
    if len(faces):
        elements.append(("face", len(faces), [("list uchar int", "vertex_indices")]))
    with open(path, "wb") as file:
        file.write(header_of(elements, comments))
        file.write(rows.tobytes())
        file.write(faces.tobytes())


def _write_glb(path: Path, mesh: Mesh, comments: list[str]) -> None:
    turn = y_up(mesh.up).T
    colors = np.full((len(mesh.colors), 4), 65535, "<u2")
    colors[:, :3] = np.rint(65535 * to_linear(mesh.colors / 255.0))
    attributes = {
        "POSITION": (mesh.vertices @ turn).astype("<f4"),
        "NORMAL": (_unit(mesh.normals) @ turn).astype("<f4"),
        "COLOR_0": colors,
    }
    rows = mesh.faces.astype("<u4").reshape(-1, 1)
    if sum(array.nbytes for array in (*attributes.values(), rows)) > _GLB_LIMIT:
        raise UserError("the mesh is too large for .glb; use .ply, or fewer `triangles`")
    node: dict[str, Any] = {"mesh": 0, "name": "mesh"}
    if mesh.origin != HERE:
        node["translation"] = (np.array(mesh.origin) @ turn).tolist()
    scene, arrays = glb.contents(node, {"mode": 4, "material": 0}, attributes, rows)
    # The light of the scene is in the colours of the photos.
    material = {"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    material["pbrMetallicRoughness"] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    document = {
        "asset": {"version": "2.0", "generator": "snowsplat"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [material],
    }
    with open(path, "wb") as file:
        file.writelines(glb.pack(document | scene, arrays))


def _unit(normals: np.ndarray) -> np.ndarray:
    """The normals; (0, 0, 1) where unknown, because glTF requires a direction."""
    return np.where(normals.any(1, keepdims=True), normals, np.array([0, 0, 1], np.float32))


def _write_obj(path: Path, mesh: Mesh, comments: list[str]) -> None:
    turn = y_up(mesh.up).T
    rows = np.concatenate([_world(mesh) @ turn, mesh.colors / 255.0], 1)
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.writelines(f"# {comment}\n" for comment in comments)
        for start in range(0, len(rows), _OBJ_ROWS):
            part = slice(start, start + _OBJ_ROWS)
            np.savetxt(file, rows[part], "v %.9g %.9g %.9g %.4f %.4f %.4f")
            np.savetxt(file, mesh.normals[part] @ turn, "vn %.4f %.4f %.4f")
        for start in range(0, len(mesh.faces), _OBJ_ROWS):
            corners = np.repeat(mesh.faces[start : start + _OBJ_ROWS] + 1, 2, axis=1)
            np.savetxt(file, corners, "f %d//%d %d//%d %d//%d")


def _write_las(path: Path, mesh: Mesh, comments: list[str]) -> None:
    import laspy  # an optional package

    places = _world(mesh).astype(np.float64)
    head = laspy.LasHeader(point_format=2, version="1.2")
    head.generating_software = "snowsplat"
    head.offsets = np.floor(places.min(0)) if len(places) else np.zeros(3)
    extent = float(np.ptp(places, axis=0).max()) if len(places) else 1.0
    head.scales = np.full(3, 10.0 ** np.ceil(np.log10(max(extent, 1e-12) / 2**30)))
    head.add_extra_dims([laspy.ExtraBytesParams(name=n, type="f4") for n in ("nx", "ny", "nz")])
    cloud = laspy.LasData(head)
    cloud.x, cloud.y, cloud.z = places.T
    cloud.red, cloud.green, cloud.blue = (mesh.colors.astype(np.uint16) * 257).T
    cloud.nx, cloud.ny, cloud.nz = mesh.normals.T
    with open(path, "wb") as file:
        cloud.write(file, do_compress=path.name.lower().endswith(".laz"))
