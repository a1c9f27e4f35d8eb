"""Networks on disk: an ONNX file and a folder of transformers, both made here."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from snowsplat.extras.lift.lift_photo import estimate_depth
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
