"""`snowsplat mesh` and `snowsplat points`: their files, read by trimesh, and their errors."""

import json
import struct
import sys
import zipfile

import numpy as np
import pytest
import trimesh
from PIL import Image

from snowsplat.formats import mesh_files
from snowsplat.scene.mesh import Mesh


@pytest.fixture(scope="module")
def out(dataset, tmp_path_factory):
    from snowsplat.cli.main import main

    folder = tmp_path_factory.mktemp("mesh") / "out"
    assert main(["train", str(dataset), "-o", str(folder), "--iterations", "30"]) == 0
    return folder


def test_mesh_and_points_of_a_training(run, out, tmp_path):
    target = tmp_path / "a.ply"
    result = run("mesh", out, "-o", target, "--json", "--voxel", "0.1")
    assert result.code == 0, result.err
    told = json.loads(result.out)
    mesh = trimesh.load(target, process=False)
    assert len(mesh.faces) == told["triangles"] > 100
    assert (told["voxel"], told["photos"]) == (0.1, 9)
    assert mesh.visual.vertex_colors[:, :3].std(0).min() > 1  # not all the same
    assert "next" not in result.out
    again = run("mesh", out, "-o", target)
    assert again.code == 2
    assert "--overwrite" in again.err
    cloud = tmp_path / "cloud.ply"
    result = run("points", out, "-o", cloud, "--voxel", "0.1")
    assert result.code == 0, result.err
    assert "points from 9 photos" in result.out
    assert np.array_equal(trimesh.load(cloud).vertices, mesh.vertices)


def test_errors_are_one_line(refused, out, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("snowsplat.pipeline.options.scene.find_spec", lambda name: None)
    monkeypatch.setattr("snowsplat.formats.mesh_files.find_spec", lambda name: None)
    for arguments, message in (
        (("mesh",), "-o"),
        (("mesh", out, "-o", tmp_path / "a.stl"), "use .ply, .glb, .obj or .usdz"),
        (("mesh", out, "-o", tmp_path / "a.usdz"), "pip install 'snowsplat[usd]'"),
        (("points", out, "-o", tmp_path / "a.laz"), "pip install 'snowsplat[mesh]'"),
        (("mesh", out, "-o", tmp_path / "a.ply", "--triangles", "9"), "fast-simplification"),
        (("mesh", out, "-o", tmp_path / "a.ply", "--voxel", "-1"), "--voxel"),
        (("mesh", out, "-o", tmp_path / "a.ply", "--far", "0.01"), "--far"),
        (("mesh", out, "-o", tmp_path / "a.ply", "--voxel", "1e-5"), "--voxel"),
        (("mesh", tmp_path / "none", "-o", tmp_path / "a.ply"), "none"),
    ):
        assert message in refused(*arguments)
    assert list(tmp_path.iterdir()) == []


def _tetrahedron(**more) -> Mesh:
    vertices = np.float32([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    faces = np.int32([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    colors = np.uint8([[0, 0, 0], [255, 0, 0], [0, 128, 0], [0, 0, 255]])
    return Mesh(vertices, faces, normals, colors, **more)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_files_in_trimesh(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    mesh_files.write_mesh(path, _tetrahedron(origin=(1000.0, 0.0, 0.0)), ["a comment"])
    mesh = trimesh.load(path, process=False, force="mesh")
    assert np.isclose(mesh.volume, 1.0)  # positive: the triangles are counter-clockwise
    sign = np.array([1, 1, 1]) if suffix == ".ply" else np.array([1, -1, -1])
    expected = (_tetrahedron().vertices + np.array([1000, 0, 0])) * sign
    assert np.allclose(sorted(mesh.vertices.tolist()), sorted(expected.tolist()), atol=1e-5)
    if suffix != ".glb":  # trimesh ignores the colours of vertices that have a material
        green = np.abs(mesh.vertices - expected[2]).sum(1).argmin()
        assert np.abs(mesh.visual.vertex_colors[green][:3].astype(int) - [0, 128, 0]).max() <= 1


def test_glb_follows_the_rules(tmp_path):
    path = tmp_path / "a.glb"
    mesh_files.write_mesh(path, _tetrahedron(up=(0.0, 0.0, 1.0)), [])
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    position = document["accessors"][0]
    assert (position["max"], position["min"]) == ([1, 3, 0], [0, 0, -2])  # z becomes y
    sizes = {5126: 4, 5123: 2, 5125: 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        row = width * sizes[accessor["componentType"]]
        assert (row % 4, view["byteOffset"] % 4) == (0, 0)  # alignment of vertex attributes
        assert view["byteLength"] == row * accessor["count"]
    binary = data[28 + size :]
    normals = np.frombuffer(binary, "<f4", 12, document["bufferViews"][1]["byteOffset"])
    assert np.allclose(np.linalg.norm(normals.reshape(4, 3), axis=1), 1)
    assert document["buffers"][0]["byteLength"] == len(binary)


@pytest.mark.parametrize(("metres", "unit"), [(None, 0.3), (0.5, 0.5)])
def test_usdz_for_phones(tmp_path, metres, unit):
    """OpenUSD finds nothing to complain about, and the texture has the colours of the corners."""
    Usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdShade, UsdValidation

    path = tmp_path / "a.usdz"
    mesh = _tetrahedron(up=(0.0, 0.0, 1.0), metres_per_unit=metres)
    mesh_files.write_mesh(path, mesh, [])
    assert [file.name for file in tmp_path.iterdir()] == ["a.usdz"]
    stage = Usd.Stage.Open(str(path))
    known = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(known).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    assert np.isclose(UsdGeom.GetStageMetersPerUnit(stage), unit)  # 2 units are 0.6 m wide
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
    box = UsdGeom.BBoxCache(0, ["default"]).ComputeWorldBound(shape.GetPrim()).ComputeAlignedRange()
    assert np.allclose(box.GetMin(), (-0.5, 0, -1)), box
    assert np.allclose(box.GetMax(), (0.5, 3, 1)), box
    texture = UsdShade.Shader(stage.GetPrimAtPath("/scene/material/texture"))
    with zipfile.ZipFile(path) as files:
        pixels = np.array(
            Image.open(files.open(texture.GetInput("file").Get().path.removeprefix("./")))
        )
    corners = np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get()) * len(pixels)
    column, row = corners[:, 0].astype(int), (len(pixels) - corners[:, 1]).astype(int)
    rows = np.array(shape.GetFaceVertexIndicesAttr().Get())
    assert np.array_equal(pixels[row, column], mesh.colors[rows])


def test_las_in_laspy(tmp_path):
    laspy = pytest.importorskip("laspy")
    path = tmp_path / "a.las"
    mesh_files.write_mesh(path, _tetrahedron(origin=(500000.0, 5400000.0, 0.0)), [])
    cloud = laspy.read(path)
    expected = _tetrahedron().vertices + np.array([500000.0, 5400000.0, 0.0])
    assert np.allclose(np.stack([cloud.x, cloud.y, cloud.z], 1), expected, atol=1e-4)
    assert cloud.green.tolist() == [0, 0, 128 * 257, 0]
    assert np.allclose(cloud.nz, [0, 0, 0, 1])
