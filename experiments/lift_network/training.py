"""Trains the network on depth and on the image of the second view."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from network import DepthNet, focal_scale, without_offsets
from torch import Tensor

from scenes import Shots
from snowsplat.scene.render import render

BATCH = 8
_RENDERED = 2  # photos of a batch whose second view is rendered
_RENDER_WEIGHT = 0.5
_RATE = 2e-3
_VISIBLE = 0.5  # alpha, above which a pixel of the second view is visible in the first one


@dataclass
class Curves:
    """The losses of each step."""

    depth: list[float] = field(default_factory=list)
    image: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Example:
    """A photo of `Shots`, by its number."""

    shots: Shots
    i: int

    @property
    def second(self) -> int:
        return self.i ^ 1

    @property
    def log_depth(self) -> Tensor:
        """(H, W): the target of the network."""
        return (self.shots.depths[self.i] / focal_scale(self.shots.focal)).log()

    def visible(self) -> Tensor:
        """(H, W) bool: the pixels of the second view that the first one shows, by true depth."""
        exact = without_offsets(self.shots.depths[self.i].log()[None])
        gaussians = exact.gaussians(0, self.shots.image(self.i), self.shots.camera(self.i))
        with torch.no_grad():
            return render(gaussians, self.shots.camera(self.second)).alpha > _VISIBLE


def examples(sets: Sequence[Shots]) -> list[Example]:
    """All photos of all sets."""
    return [Example(shots, i) for shots in sets for i in range(len(shots))]


def train(data: Sequence[Example], steps: int, seed: int, augment: bool) -> tuple[DepthNet, Curves]:
    """Train a new network.

    The loss is the mean absolute error of the logarithm of the depth, and 0.5 times the mean
    absolute error of the second view, where the photo shows it.

    Args:
        augment: mirror half of the photos, and permute their colour channels.
    """
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    mean = torch.stack([example.log_depth.mean() for example in data]).mean()
    net = DepthNet(float(mean))
    optimizer = torch.optim.AdamW(net.parameters(), lr=_RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, total_steps=steps)
    visible = [example.visible() for example in data]
    curves, started = Curves(), time.process_time()
    for step in range(steps):
        chosen = torch.randperm(len(data), generator=random)[:BATCH].tolist()
        batch = [data[i] for i in chosen]
        images = torch.stack([example.shots.image(example.i) for example in batch])
        mirrored = augment and bool(torch.rand((), generator=random) < 0.5)
        if augment:
            seen = images[..., torch.randperm(3, generator=random)]
            prediction = net(seen.flip(2) if mirrored else seen)
        else:
            prediction = net(images)
        if mirrored:
            parts = (prediction.log_depth, prediction.log_size, prediction.opacity)
            prediction = type(prediction)(*(part.flip(2) for part in parts))
        target = torch.stack([example.log_depth for example in batch])
        depth_loss = (prediction.log_depth - target).abs().mean()
        image_loss = torch.zeros(())
        for k in range(min(_RENDERED, len(batch))):
            shots, i, j = batch[k].shots, batch[k].i, batch[k].second
            scale = focal_scale(shots.focal)
            gaussians = prediction.gaussians(k, images[k], shots.camera(i), scale)
            image = render(gaussians, shots.camera(j)).image
            error = (image - shots.image(j)).abs()[visible[chosen[k]]]
            image_loss = image_loss + error.mean() / _RENDERED
        optimizer.zero_grad()
        (depth_loss + _RENDER_WEIGHT * image_loss).backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        curves.depth.append(depth_loss.item())
        curves.image.append(image_loss.item())
        if (step + 1) % 100 == 0:
            recent = [sum(c[-100:]) / 100 for c in (curves.depth, curves.image)]
            print(
                f"step {step + 1} of {steps}: log depth {recent[0]:.4f}, second view "
                f"{recent[1]:.4f}, {time.process_time() - started:.0f} s of processor time",
                flush=True,
            )
    return net.eval(), curves
