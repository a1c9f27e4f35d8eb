"""Checks and times a training step on this machine's WebGPU adapter, beside the CPU: a minute.

    python benchmarks/webgpu.py                  20,000 Gaussians, 320×240
    python benchmarks/webgpu.py --gaussians 200000 --width 1280 --height 720

It prints the adapter, the largest differences from the CPU, and the milliseconds of each stage.
"""

import argparse
import platform
import statistics
import time
from types import SimpleNamespace

import torch
from torch import Tensor

import snowsplat
from snowsplat import ops
from snowsplat.ops import AdamRates, Moments, SplatGradient, View

STAGES = ("project", "rasterize", "loss", "backward", "adam")
RATES = dict.fromkeys(ops.gaussian_parameters.PARAMETERS, 1e-3)


def scene(count: int) -> dict[str, Tensor]:
    """Gaussians in front of the camera; the opacities make about half of the pixels opaque."""
    torch.manual_seed(0)
    depth = 2 + 4 * torch.rand(count)
    across = (2 * torch.rand(count, 2) - 1) * depth[:, None] * torch.tensor([0.8, 0.6])
    return {
        "means": torch.cat([across, depth[:, None]], dim=1),
        "log_scales": torch.randn(count, 3) * 0.5 - 0.5 * torch.tensor(float(count)).log() + 0.8,
        "quats": torch.randn(count, 4),
        "opacity_logits": torch.randn(count),
        "sh_dc": torch.randn(count, 1, 3),
        "sh_rest": 0.2 * torch.randn(count, 15, 3),
    }


class Steps:
    """Training steps of a scene on a device."""

    def __init__(self, tensors: dict[str, Tensor], width: int, height: int, device: str) -> None:
        self.device = ops.resolve_device(device)
        self.tensors = {name: tensor.clone().to(self.device) for name, tensor in tensors.items()}
        self.size = width, height
        self.view = View(
            torch.eye(3, 4), width, height, width / 1.5, width / 1.5, width / 2, height / 2, 3
        )
        self.moments = Moments(
            *({n: torch.zeros_like(t) for n, t in self.tensors.items()} for _ in range(2))
        )
        self.photo = torch.rand(3, height, width, generator=torch.Generator().manual_seed(1))
        self.photo = self.photo.to(self.device).permute(1, 2, 0)

    def run(self) -> tuple[dict[str, float], Tensor, Tensor]:
        """Milliseconds of the stages, the image and the gradient of the splats of visible rows."""
        gaussians = SimpleNamespace(**self.tensors)
        marks = [time.perf_counter()]

        def done(*made: Tensor) -> None:
            for tensor in made:
                tensor.detach().reshape(-1)[:1].cpu()  # waits
            marks.append(time.perf_counter())

        splats = ops.project(gaussians, self.view)
        done(splats.packed)
        splats.packed.requires_grad_()
        image, _, _ = ops.rasterize(splats, *self.size)
        done(image)
        loss = ops.photometric_loss(image, self.photo)
        done(loss)
        loss.backward()
        grad = splats.packed.grad
        done(grad)
        ops.adam_step(
            gaussians, self.moments, SplatGradient.of(splats), self.view, AdamRates(RATES, 1)
        )
        done(self.tensors["means"])
        times = {n: 1e3 * (b - a) for n, a, b in zip(STAGES, marks, marks[1:], strict=False)}
        return times, image.detach().cpu(), grad.cpu()[splats.ids.cpu() >= 0]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--steps", type=int, default=5)
    options = parser.parse_args()
    tensors = scene(options.gaussians)
    found = {d: Steps(tensors, options.width, options.height, d) for d in ("cpu", "webgpu")}
    print(f"snowsplat {snowsplat.__version__}, torch {torch.__version__}, {platform.platform()}")
    for steps in found.values():
        print(ops.device_name(steps.device))
    (_, image, grad), (_, image_there, grad_there) = (steps.run() for steps in found.values())
    print(f"image: differs by at most {(image - image_there).abs().max():.1e}")
    if grad.shape == grad_there.shape:
        print(f"gradient: by {(grad - grad_there).norm() / grad.norm():.1e} of its norm")
    else:
        print(f"visible: {len(grad):,} on the CPU, {len(grad_there):,} on webgpu")
    for name, tensor in found["cpu"].tensors.items():
        moved = (tensor - tensors[name]).norm()
        away = (tensor - found["webgpu"].tensors[name].cpu()).norm()
        print(f"{name} after a step: by {away / moved:.1e} of it")
    print(f"{'ms':10}" + "".join(f"{stage:>11}" for stage in STAGES))
    for device, steps in found.items():
        all_times = [steps.run()[0] for _ in range(options.steps)]
        medians = [statistics.median(times[stage] for times in all_times) for stage in STAGES]
        print(f"{device:10}" + "".join(f"{each:11.1f}" for each in medians))


if __name__ == "__main__":
    main()
