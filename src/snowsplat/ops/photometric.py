"""`photometric_loss` and `ssim`: the difference between an image and a photo."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.check import check_float, variant
from snowsplat.ops.native import launch


def photometric_loss(
    image: Tensor, target: Tensor, ssim_weight: float = 0.2, huber_weight: float = 0.0
) -> Tensor:
    """(1 − λ) · mean |a − b| + λ · (1 − SSIM) + w · mean h(a − b), a scalar.

    λ is `ssim_weight`, and w, which is 0 in the paper (eq. 7), is `huber_weight`. The Huber
    function h(x) is x² where |x| ≤ δ = 0.1, and δ (2 |x| − δ) elsewhere (Huber 1964).

    image (H, W, 3): float32 or float64. target (H, W, 3): of the same dtype, or uint8, which is
    divided by 255. If the storage is planar, as of `planar.permute(1, 2, 0)`, no copy is made. The
    gradient flows only to `image`. It is computed together with the value, in one pass over the
    images.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    weights = (1 - ssim_weight, -ssim_weight, huber_weight)
    return _Photometric.apply(image, target, weights, "photometric_loss") + ssim_weight


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity over pixels and channels (Wang et al. 2004), a scalar.

    The window is Gaussian, 11×11 with σ = 1.5; the images are padded with zeros; C₁ = 0.01²,
    C₂ = 0.03². Arguments and errors are as for `photometric_loss`.
    """
    return _Photometric.apply(image, target, (0.0, 1.0, 0.0), "ssim")


def _planar(op: str, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    check_float(op, "image", image)
    if image.dim() != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"{op}: image must be (H, W, 3), got {tuple(image.shape)}")
    if target.shape != image.shape:
        raise ValueError(
            f"{op}: target must be {tuple(image.shape)} as image is, got {tuple(target.shape)}"
        )
    if target.dtype not in (image.dtype, torch.uint8):
        raise ValueError(f"{op}: target must be {image.dtype} or uint8, got {target.dtype}")
    if target.device != image.device:
        raise ValueError(f"{op}: target must be on {image.device}, got {target.device}")
    return image.permute(2, 0, 1).contiguous(), target.permute(2, 0, 1).contiguous()


class _Photometric(torch.autograd.Function):
    """The sum of L1, SSIM and Huber with `weights`; `op` is the name in error messages."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        weights: tuple[float, float, float],
        op: str,
    ) -> Tensor:
        planes, target_planes = _planar(op, image.detach(), target)
        grad = None
        if ctx.needs_input_grad[0]:
            grad = scratch.empty_like(planes)
        means = torch.empty(3, dtype=torch.float64, device=planes.device)
        name = "photometric_u8" if target_planes.dtype == torch.uint8 else "photometric"
        channels, height, width = planes.shape
        launch(
            variant(name, planes),
            n=channels,
            width=width,
            height=height,
            image=planes,
            target=target_planes,
            l1_weight=weights[0],
            ssim_weight=weights[1],
            huber_weight=weights[2],
            grad=grad,
            means=means,
        )
        ctx.grad = grad
        # Tensors, because reading their values would wait for a GPU. Without Huber, its mean is not
        # added: the recordings of CUDA graphs have one operation less.
        value = weights[0] * means[0] + weights[1] * means[1]
        value = value + weights[2] * means[2] if weights[2] else value
        return value.to(planes.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_value: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.grad is None:
            return None, None, None, None
        on_cpu = grad_value.device.type == "cpu"  # on a GPU, reading the value would wait
        grad = ctx.grad if on_cpu and float(grad_value) == 1.0 else ctx.grad * grad_value
        return grad.permute(1, 2, 0), None, None, None
