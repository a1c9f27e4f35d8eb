"""The device webgpu: tensors of torch, and what is refused. Its kernels are a variant in the other
tests of this folder."""

import copy
import subprocess
import sys

import pytest
import torch

from snowsplat import ops
from snowsplat.ops.webgpu import adapter, shaders, tensor
from snowsplat.util.errors import UserError

pytestmark = pytest.mark.webgpu


@pytest.fixture(scope="module")
def device() -> torch.device:
    if (why := adapter.why_unusable()) is not None:
        pytest.skip(f"webgpu: {why}")
    return ops.resolve_device("webgpu")


def on_device_only(values: torch.Tensor, device: torch.device) -> torch.Tensor:
    """A tensor whose copy on the CPU is not up to date: another one has been copied to it."""
    made, source = torch.empty_like(values, device=device), values.to(device)
    source.memory.buffer()
    return made.copy_(source)


def test_views_share_memory(device: torch.device) -> None:
    base = torch.arange(12.0, device=device).view(3, 4)
    base.t()[0, 1] = 77
    assert base.tolist()[1][0] == 77
    base.unbind()[2].zero_()
    assert base[2].tolist() == [0.0] * 4
    assert base[:, ::2].contiguous().tolist() == [[0, 2], [77, 6], [0, 0]]
    assert base.view(torch.int32)[0, 1] == 0x3F800000
    assert base.unsqueeze_(0).shape == (1, 3, 4)


@pytest.mark.parametrize("count", [5, 5000, 70_000])
def test_an_operation_has_the_result_of_the_cpu(device: torch.device, count: int) -> None:
    a, b = torch.rand(count), torch.rand(count)
    factor = torch.tensor(0.25)
    calls = [
        lambda x, y, f: x * y,
        lambda x, y, f: x * f,
        lambda x, y, f: x - y,
        lambda x, y, f: torch.mul(x, y, out=torch.empty_like(x)),
        lambda x, y, f: torch.add(x, y, alpha=3) + 2,
        lambda x, y, f: x.clone().zero_() + y,
        lambda x, y, f: torch.zeros_like(x) + y.new_zeros(len(y)),
        lambda x, y, f: x.clone().fill_(2).sigmoid() * y,
        lambda x, y, f: torch.cat([x, y])[1:-1].cumsum(0),
        lambda x, y, f: x[y > 0.5],
        lambda x, y, f: x.index_add_(0, torch.tensor([1, 1], device=x.device), y[:2]),
        lambda x, y, f: torch.sigmoid(x, out=torch.empty_like(y)),
        lambda x, y, f: x.double().mean() + y.quantile(0.5),
    ]
    for call in calls:
        there = [on_device_only(values, device) for values in (a, b)]
        found = call(*there, on_device_only(factor, device))
        expected = call(a.clone(), b.clone(), factor)
        assert found.device == device
        assert found.dtype == expected.dtype
        torch.testing.assert_close(found.cpu(), expected, rtol=3e-7, atol=0)


def test_gradients_flow(device: torch.device) -> None:
    x = torch.linspace(-1, 1, 20_000)
    grads = []
    for place in (device, torch.device("cpu")):
        leaf = x.to(place).requires_grad_()
        ((leaf * 2)[5:].sigmoid() * leaf[5:]).sum().backward()
        grads.append(leaf.grad.cpu())
    torch.testing.assert_close(*grads)


def test_factories_copies_and_text(device: torch.device) -> None:
    assert torch.arange(3, 9, 2, device=device).tolist() == [3, 5, 7]
    assert torch.tensor([True, False], device=device).tolist() == [True, False]
    assert torch.eye(2, device=device).tolist() == [[1, 0], [0, 1]]
    x = torch.full((3,), 2.0, device=device)
    assert copy.deepcopy(x).tolist() == x.tolist()
    assert repr(x) == "tensor([2., 2., 2.]) on webgpu:0"
    assert f"{x[0]:.1f}" == "2.0"
    with pytest.raises(TypeError, match="call cpu"):
        x.numpy()


def test_reading_twice_is_one_transfer(device: torch.device) -> None:
    x = on_device_only(torch.rand(9000), device)
    tensor.fallbacks.clear()
    assert float(x.sum()) == float(x.sum())
    assert tensor.fallbacks == {"sum.default": 1}


def test_what_a_shader_declares() -> None:
    code = shaders.read(
        """struct Params { n: u32, size: f32 }
        @group(0) @binding(0) var<uniform> params: Params;
        @group(0) @binding(1) var<storage, read> values: array<f32>;  // not made
        @group(0) @binding(2) var<storage, read_write> made: array<f32>;
        fn value(i: u32) -> f32 { return values[i]; }
        @compute @workgroup_size(64) fn first() { made[0] = value(0u); }
        @compute @workgroup_size(1)
        fn second() { made[0] = params.size; }"""
    )
    assert code.numbers == (("n", "u32"), ("size", "f32"))
    assert code.entries == {
        "first": (("values", "made"), False),
        "second": (("made",), True),
    }
    assert [code.bindings[name].written for name in ("values", "made")] == [False, True]


def test_every_kernel_fits_every_browser() -> None:
    for path in shaders.FOLDER.glob("*.wgsl"):
        for entry, (names, _) in shaders.shader(path.stem).entries.items():
            assert len(names) <= adapter.STORAGE_BUFFERS, f"{path.stem}: {entry}"


def test_float64_is_refused(device: torch.device) -> None:
    points = torch.zeros(2, 3, dtype=torch.float64, device=device)
    with pytest.raises(UserError, match="webgpu has no kernels for points_in_spheres_f64"):
        ops.points_in_spheres(points, torch.zeros(1, 4, dtype=torch.float64, device=device))


def test_gradients_that_were_computed_before_are_refused_in_one_line(device: torch.device) -> None:
    script = (
        "import torch; torch.ones(1, requires_grad=True).backward()\n"
        "from snowsplat import ops; ops.resolve_device('webgpu')"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert "UserError: webgpu: torch has computed gradients" in run.stderr
