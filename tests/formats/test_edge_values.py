"""Values at the edge: opacities of 0 and 1, flat axes, values beyond the range of a format, and the
variants of PLY that other trainers write."""

import math

import numpy as np
import pytest
import torch

from snowsplat.formats import FORMATS, GaussianArrays, read_arrays, read_gaussians, write_gaussians
from snowsplat.formats.packing import fitting_factor
from snowsplat.formats.spz import _SCALE_RANGE
from snowsplat.scene.sh_constants import SH_C0

WRITTEN = [f for f in FORMATS if f.read and f.write]


def write_columns(path, columns: dict[str, np.ndarray], types: dict[str, str] | None = None):
    """A PLY of these columns, by an independent writer."""
    codes = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2"}
    kinds = {name: (types or {}).get(name, "float") for name in columns}
    rows = np.empty(len(columns["x"]), [(name, codes[kind]) for name, kind in kinds.items()])
    for name, values in columns.items():
        rows[name] = values
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {kind} {name}" for name, kind in kinds.items()]
    path.write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + rows.tobytes())
    return path


def columns_of(scene) -> dict[str, np.ndarray]:
    means, scales, quats, logits, dc, _ = GaussianArrays.from_gaussians(scene)
    named = {"x": means[:, 0], "y": means[:, 1], "z": means[:, 2], "opacity": logits}
    named |= {f"f_dc_{i}": dc[:, 0, i] for i in range(3)}
    named |= {f"scale_{i}": scales[:, i] for i in range(3)}
    return named | {f"rot_{i}": quats[:, i] for i in range(4)}


@pytest.fixture
def edges(make_scene):
    """Some Gaussians of opacity 1 and 0, a flat one, a line and a point."""
    scene = make_scene(30, 1)
    scene.opacity_logits[:3], scene.opacity_logits[3] = torch.inf, -torch.inf
    scene.log_scales[4, 2] = -torch.inf
    scene.log_scales[5, 1:] = -torch.inf
    scene.log_scales[6] = -torch.inf
    return scene


@pytest.mark.parametrize("format", WRITTEN, ids=lambda format: format.name)
def test_opacities_of_0_and_1_and_flat_axes_are_kept(tmp_path, edges, psnr, caplog, format):
    path = tmp_path / f"a{format.suffixes[0]}"
    write_gaussians(path, edges)
    read = read_gaussians(path)
    assert len(read) == 30
    assert "not finite" not in caplog.text
    assert psnr(edges, read) > (25 if format.name == "splat" else 38)
    if format.name == "PLY":
        assert torch.equal(read.opacity_logits, edges.opacity_logits)
        assert torch.equal(read.log_scales, edges.log_scales)
    else:
        assert int((read.opacities > 0.998).sum()) >= 3


def test_a_scene_with_edges_can_be_decimated(edges):
    from snowsplat.scene.simplify import simplify

    smaller = simplify(edges, 20)
    assert len(smaller) == 20
    assert all(bool(tensor.isfinite().all()) for tensor in smaller.parameters().values())


def test_what_spz_cannot_hold_is_counted_with_advice(tmp_path, make_scene, caplog):
    scene = make_scene(3000, 0)
    scene.log_scales[:] = scene.log_scales.clamp(-6, 0)
    write_gaussians(tmp_path / "a.spz", scene)
    scene.log_scales[:, 1] = -14.0  # thin axes that are not visible
    write_gaussians(tmp_path / "a.spz", scene)
    assert caplog.text == ""
    scene.sh_dc[:9] = 4.0
    write_gaussians(tmp_path / "a.spz", scene)
    assert "colours of 9 (from -0.44 to 1.44) of 3,000 Gaussians" in caplog.text
    read = read_gaussians(tmp_path / "a.spz")
    assert float(0.5 + SH_C0 * read.sh_dc.max()) == pytest.approx(1.44, abs=0.01)
    scene.sh_dc[:9] = 0.0
    scene.log_scales[:7] = math.log(1500)
    write_gaussians(tmp_path / "a.spz", scene)
    expected = "scales of 7 (up to 1500, at most 379) of 3,000 Gaussians; scaled by 0.1, all"
    assert expected in caplog.text
    caplog.clear()
    write_gaussians(tmp_path / "a.sog", scene)
    write_gaussians(tmp_path / "a.compressed.ply", scene)
    assert caplog.text == ""
    scene.log_scales[:] = torch.tensor(-12.0)
    write_gaussians(tmp_path / "a.spz", scene)
    assert "the small scales of 3,000" in caplog.text
    assert "scaled by 100, all scales fit" in caplog.text


