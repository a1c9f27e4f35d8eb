"""glTF: lossless up to rounding; nodes place the splats; malicious JSON is a one-line error."""

import base64
import json
import math
import struct

import numpy as np
import pytest
import torch

from snowsplat.formats import read_arrays, read_gaussians, write_gaussians
from snowsplat.scene import edit
from snowsplat.scene.geometry import Similarity, rotation_from_quat

PREFIX = "KHR_gaussian_splatting:"


def parts(path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    binary = data[20 + size + 8 :]
    if binary:
        assert struct.unpack_from("<I4s", data, 20 + size) == (len(binary), b"BIN\0")
    return json.loads(data[20 : 20 + size]), binary


def assemble(path, document, binary: bytes):
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


@pytest.fixture
def seed(tmp_path, make_scene):
    """JSON and binary chunk of a small file, and its scene."""
    scene = make_scene(30, 2)
    write_gaussians(tmp_path / "seed.glb", scene)
    return (*parts(tmp_path / "seed.glb"), scene)


def assert_same(a, b, atol=2e-6):
    for name in ("means", "log_scales", "sh_dc", "sh_rest", "opacities"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-5, atol=atol)
    assert float((1 - (a.rotations * b.rotations).sum(1).abs()).max()) < 1e-6


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 500])
def test_round_trip(tmp_path, make_scene, psnr, degree, n):
    scene = make_scene(n, degree)
    write_gaussians(tmp_path / "a.glb", scene)
    read = read_gaussians(tmp_path / "a.glb")
    assert read.sh_degree == degree
    assert_same(read, scene)
    assert psnr(scene, read) > 90


def test_zeros_are_exact(tmp_path, make_scene):
    """Without a transform in its node, a scene does not pass through a rotation of its SH."""
    scene = make_scene(10, 3)
    scene.sh_rest[:, ::2] = 0
    scene.means[:, 1] = 0
    write_gaussians(tmp_path / "a.glb", scene)
    read = read_gaussians(tmp_path / "a.glb")
    assert torch.equal(read.sh_rest, scene.sh_rest)
    assert torch.equal(read.means, scene.means)


def test_the_layout_is_that_of_the_specification(seed, tmp_path):
    document, binary, scene = seed
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert document["scenes"][document["scene"]] == {"nodes": [0]}
    assert document["nodes"] == [{"mesh": 0, "name": "splats"}]
    ((primitive,),) = [mesh["primitives"] for mesh in document["meshes"]]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}

    def values(name: str) -> np.ndarray:
        entry = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][entry["bufferView"]]
        data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(data, {5126: "<f4", 5121: "u1"}[entry["componentType"]]).reshape(
            30, -1
        )

    means, scales = values("POSITION"), values(PREFIX + "SCALE")
    # y up, z toward the viewer, x unchanged.
    np.testing.assert_array_equal(means * [1, -1, -1], scene.means.numpy())
    entry = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(entry["min"], means.min(0))
    np.testing.assert_array_equal(entry["max"], means.max(0))
    np.testing.assert_allclose(scales, scene.scales.numpy(), rtol=1e-6)
    np.testing.assert_allclose(values(PREFIX + "OPACITY")[:, 0], scene.opacities, rtol=1e-6)
    x, y, z, w = values(PREFIX + "ROTATION").T
    unit = scene.rotations.numpy()
    np.testing.assert_allclose(np.stack([w, x, -y, -z], 1), unit, atol=1e-6)
    np.testing.assert_array_equal(values(PREFIX + "SH_DEGREE_0_COEF_0"), scene.sh_dc[:, 0])
    # With y and z negated, (-y, z, -x) changes the signs of the first two of degree 1.
    for n, sign in enumerate((-1, -1, 1)):
        coefficient = values(f"{PREFIX}SH_DEGREE_1_COEF_{n}")
        np.testing.assert_array_equal(coefficient, sign * scene.sh_rest[:, n].numpy())
    color = np.clip(0.5 + 0.28209479 * scene.sh_dc[:, 0].numpy(), 0, 1)
    assert np.abs(values("COLOR_0")[:, :3] / 255 - color**2.2).max() < 0.02


