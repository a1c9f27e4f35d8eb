"""LPIPS compared with the same networks built from torch.nn layers, with random weights."""

import sys
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file as save
from torch import nn

from snowsplat.evaluation.lpips import Lpips, _main
from snowsplat.util.errors import UserError


def alexnet_features() -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(),
    )


def vgg16_features() -> nn.Sequential:
    layers: list[nn.Module] = []
    inputs = 3
    for stage in ([64] * 2, [128] * 2, [256] * 3, [512] * 3, [512] * 3):
        for outputs in stage:
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
        layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


BACKBONES = {
    "alex": (alexnet_features, [1, 4, 7, 9, 11], [64, 192, 384, 256, 256]),
    "vgg": (vgg16_features, [3, 8, 15, 22, 29], [64, 128, 256, 512, 512]),
}


@pytest.fixture
def network(request):
    """Name, backbone, taps, heads, and the state with torchvision's names."""
    name = getattr(request, "param", "alex")
    build, taps, channels = BACKBONES[name]
    torch.manual_seed(0)
    features = build()
    heads = [torch.rand(1, c, 1, 1) for c in channels]
    state = {f"features.{name}": value.clone() for name, value in features.state_dict().items()}
    state |= {f"lin{k}.model.1.weight": head for k, head in enumerate(heads)}
    return name, features, taps, heads, state


@torch.no_grad()
def expected_distance(features, taps, heads, a, b) -> float:
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x, y = (((image - mean) / deviation).permute(2, 0, 1)[None] for image in (a, b))
    total = 0.0
    for i, layer in enumerate(features):
        x, y = layer(x), layer(y)
        if i in taps:
            difference = nn.functional.normalize(x, dim=1) - nn.functional.normalize(y, dim=1)
            head = heads[taps.index(i)]
            total += float(nn.functional.conv2d(difference**2, head).mean())
    return total


def images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    a = torch.rand(41, 53, 3, generator=generator)
    return a, (a + 0.2 * torch.randn(41, 53, 3, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize("network", BACKBONES, indirect=True)
def test_equals_the_reference_networks(network, tmp_path):
    name, features, taps, heads, state = network
    save(state, tmp_path / "weights.safetensors")
    lpips = Lpips.load(tmp_path / "weights.safetensors")
    assert lpips.name == name
    a, b = images()
    expected = expected_distance(features, taps, heads, a, b)
    assert expected > 0.01
    assert lpips(a, b) == pytest.approx(expected, rel=1e-4)
    assert lpips(b, a) == pytest.approx(expected, rel=1e-4)
    assert lpips(a, a) == 0.0


def test_names_of_the_lpips_package_are_read(network, tmp_path):
    _, _, _, _, state = network
    save(state, tmp_path / "plain")
    renamed = {
        name.replace("features.", "net.slice1.").replace("scaling", ""): value.contiguous()
        for name, value in state.items()
    }
    renamed["scaling_layer.shift"] = torch.zeros(1, 3, 1, 1)
    renamed["lins.0.model.1.weight"] = torch.zeros(1, 64, 1, 1)
    save(renamed, tmp_path / "package")
    a, b = images()
    plain, ours = (Lpips.load(tmp_path / name) for name in ("plain", "package"))
    assert plain(a, b) == ours(a, b)


def test_invalid_files_are_rejected(network, tmp_path):
    *_, state = network
    path = tmp_path / "weights.safetensors"
    with pytest.raises(UserError, match="cannot be read"):
        Lpips.load(path)
    for content in (b"", b"hello", b"\x80\x02cos\nsystem\n."):
        path.write_bytes(content)
        with pytest.raises(UserError, match="not a safetensors file"):
            Lpips.load(path)
    torch.save(state, path)  # a pickle
    with pytest.raises(UserError, match="not a safetensors file"):
        Lpips.load(path)
    missing = {key: value for key, value in state.items() if key != "lin3.model.1.weight"}
    save(missing, path)
    with pytest.raises(UserError, match=r"lin3.model.1.weight is missing"):
        Lpips.load(path)
    save({**state, "features.0.bias": torch.zeros(5)}, path)
    with pytest.raises(UserError, match=r"features.0.bias is of shape \(5,\)"):
        Lpips.load(path)
    save(state, path)
    with pytest.raises(UserError, match="at least 32 pixels"):
        Lpips.load(path)(torch.zeros(31, 80, 3), torch.zeros(31, 80, 3))


def test_weights_of_the_package_and_a_file_of_them(network, tmp_path, monkeypatch):
    name, *_, state = network
    package = SimpleNamespace(
        LPIPS=lambda net, verbose: SimpleNamespace(state_dict=lambda: state if net == name else {})
    )
    monkeypatch.setitem(sys.modules, "lpips", package)
    monkeypatch.chdir(tmp_path)
    save(state, tmp_path / "weights.safetensors")
    expected = Lpips.load(tmp_path / "weights.safetensors")(*images())
    assert Lpips.load(name)(*images()) == expected
    assert _main([name, "written.safetensors"]) is None
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert Lpips.load("written.safetensors")(*images()) == expected
    with pytest.raises(UserError, match="pip install lpips"):
        Lpips.load(name)
    assert "pip install lpips" in (_main([name, "x"]) or "")
    assert "use: python -m" in (_main(["resnet", "x"]) or "")


def test_no_network(tmp_path, monkeypatch):
    def offline(net, verbose):
        raise OSError("no route to host")

    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=offline))
    with pytest.raises(UserError, match="cannot download its network"):
        Lpips.load("vgg")