def test_the_factor_is_a_power_of_ten_that_makes_all_scales_fit():
    low, high = _SCALE_RANGE
    for scales in ([1500.0, 5.0], [1e-4, 1e-3], [400.0, 1e-2]):
        logs = np.log(np.array(scales))[:, None].repeat(3, 1)
        factor = fitting_factor(logs, low, high)
        assert factor is not None
        assert math.log10(factor) == pytest.approx(round(math.log10(factor)))
        moved = logs + math.log(factor)
        assert moved.max() <= high
        assert moved.max(1).min() >= low
    assert fitting_factor(np.log([[1e5] * 3, [1e-5] * 3]), low, high) is None


def test_sh_of_degree_4_are_reduced(tmp_path, make_scene, caplog):
    scene = make_scene(9, 3)
    rest = np.random.default_rng(0).normal(size=(9, 3, 24))  # by channel
    rest[:, :, :15] = scene.sh_rest.numpy().transpose(0, 2, 1)
    columns = columns_of(scene)
    columns |= {f"f_rest_{c * 24 + i}": rest[:, c, i] for c in range(3) for i in range(24)}
    read = read_gaussians(write_columns(tmp_path / "a.ply", columns))
    assert torch.equal(read.sh_rest, scene.sh_rest)
    assert "SH degree 4 is reduced to 3" in caplog.text


def test_the_filter_of_mip_splatting_is_applied(tmp_path, make_scene, caplog):
    caplog.set_level("INFO")
    scene = make_scene(50, 0)
    size = np.exp(scene.log_scales.numpy().astype(np.float64))
    wide = np.linspace(0, 0.2, 50)
    columns = columns_of(scene) | {"filter_3D": wide}
    read = read_gaussians(write_columns(tmp_path / "a.ply", columns))
    expected = np.sqrt(size**2 + wide[:, None] ** 2)
    np.testing.assert_allclose(read.scales, expected, rtol=1e-5)
    opacities = scene.opacities.numpy() * (size.prod(1) / expected.prod(1))
    np.testing.assert_allclose(read.opacities, opacities, rtol=1e-4)
    assert torch.equal(read.opacity_logits[0], scene.opacity_logits[0])
    assert "filter_3D" in caplog.text
    columns["opacity"] = np.full(50, np.inf)
    read = read_gaussians(write_columns(tmp_path / "a.ply", columns))
    np.testing.assert_allclose(read.opacities, size.prod(1) / expected.prod(1), rtol=1e-4)


def test_two_scales_are_a_flat_gaussian(tmp_path, make_scene):
    columns = columns_of(make_scene(9, 0))
    del columns["scale_2"]
    read = read_gaussians(write_columns(tmp_path / "a.ply", columns))
    assert torch.equal(read.log_scales[:, 0], torch.from_numpy(columns["scale_0"]))
    thin = read.scales[:, 2] / read.scales[:, :2].min(1).values
    torch.testing.assert_close(thin, torch.full((9,), 1e-4))


