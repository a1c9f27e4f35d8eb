"""Networks on disk: an ONNX file and a folder of transformers, both made here."""

import sys

import numpy as np
import pytest
import torch

from snowsplat.data.maps.depth_alignment import align
from snowsplat.extras.lift.lift_photo import estimate_depth
from snowsplat.scene.geometry import transform_points
from snowsplat.util.errors import UserError

MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


@pytest.fixture
def photo() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 3, 4, generator=generator)
    return torch.nn.functional.interpolate(coarse, (30, 40), mode="bilinear")[0].permute(1, 2, 0)


def write_onnx(path, height, width):
    """A network whose output is the sum of the three channels of its input."""
    onnx = pytest.importorskip("onnx")
    number = onnx.TensorProto.FLOAT
    axes = onnx.helper.make_tensor("axes", onnx.TensorProto.INT64, [1], [1])
    node = onnx.helper.make_node("ReduceSum", ["image", "axes"], ["depth"], keepdims=0)
    given = onnx.helper.make_tensor_value_info("image", number, [1, 3, height, width])
    result = onnx.helper.make_tensor_value_info("depth", number, [1, height, width])
    graph = onnx.helper.make_graph([node], "sum", [given], [result], [axes])
    versions = [onnx.helper.make_opsetid("", 13)]
    model = onnx.helper.make_model(graph, opset_imports=versions, ir_version=8)
    onnx.save(model, str(path))


@pytest.mark.parametrize(("height", "width", "shape"), [(30, 40, (30, 40)), ("h", "w", (518, 686))])
def test_an_onnx_network(tmp_path, photo, height, width, shape):
    pytest.importorskip("onnxruntime")
    write_onnx(tmp_path / "sum.onnx", height, width)
    values = estimate_depth(tmp_path / "sum.onnx", photo)
    assert values.shape == shape
    assert values.dtype == np.float32
    expected = ((photo.numpy() - MEAN) / STD).sum(2)
    at = np.ix_(*(np.arange(n) * size // n for n, size in zip((30, 40), shape, strict=True)))
    assert np.abs(values[at] - expected).max() < (1e-4 if shape == (30, 40) else 0.5)


def test_a_folder_of_transformers(tmp_path, photo, monkeypatch):
    transformers = pytest.importorskip("transformers")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, patch_size=14, reassemble_hidden_size=16,
        neck_hidden_sizes=[8, 8, 8, 8], fusion_hidden_size=8, head_hidden_size=8,
    )  # fmt: skip
    network = transformers.DepthAnythingForDepthEstimation(config).eval()
    network.save_pretrained(tmp_path)
    transformers.DPTImageProcessor(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    ).save_pretrained(tmp_path)
    values = estimate_depth(tmp_path, photo)
    assert values.ndim == 2
    assert np.isfinite(values).all()
    assert values.std() > 0
    assert np.array_equal(values, estimate_depth(tmp_path, photo))


def test_missing_and_damaged_models(tmp_path, photo):
    with pytest.raises(UserError, match="does not download"):
        estimate_depth(tmp_path / "none.onnx", photo)
    (tmp_path / "weights.pth").write_bytes(b"PK")
    with pytest.raises(UserError, match="unknown kind of model"):
        estimate_depth(tmp_path / "weights.pth", photo)


def test_a_damaged_onnx_file(tmp_path, photo):
    pytest.importorskip("onnxruntime")
    (tmp_path / "damaged.onnx").write_bytes(b"\x00" * 100)
    with pytest.raises(UserError, match="cannot be used") as error:
        estimate_depth(tmp_path / "damaged.onnx", photo)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("package", "name"), [("onnxruntime", "model.onnx"), ("transformers", "folder")]
)
def test_missing_packages_are_named(tmp_path, photo, monkeypatch, package, name):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / "model.onnx").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=f"pip install {package}"):
        estimate_depth(tmp_path / name, photo)


def points_on(shot, count, hidden, noise):
    """World points on the surface of a photo; a share is behind it."""
    generator = torch.Generator().manual_seed(0)
    height, width = shot.depth.shape
    row = torch.randint(height, (count,), generator=generator)
    column = torch.randint(width, (count,), generator=generator)
    z = shot.depth[row, column].double()
    z *= 1 + noise * torch.randn(count, generator=generator).double()
    behind = torch.rand(count, generator=generator) < hidden
    z = torch.where(behind, z * (1.3 + torch.rand(count, generator=generator)), z)
    camera = shot.camera
    x = (column + 0.5 - camera.cx) / camera.fx * z
    y = (row + 0.5 - camera.cy) / camera.fy * z
    return transform_points(camera.world_from_cam, torch.stack([x, y, z], 1))


def test_a_factor(shots):
    shot = shots[0]
    points = points_on(shot, 400, hidden=0.4, noise=0.005)
    found = align(shot.depth * 7, points, shot.camera, with_shift=False)
    assert found.scale == pytest.approx(7, rel=0.01)
    assert found.shift == 0
    assert found.points == 400
    assert found.error < 0.1
    torch.testing.assert_close(found.apply(shot.depth * 7), shot.depth, rtol=0.02, atol=0)


def test_a_disparity_with_a_shift(shots):
    shot = shots[0]
    points = points_on(shot, 400, hidden=0.3, noise=0.005)
    relative = 1 / (3.0 / shot.depth + 0.5)
    found = align(relative, points, shot.camera, with_shift=True)
    torch.testing.assert_close(found.apply(relative), shot.depth, rtol=0.03, atol=0)
    # Without the shift, the fit is worse.
    scaled = align(relative, points, shot.camera, with_shift=False).apply(relative)
    assert float((scaled / shot.depth - 1).abs().max()) > 0.1


def test_a_map_that_contradicts_the_points(shots):
    shot = shots[0]
    points = points_on(shot, 400, hidden=0.0, noise=0.0)
    with pytest.raises(UserError, match="contradicts"):
        align(1 / shot.depth, points, shot.camera, with_shift=True)


def test_too_few_points_in_the_photo(shots):
    shot = shots[0]
    with pytest.raises(UserError, match="only 12 points"):
        align(shot.depth, points_on(shot, 12, 0, 0), shot.camera, with_shift=False)
