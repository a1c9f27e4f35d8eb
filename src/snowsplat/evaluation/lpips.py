"""LPIPS, a learned perceptual distance of images (Zhang, Isola, Efros, Shechtman, Wang, CVPR 2018).

It needs the weights of a network that was trained on photos, and of its five linear heads. They are
not part of this package. Where the package `lpips` is installed, ``Lpips.load("vgg")`` takes them
from it; it downloads the network of torchvision when it is first used. For a computer without it,
this command writes a file with both:

    python -m snowsplat.evaluation.lpips vgg lpips_vgg.safetensors

Files of `torch.save` are not read: they are pickles, that is, programs. Even if torch restricts
them to a few harmless functions, a pickle of a hundred bytes can allocate any amount of memory.
Names in the file:

    features.N.weight, features.N.bias    backbone, N as in torchvision's AlexNet or VGG16
    (or net.sliceM.N.weight, …)           the same, as the `lpips` package spells it
    linK.model.1.weight                   (1, C, 1, 1), K = 0..4, the heads

The shape of the first layer shows whether the backbone is AlexNet or VGG16.
"""

from __future__ import annotations

import re
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor
from torch.nn import functional as F

from snowsplat.util.errors import UserError
from snowsplat.util.files import reading
from snowsplat.util.safe_json import check_header

# Mean and standard deviation of ImageNet's colours, converted from the range [0, 1] to [-1, 1]:
# (0.485 − 0.5) · 2 … and 0.229 · 2 …
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
# Smallest width and height of an image in pixels. The backbones halve it several times.
_MIN_SIDE = 32
#: The backbones that the package `lpips` has.
NAMES = ("vgg", "alex")
_BACKBONE = re.compile(r"(?:.*\.)?(?:features|net\.slice\d)\.(\d{1,3})\.(weight|bias)")
_HEAD = re.compile(r"lin(\d)\.model\.1\.weight")


@dataclass(frozen=True)
class _Conv:
    """A convolution, followed by a ReLU."""

    index: int  # N in the names of the weights
    inputs: int  # channels
    outputs: int  # channels
    size: int = 3  # side of the kernel
    stride: int = 1
    padding: int = 1
    tap: bool = False  # the output is one of the five that are compared
    pool: int = 0  # kernel size of the max pooling (stride 2) before this layer; 0: no pooling


_ALEX = (
    _Conv(0, 3, 64, size=11, stride=4, padding=2, tap=True),
    _Conv(3, 64, 192, size=5, padding=2, tap=True, pool=3),
    _Conv(6, 192, 384, tap=True, pool=3),
    _Conv(8, 384, 256, tap=True),
    _Conv(10, 256, 256, tap=True),
)
_VGG16 = (
    _Conv(0, 3, 64),
    _Conv(2, 64, 64, tap=True),
    _Conv(5, 64, 128, pool=2),
    _Conv(7, 128, 128, tap=True),
    _Conv(10, 128, 256, pool=2),
    _Conv(12, 256, 256),
    _Conv(14, 256, 256, tap=True),
    _Conv(17, 256, 512, pool=2),
    _Conv(19, 512, 512),
    _Conv(21, 512, 512, tap=True),
    _Conv(24, 512, 512, pool=2),
    _Conv(26, 512, 512),
    _Conv(28, 512, 512, tap=True),
)