@pytest.mark.parametrize(
    ("kind", "white"), [("uchar", 255), ("ushort", 65535), ("float", 1), ("double", 255)]
)
def test_colours_in_place_of_f_dc(tmp_path, make_scene, kind, white):
    columns = {n: v for n, v in columns_of(make_scene(3, 0)).items() if not n.startswith("f_dc")}
    colors = np.array([[0.0, 0.2, 1.0]] * 3)
    names = ("red", "green", "blue")
    columns |= {name: white * colors[:, i] for i, name in enumerate(names)}
    path = write_columns(tmp_path / "a.ply", columns, dict.fromkeys(names, kind))
    read = read_gaussians(path)
    np.testing.assert_allclose(0.5 + SH_C0 * read.sh_dc[:, 0], colors, atol=1e-5)


UTM = np.array([500_000.0, 5_400_000.0, 300.0])


@pytest.mark.parametrize("ascii", [False, True])
def test_doubles_far_from_0_keep_their_precision(tmp_path, make_scene, ascii):
    scene = make_scene(200, 0)
    world = scene.means.numpy().astype(np.float64) + UTM
    columns = columns_of(scene) | dict(zip("xyz", world.T, strict=True))
    path = write_columns(tmp_path / "a.ply", columns, dict.fromkeys("xyz", "double"))
    if ascii:
        head = path.read_bytes().split(b"end_header\n")[0].decode()
        head = head.replace("binary_little_endian", "ascii").replace("double", "float")
        rows = [" ".join(repr(float(v[i])) for v in columns.values()) for i in range(200)]
        path.write_text(head + "end_header\n" + "\n".join(rows) + "\n")
    read = read_arrays(path)
    assert any(read.origin)
    assert np.abs(read.means).max() < 10
    np.testing.assert_allclose(read.world_means(), world, rtol=0, atol=1e-6)


@pytest.mark.parametrize("format", WRITTEN, ids=lambda format: format.name)
def test_the_origin_is_kept(tmp_path, make_scene, format):
    scene = make_scene(200, 1)
    scene.origin = tuple(UTM.tolist())
    path = tmp_path / f"a{format.suffixes[0]}"
    write_gaussians(path, scene)
    read = read_arrays(path)
    world = np.sort(scene.means.numpy().astype(np.float64) + UTM, 0)
    precision = {"compressed PLY": 5e-3, "SOG": 1e-3, "streamed SOG": 1e-3}.get(format.name, 2e-4)
    np.testing.assert_allclose(np.sort(read.world_means(), 0), world, rtol=0, atol=precision)
    # Another scene in its place must not inherit the origin.
    write_gaussians(path, make_scene(5, 0))
    assert read_arrays(path).origin == (0.0, 0.0, 0.0)
    assert not list(tmp_path.glob("*.origin.json"))


def test_a_damaged_origin_is_a_warning(tmp_path, make_scene, caplog):
    write_gaussians(tmp_path / "a.spz", make_scene(5, 0))
    for text in ("", "[]", '{"origin": [1, 2]}', '{"origin": [1, 2, NaN]}', '{"origin": "x"}'):
        caplog.clear()
        (tmp_path / "a.spz.origin.json").write_text(text)
        assert read_arrays(tmp_path / "a.spz").origin == (0.0, 0.0, 0.0)
        assert "the place of the scene is unknown" in caplog.text


def test_positions_that_a_file_has_rounded_are_named(tmp_path, make_scene, caplog):
    scene = make_scene(200, 0)
    write_gaussians(tmp_path / "a.ply", scene)
    read_gaussians(tmp_path / "a.ply")
    assert caplog.text == ""
    scene.means += torch.from_numpy(UTM).float()
    write_gaussians(tmp_path / "a.ply", scene)
    read_gaussians(tmp_path / "a.ply")
    assert caplog.text.count("rounded to steps of 0.5") == 1
    scene.log_scales[:] = -27.6  # points, as another program writes a scale of 0
    write_gaussians(tmp_path / "a.ply", scene)
    read_gaussians(tmp_path / "a.ply")
    assert caplog.text.count("rounded to steps") == 1