def test_nodes_place_the_splats(seed, tmp_path):
    document, binary, scene = seed
    angle = 0.7
    quat = [0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)]  # about y, xyzw
    document["nodes"] = [
        {"children": [1, 2], "translation": [1, 2, 3], "rotation": quat, "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [0, 0, 1]},
        {"mesh": 0, "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
    ]
    read = read_gaussians(assemble(tmp_path / "a.glb", document, binary))
    assert len(read) == 60
    up = Similarity(1.0, torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.zeros(3))
    turn = rotation_from_quat(torch.tensor([quat[3], 0.0, quat[1], 0.0], dtype=torch.float64))
    outer = Similarity(2.0, turn, torch.tensor([1.0, 2.0, 3.0]))
    shift = Similarity(1.0, torch.eye(3), torch.tensor([0.0, 0.0, 1.0]))
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    second = Similarity(1.0, quarter, torch.tensor([5.0, 0.0, 0.0]))
    for rows, inner in ((slice(0, 30), shift), (slice(30, 60), second)):
        expected = scene
        for step in (up, inner, outer, up):
            expected = edit.transform(expected, step)
        got = read.select(torch.arange(60)[rows])
        assert_same(got, expected, atol=2e-5)


def test_parts_of_different_degrees_get_the_highest(seed, tmp_path, make_scene):
    """Rows of a lower degree get zeros."""
    document, binary, scene = seed
    low = make_scene(5, 0, seed=4)
    write_gaussians(tmp_path / "low.glb", low)
    other, more = parts(tmp_path / "low.glb")
    shift = len(document["bufferViews"])
    for view in other["bufferViews"]:
        view["byteOffset"] = view.get("byteOffset", 0) + len(binary)
    for accessor in other["accessors"]:
        accessor["bufferView"] += shift
    primitive(other)["attributes"] = {
        name: number + len(document["accessors"])
        for name, number in primitive(other)["attributes"].items()
    }
    document["bufferViews"] += other["bufferViews"]
    document["accessors"] += other["accessors"]
    document["meshes"][0]["primitives"].append(primitive(other))
    document["buffers"][0]["byteLength"] += len(more)
    read = read_gaussians(assemble(tmp_path / "b.glb", document, binary + more))
    assert (len(read), read.sh_degree) == (35, 2)
    assert_same(read.select(torch.arange(30)), scene)
    assert_same(read.select(torch.arange(30, 35)), edit.with_sh_degree(low, 2))


def test_quantised_attributes(seed, tmp_path):
    """The types that the specification allows, interleaved."""
    document, _, scene = seed
    del document["accessors"][7:], document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    rows = np.zeros(
        30,
        [
            ("p", "<f4", 3),
            ("r", "<i2", 4),
            ("s", "<u2", 3),
            ("o", "u1"),
            ("_", "u1"),
            ("c", "<f4", 3),
        ],
    )
    rows["p"] = scene.means.numpy() * [1, -1, -1]
    w, x, y, z = scene.rotations.numpy().T
    rows["r"] = np.rint(32767 * np.stack([x, -y, -z, w], 1))
    scales = torch.randint(1, 9, (30, 3), generator=torch.Generator().manual_seed(0))
    rows["s"] = scales
    rows["o"] = np.rint(255 * scene.opacities.numpy())
    rows["c"] = scene.sh_dc[:, 0]
    document["bufferViews"] = [
        {"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize}
    ]
    names = {"POSITION": 0, "ROTATION": 1, "SCALE": 2, "OPACITY": 3, "SH_DEGREE_0_COEF_0": 4}
    columns = [("p", 5126, "VEC3"), ("r", 5122, "VEC4"), ("s", 5123, "VEC3")]
    columns += [("o", 5121, "SCALAR"), ("c", 5126, "VEC3")]
    document["accessors"] = [
        {
            "bufferView": 0,
            "byteOffset": rows.dtype.fields[column][1],
            "componentType": code,
            "type": kind,
            "count": 30,
            "normalized": column in "ro",
        }
        for column, code, kind in columns
    ]
    document["meshes"][0]["primitives"][0]["attributes"] = {
        (PREFIX if name != "POSITION" else "") + name: index for name, index in names.items()
    }
    read = read_gaussians(assemble(tmp_path / "a.glb", document, rows.tobytes()))
    assert read.sh_degree == 0
    torch.testing.assert_close(read.means, scene.means)
    torch.testing.assert_close(read.scales, scales.float())
    torch.testing.assert_close(read.opacities, scene.opacities, rtol=0, atol=0.003)
    assert float((1 - (read.rotations * scene.rotations).sum(1).abs()).max()) < 1e-6


def test_an_empty_scene_and_a_file_without_splats(tmp_path, make_scene, one_line):
    write_gaussians(tmp_path / "a.glb", make_scene(0, 3))
    assert len(read_gaussians(tmp_path / "a.glb")) == 0
    document, _ = parts(tmp_path / "a.glb")
    assert "meshes" not in document  # an empty accessor is not valid glTF
    del document["extensionsUsed"]
    assert "without Gaussian splats" in one_line(assemble(tmp_path / "b.glb", document, b""))


def primitive(document: dict) -> dict:
    return document["meshes"][0]["primitives"][0]


def extension(document: dict) -> dict:
    return primitive(document)["extensions"]["KHR_gaussian_splatting"]


BROKEN = {
    "count huge": lambda d: d["accessors"][0].update(count=10**15),
    "count negative": lambda d: d["accessors"][0].update(count=-1),
    "count less": lambda d: d["accessors"][0].update(count=7),
    "count a word": lambda d: d["accessors"][0].update(count="7"),
    "no buffer view": lambda d: d["accessors"][0].pop("bufferView"),
    "sparse": lambda d: d["accessors"][0].update(sparse={}),
    "of integers": lambda d: d["accessors"][0].update(componentType=5125),
    "of pairs": lambda d: d["accessors"][0].update(type="VEC2"),
    "view outside": lambda d: d["bufferViews"][0].update(byteOffset=10**9),
    "view too long": lambda d: d["bufferViews"][-1].update(byteLength=10**9),
    "stride of none": lambda d: d["bufferViews"][0].update(byteStride=0),
    "offset negative": lambda d: d["accessors"][0].update(byteOffset=-4),
    "index outside": lambda d: primitive(d)["attributes"].update(POSITION=99),
    "index negative": lambda d: primitive(d)["attributes"].update(POSITION=-1),
    "no position": lambda d: primitive(d)["attributes"].pop("POSITION"),
    "no scale": lambda d: primitive(d)["attributes"].pop(PREFIX + "SCALE"),
    "part of a degree": lambda d: primitive(d)["attributes"].pop(PREFIX + "SH_DEGREE_2_COEF_3"),
    "a missing degree": lambda d: [
        primitive(d)["attributes"].pop(f"{PREFIX}SH_DEGREE_1_COEF_{n}") for n in range(3)
    ],
    "triangles": lambda d: primitive(d).update(mode=4),
    "packed": lambda d: (
        primitive(d).update(attributes={"POSITION": 0}),
        extension(d).update(extensions={"KHR_gaussian_splatting_compression_spz_2": {}}),
    ),
    "needs more": lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]),
    "another file": lambda d: d["buffers"][0].update(uri="../../etc/passwd"),
    "a circle": lambda d: d["nodes"][0].update(children=[0]),
    "many times": lambda d: d.update(
        nodes=[{"mesh": 0}] * 200, scenes=[{"nodes": list(range(200))}]
    ),
    "one node many times": lambda d: d.update(scenes=[{"nodes": [0] * 1000}]),
    "flat": lambda d: d["nodes"][0].update(scale=[1, 1, 0]),
    "stretched": lambda d: d["nodes"][0].update(scale=[1, 2, 1]),
    "mirrored": lambda d: d["nodes"][0].update(scale=[1, 1, -1]),
    "infinite": lambda d: d["nodes"][0].update(translation=[1e999, 0, 0]),
    "meshes a word": lambda d: d.update(meshes="m"),
    "nodes numbers": lambda d: d.update(nodes=[1, 2]),
    "accessors missing": lambda d: d.pop("accessors"),
    "extension a list": lambda d: primitive(d).update(extensions=[]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_invalid_json_is_reported(tmp_path, seed, one_line, name):
    document, binary, _ = seed
    BROKEN[name](document)
    one_line(assemble(tmp_path / "a.glb", document, binary))


def test_the_method_of_compressed_splats_is_named_if_it_is_known(tmp_path, seed, one_line):
    document, binary, _ = seed
    primitive(document)["attributes"] = {"POSITION": 0}
    path = assemble(tmp_path / "a.glb", document, binary)
    assert "compressed by an unknown method" in one_line(path)
    extension(document)["extensions"] = {"EXT_some_compression": {}}
    path = assemble(tmp_path / "a.glb", document, binary)
    assert "compressed by EXT_some_compression" in one_line(path)
    primitive(document)["attributes"] = {"POSITION": 0, "_SCALE": 1, "_ROTATION": 2}
    path = assemble(tmp_path / "a.glb", document, binary)
    assert "an early draft" in one_line(path)


@pytest.mark.parametrize("draft", ["spz_2", "spz", "the first"])
def test_splats_in_an_spz_file_are_read(tmp_path, make_scene, one_line, draft):
    """As 3dgs_io writes them: the accessors have no data."""
    write_gaussians(tmp_path / "a.spz", make_scene(40, 2))
    packed = (tmp_path / "a.spz").read_bytes()
    name = f"KHR_gaussian_splatting_compression_{draft}"
    extensions = {PREFIX[:-1]: {"kernel": "ellipse", "extensions": {name: {"bufferView": 1}}}}
    if draft == "the first":
        name = "KHR_spz_gaussian_splats_compression"
        extensions = {name: {"bufferView": 1}}
    attributes = {"POSITION": 0, f"{PREFIX}SCALE": 1}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [PREFIX[:-1], name],
        "extensionsRequired": [name],
        "nodes": [{"mesh": 0, "translation": [1, 2, 3]}],
        "meshes": [
            {"primitives": [{"mode": 0, "attributes": attributes, "extensions": extensions}]}
        ],
        "accessors": [{"componentType": 5126, "count": 40, "type": "VEC3"}] * 2,
        "bufferViews": [
            {"buffer": 0, "byteLength": 4},
            {"buffer": 0, "byteOffset": 4, "byteLength": len(packed)},
        ],
        "buffers": [{"byteLength": 4 + len(packed)}],
    }
    read = read_gaussians(assemble(tmp_path / "a.glb", document, bytes(4) + packed))
    read.means += torch.tensor(read.origin) - torch.tensor([1.0, -2, -3])  # y down, z forward
    assert_same(read, read_gaussians(tmp_path / "a.spz"))
    document["bufferViews"][1]["byteLength"] += 1
    assert "exceeds" in one_line(assemble(tmp_path / "a.glb", document, bytes(4) + packed))
    document["bufferViews"][1]["byteLength"] = len(packed) // 2
    assert "damaged" in one_line(assemble(tmp_path / "a.glb", document, bytes(4) + packed))


def test_invalid_chunks_are_reported(tmp_path, seed, one_line):
    document, binary, _ = seed
    data = assemble(tmp_path / "a.glb", document, binary).read_bytes()
    for at, word in ((4, 1), (8, 2**32 - 1), (12, 2**32 - 1), (12, 8), (16, 7)):
        (tmp_path / "a.glb").write_bytes(data[:at] + struct.pack("<I", word) + data[at + 4 :])
        one_line(tmp_path / "a.glb")
    for length in (4, 12, 19, 200, len(data) - 1):
        (tmp_path / "a.glb").write_bytes(data[:length])
        one_line(tmp_path / "a.glb")
    for text in (b"[" * 100_000, b"7", b"{]", b'{"a":' + b"9" * 10_000 + b"}"):
        one_line(assemble(tmp_path / "a.glb", text, binary))


def test_linear_colours_are_a_warning(tmp_path, seed, caplog):
    document, binary, _ = seed
    extension(document)["colorSpace"] = "lin_rec709_display"
    assert len(read_gaussians(assemble(tmp_path / "a.glb", document, binary))) == 30
    assert "read as sRGB" in caplog.text


# Files of other writers


def floats(document: dict, binary: bytearray, name: str) -> np.ndarray:
    """The values of a float attribute, which can be changed in place."""
    view = document["bufferViews"][
        document["accessors"][primitive(document)["attributes"][name]]["bufferView"]
    ]
    return np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"])


def test_negative_scales_are_logarithms(tmp_path, seed, caplog):
    document, binary, scene = seed
    changed = bytearray(binary)
    values = floats(document, changed, PREFIX + "SCALE")
    values[:] = np.log(values)
    assert_same(read_gaussians(assemble(tmp_path / "a.glb", document, changed)), scene)
    assert caplog.text.count("read as logarithms") == 1
    # A rounding error below 0 in linear values does not change the meaning of the others.
    caplog.clear()
    changed = bytearray(binary)
    floats(document, changed, PREFIX + "SCALE")[4] = -1e-7
    read = read_gaussians(assemble(tmp_path / "a.glb", document, changed))
    torch.testing.assert_close(read.scales[2:], scene.scales[2:])
    assert caplog.text == ""


def test_logarithms_are_decided_for_all_primitives_together(tmp_path, seed):
    """A primitive without negative values beside one with them, as in files of the draft."""
    document, binary, _ = seed
    changed = bytearray(binary)
    values = floats(document, changed, PREFIX + "SCALE")
    values[:] = 0.5
    more = np.full(90, -0.5, "<f4").tobytes()
    document["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(changed), "byteLength": len(more)}
    )
    document["buffers"][0]["byteLength"] += len(more)
    document["accessors"].append(
        {"bufferView": len(document["bufferViews"]) - 1, "componentType": 5126, "count": 30,
         "type": "VEC3"}
    )  # fmt: skip
    second = json.loads(json.dumps(primitive(document)))
    second["attributes"][PREFIX + "SCALE"] = len(document["accessors"]) - 1
    document["meshes"][0]["primitives"].append(second)
    read = read_gaussians(assemble(tmp_path / "a.glb", document, bytes(changed) + more))
    expected = torch.tensor([0.5, -0.5]).repeat_interleave(30)[:, None].expand(60, 3)
    torch.testing.assert_close(read.log_scales, expected)


def test_an_unknown_kernel_falls_back_to_the_ellipse(tmp_path, seed, caplog):
    document, binary, scene = seed
    extension(document)["kernel"] = "customShape"
    document["meshes"][0]["primitives"] *= 3
    read = read_gaussians(assemble(tmp_path / "a.glb", document, binary))
    assert_same(read.select(torch.arange(30)), scene)
    assert caplog.text.count("'customShape' are read as ellipses") == 1


def test_colours_without_sh_coefficients_are_those_of_color_0(tmp_path, seed, caplog):
    document, binary, scene = seed
    own = primitive(document)["attributes"]
    primitive(document)["attributes"] = {k: v for k, v in own.items() if "SH_DEGREE" not in k}
    read = read_gaussians(assemble(tmp_path / "a.glb", document, binary))
    assert read.sh_degree == 0
    error = (read.base_colors - scene.base_colors.clamp(0, 1)).abs()
    assert float(error.max()) < 0.03  # 8 bits in linear light are coarse where it is dark
    assert float(error.median()) < 0.003
    assert "COLOR_0" in caplog.text


def test_json_with_data_in_files_and_data_uris(tmp_path, seed, one_line):
    document, binary, scene = seed
    buffer = document["buffers"][0]
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/the data.bin").write_bytes(binary)
    encoded = base64.b64encode(binary).decode()
    for uri in ("sub/the%20data.bin", f"data:application/octet-stream;base64,{encoded}"):
        buffer["uri"] = uri
        path = tmp_path / "a.gltf"
        path.write_text(json.dumps(document))
        assert_same(read_gaussians(path), scene)
        assert_same(read_gaussians(assemble(tmp_path / "a.glb", document, b"")), scene)
    outside = tmp_path.parent / "outside.bin"
    outside.write_bytes(binary)
    for uri, expected in {
        "../outside.bin": "outside of its folder",
        str(outside): "outside of its folder",
        "https://example.org/a.bin": "outside of its folder",
        "file:///etc/passwd": "outside of its folder",
        "missing.bin": "missing",
        "data:;base64,*": "base64",
        "data:text/plain,abc": "exceeds",
        "sub": "missing",
    }.items():
        buffer["uri"] = uri
        path.write_text(json.dumps(document))
        assert expected in one_line(path)


def test_a_node_far_from_0_keeps_the_precision(tmp_path, seed):
    """Translations have float64, for example in tiles on a globe."""
    document, binary, scene = seed
    document["nodes"][0]["translation"] = [4_000_000.25, 5.5, -3_000_000.75]
    read = read_arrays(assemble(tmp_path / "a.glb", document, binary))
    world = scene.means.double().numpy() + np.array([4_000_000.25, -5.5, 3_000_000.75])
    np.testing.assert_allclose(read.world_means(), world, rtol=0, atol=1e-5)
    assert np.abs(read.means).max() < 100


def test_sparse_accessors_and_instances(seed, tmp_path, one_line):
    """Some rows of an attribute are replaced; a node draws its splats several times."""
    document, binary, scene = seed
    binary = bytearray(binary)

    def append(*arrays: np.ndarray) -> list[int]:
        for array in arrays:
            view = {"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes}
            document["bufferViews"].append(view)
            binary.extend(array.tobytes())
        return [len(document["bufferViews"]) - i for i in range(len(arrays), 0, -1)]

    rows, values = append(np.array([3, 9], "<u2"), np.array([[1, 2, 3], [4, 5, 6]], "<f4"))
    position = document["accessors"][primitive(document)["attributes"]["POSITION"]]
    position["sparse"] = {
        "count": 2,
        "indices": {"bufferView": rows, "componentType": 5123},
        "values": {"bufferView": values},
    }
    (moves,) = append(np.array([[0, 0, 0], [10, 0, 0]], "<f4"))
    accessor = {"bufferView": moves, "componentType": 5126, "count": 2, "type": "VEC3"}
    document["accessors"].append(accessor)
    attributes = {"TRANSLATION": len(document["accessors"]) - 1}
    document["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    document["buffers"][0]["byteLength"] = len(binary)
    means = read_gaussians(assemble(tmp_path / "a.glb", document, bytes(binary))).means
    expected = scene.means.clone()
    expected[[3, 9]] = torch.tensor([[1.0, -2, -3], [4, -5, -6]])
    torch.testing.assert_close(means, torch.cat([expected, expected + torch.tensor([10.0, 0, 0])]))
    position.pop("bufferView")  # zeros
    means = read_gaussians(assemble(tmp_path / "b.glb", document, bytes(binary))).means
    assert int((means[:30] != 0).any(1).sum()) == 2
    for change in (
        lambda: position.__setitem__("count", 10**9),
        lambda: position["sparse"]["indices"].__setitem__("componentType", 5126),
        lambda: position["sparse"].__setitem__("count", 3),
    ):
        change()
        path = assemble(tmp_path / "c.glb", document, bytes(binary))
        assert one_line(path)