@dataclass(frozen=True)
class Lpips:
    """A backbone and its heads. Call it with two images to get their distance."""

    name: str  # "alex" or "vgg"; distances of different backbones are not comparable
    layers: tuple[_Conv, ...]
    weights: dict[int, tuple[Tensor, Tensor]]  # by layer index: weight, bias
    heads: tuple[Tensor, ...]  # five tensors (C,)

    @staticmethod
    def load(path: Path | str) -> Lpips:
        """Read a weights file; its format is described at the top of this module.

        Args:
            path: a file; or "vgg" or "alex", without a file of this name: the weights of the
                package `lpips`.

        Raises:
            UserError: the file is missing or has another format, or a layer is missing or has
                another shape; `lpips` is not installed, or cannot download its network.
        """
        path = Path(path)
        state = _packaged_state(str(path)) if is_packaged(path) else _read_state(path)
        backbone: dict[tuple[int, str], Tensor] = {}
        heads: dict[int, Tensor] = {}
        for name, value in state.items():
            if match := _BACKBONE.fullmatch(name):
                backbone[int(match[1]), match[2]] = value
            elif match := _HEAD.fullmatch(name):
                heads[int(match[1])] = value
        first = backbone.get((0, "weight"))
        alex = first is not None and tuple(first.shape) == (64, 3, 11, 11)
        layers = _ALEX if alex else _VGG16

        def checked(value: Tensor | None, shape: tuple[int, ...], name: str) -> Tensor:
            if value is None or tuple(value.shape) != shape:
                found = "missing" if value is None else f"of shape {tuple(value.shape)}"
                raise UserError(
                    "{path}: not LPIPS weights: {name} is {found}; the file must contain the "
                    "state of lpips.LPIPS(net='alex') or net='vgg'",
                    path=path,
                    name=name,
                    found=found,
                )
            return value.to(torch.float32).contiguous()

        weights = {}
        for layer in layers:
            kernel = (layer.outputs, layer.inputs, layer.size, layer.size)
            name = f"features.{layer.index}"
            weights[layer.index] = (
                checked(backbone.get((layer.index, "weight")), kernel, f"{name}.weight"),
                checked(backbone.get((layer.index, "bias")), kernel[:1], f"{name}.bias"),
            )
        channels = [layer.outputs for layer in layers if layer.tap]
        linear = tuple(
            checked(heads.get(k), (1, c, 1, 1), f"lin{k}.model.1.weight").reshape(c)
            for k, c in enumerate(channels)
        )
        return Lpips("alex" if alex else "vgg", layers, weights, linear)

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor) -> float:
        """The distance of two images (H, W, 3) in 0..1. It is 0 for equal images.

        d = Σ_k mean over pixels of Σ_c w_kc (f̂_kc(image) − f̂_kc(target))², where f̂_k are the
        features of tap k, normalised to unit length over the channels c.

        Raises:
            UserError: an image is smaller than 32 pixels.
        """
        if min(image.shape[:2]) < _MIN_SIDE:
            raise UserError(
                "LPIPS needs images of at least {min_side} pixels a side", min_side=_MIN_SIDE
            )
        distance = 0.0
        pairs = zip(self._features(image), self._features(target), strict=True)
        for head, (a, b) in zip(self.heads, pairs, strict=True):
            difference = (_unit(a) - _unit(b)).square()
            distance += float(torch.einsum("c,chw->hw", head, difference).mean())
        return distance

    def _features(self, image: Tensor) -> list[Tensor]:
        """The outputs of the five taps, each (C, h, w)."""
        x = image.to(torch.float32).permute(2, 0, 1)[None] * 2.0 - 1.0
        shift, scale = (torch.tensor(values).reshape(1, 3, 1, 1) for values in (_SHIFT, _SCALE))
        x = (x - shift) / scale
        taps = []
        for layer in self.layers:
            if layer.pool:
                x = F.max_pool2d(x, layer.pool, stride=2)
            weight, bias = self.weights[layer.index]
            x = F.conv2d(x, weight, bias, layer.stride, layer.padding).relu_()
            if layer.tap:
                taps.append(x[0])
        return taps


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(0, keepdim=True).sqrt() + 1e-10)


def is_packaged(path: Path) -> bool:
    """Whether ``path`` is the name of a network of the package `lpips`, and no file."""
    return str(path) in NAMES and not path.exists()


def _packaged_state(name: str) -> dict[str, Tensor]:
    """The weights of the package `lpips`."""
    try:
        import lpips  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        raise UserError(
            "LPIPS ({name}) needs its weights: pip install lpips, or give a file of them; see "
            "snowsplat evaluate --help",
            name=name,
        ) from None
    try:
        with warnings.catch_warnings():  # it uses torchvision as that was years ago
            warnings.simplefilter("ignore")
            network = lpips.LPIPS(net=name, verbose=False)
    except OSError as error:  # of urllib
        raise UserError("lpips: cannot download its network ({error})", error=error) from None
    return {key: value.clone() for key, value in network.state_dict().items()}


def _read_state(path: Path) -> dict[str, Tensor]:
    try:
        with reading(path):
            check_header(path)
            return safetensors.torch.load_file(path)
    except (safetensors.SafetensorError, ValueError, KeyError):
        raise UserError(
            "{path}: not a safetensors file; see snowsplat evaluate --help for how to make one",
            path=path,
        ) from None


def _main(arguments: list[str]) -> str | None:
    """Write the weights of a network to a file; returns what is wrong with the arguments."""
    if len(arguments) != 2 or arguments[0] not in NAMES:
        return "use: python -m snowsplat.evaluation.lpips vgg|alex FILE.safetensors"
    try:
        state = _packaged_state(arguments[0])
    except UserError as error:
        return str(error)
    safetensors.torch.save_file(state, arguments[1])
    return None


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
