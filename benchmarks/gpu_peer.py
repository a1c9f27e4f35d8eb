"""Compares our training step with gsplat's (Apache 2.0), if installed, on the same tensors.

There are three comparisons: an image; an image and the gradients of the parameters, by autograd;
and a complete training step. In the third comparison, our step is that of the trainer, and gsplat's
step uses our fused loss and PyTorch's fused Adam. gsplat has two memory layouts; the faster one
counts.
"""

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from gpu_jobs import finding
from gpu_step import GPU, Step, event, milliseconds
from torch import Tensor
from workloads import Workload

from snowsplat import ops
from snowsplat.evaluation.metrics import psnr
from snowsplat.scene.render import project


def build() -> None:
    """Render a first image, so that gsplat compiles its kernels."""
    try:
        import gsplat
    except ImportError as error:
        finding("no peer", why=str(error))
        return
    from gpu_ops import random_scene

    peer = Peer(random_scene(100, 64, 48))
    peer.image()
    torch.cuda.synchronize()
    finding("peer", version=getattr(gsplat, "__version__", "of unknown version"))


class Peer:
    """A scene in the representation of gsplat's own trainer."""

    def __init__(self, scene: Workload) -> None:
        gaussians, camera = scene.gaussians.to(GPU), scene.camera
        self.parameters = {
            name: p.clone().requires_grad_() for name, p in gaussians.parameters().items()
        }
        pose = torch.eye(4)
        pose[:3] = camera.cam_from_world.float()
        self._pose = pose[None].to(GPU)
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        self._matrix = torch.tensor(matrix)[None].to(GPU)
        self._size = camera.width, camera.height
        self.packed = False

    def image(self) -> Tensor:
        """(H, W, 3), without gradient."""
        with torch.no_grad():
            return self._render()

    def _render(self) -> Tensor:
        from gsplat import rasterization

        p = self.parameters
        image, _, _ = rasterization(
            p["means"],
            p["quats"],
            p["log_scales"].exp(),
            p["opacity_logits"].sigmoid(),
            torch.cat([p["sh_dc"], p["sh_rest"]], dim=1),
            self._pose,
            self._matrix,
            *self._size,
            near_plane=0.2,
            sh_degree=3,
            packed=self.packed,
        )
        return image[0]

    def gradient(self, photo: Tensor) -> None:
        for p in self.parameters.values():
            p.grad = None
        # The layout that our op reads fastest: planar.
        image = self._render().permute(2, 0, 1).contiguous().permute(1, 2, 0)
        ops.photometric_loss(image, photo).backward()

    def optimizer(self) -> torch.optim.Adam:
        return torch.optim.Adam(self.parameters.values(), lr=0.0, eps=1e-15, fused=True)


def compare(scene: Workload, size: str, repeats: int) -> None:
    try:
        import gsplat  # noqa: F401
    except ImportError:
        return  # reported by `build`
    peer, step = Peer(scene), Step(scene, GPU)
    for _ in range(3):
        step.run()
    photo = step.photo.rgb
    camera = step.camera
    theirs = peer.image()
    ours = _our_image(step)
    finding("peer image", size=size, psnr=psnr(ours.clamp(0, 1), theirs.clamp(0, 1)))
    optimizer = peer.optimizer()

    def their_step() -> None:
        peer.gradient(photo)
        optimizer.step()

    capacity = step.trainer.runner.capacity
    gaussians = step.trainer.gaussians.map(lambda p: p.clone().requires_grad_())

    def our_gradient() -> None:
        for p in gaussians.parameters().values():
            p.grad = None
        splats = project(gaussians, camera)
        image, _, _ = ops.rasterize(splats, camera.width, camera.height, capacity=capacity)
        ops.photometric_loss(image, photo).backward()

    pairs: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
        "image": (partial(_our_image, step), peer.image),
        "image and gradient": (our_gradient, partial(peer.gradient, photo)),
        "training step": (step.queue, their_step),
    }
    for what, (our_work, their_work) in pairs.items():
        ours_ms = _each(our_work, repeats)
        times = {}
        for packed in (False, True):
            peer.packed = packed
            times[packed] = _each(their_work, repeats)
        best = min(times, key=times.__getitem__)
        finding("peer times", size=size, what=what, ours=ours_ms, theirs=times[best], packed=best)


@torch.no_grad()
def _our_image(step: Step) -> Tensor:
    camera = step.camera
    splats = project(step.trainer.gaussians, camera)
    return ops.rasterize(
        splats, camera.width, camera.height, capacity=step.trainer.runner.capacity
    )[0]


def _each(work: Callable[[], object], repeats: int) -> float:
    """Milliseconds per call, for many calls in a row, as in a training run."""
    for _ in range(3):
        work()
    times = []
    for _ in range(3):
        torch.cuda.synchronize()
        before = event()
        for _ in range(repeats):
            work()
        after = event()
        torch.cuda.synchronize()
        times.append(milliseconds(before, after) / repeats)
    return statistics.median(times)
