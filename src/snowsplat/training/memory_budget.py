"""How much memory a training takes, known before it starts, and how to make it take less.

What counts is what comes on top of a fresh import of PyTorch; on a GPU, on top of what the driver
takes for itself.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import torch

from snowsplat.data.dataset import Dataset
from snowsplat.data.image_loader import DECODERS
from snowsplat.scene.gaussians import SH_REST_COUNTS
from snowsplat.training.config import TrainConfig, changed
from snowsplat.util.errors import UserError


@dataclass(frozen=True)
class Cost:
    """What a training takes on one kind of device.

    Attributes:
        fixed: bytes, whatever is trained.
        pixel: bytes a pixel of the largest photo: renders and their gradients.
        gaussian: bytes a Gaussian, beside its parameters and their two moments: its splat, the
            gradient of that, the tiles that it touches, statistics.
    """

    fixed: int
    pixel: int
    gaussian: int

    def of(self, gaussians: int, pixels: int, sh_degree: int) -> int:
        """Bytes, without the photos that are kept."""
        numbers = 11 + 3 + 3 * SH_REST_COUNTS[sh_degree]
        return self.fixed + self.pixel * pixels + self.each(numbers) * gaussians

    def each(self, numbers: int) -> int:
        """Bytes of a Gaussian of so many numbers, with two moments for each."""
        return 3 * 4 * numbers + self.gaussian


# Measured on the CPU: 1.0 to 1.1 kB a Gaussian beside parameters and moments, where each touches
# some seven tiles. On a GPU reckoned from what is allocated.
CPU = Cost(fixed=66_000_000, pixel=170, gaussian=1150)
GPU = Cost(fixed=50_000_000, pixel=70, gaussian=240)
# Random ones begin so wide that each of them touches about three times as many tiles.
_WIDE = 2
# A photo that is being decoded, bytes a pixel of its file; on the CPU, and so many at a time.
_DECODING = 18

# Photos at hand at least: the one in use, and those that are decoded ahead.
_FEWEST_PHOTOS = 6
# A scene of fewer Gaussians than this is not worth its training.
_FEWEST_GAUSSIANS = 1000


@dataclass(frozen=True)
class MemoryPlan:
    """What `plan_memory` found.

    Attributes:
        config: with what holds the training to its memory.
        scene, images, photos: bytes for Gaussians, for renders and their gradients, for photos
            that stay decoded.
        given_up: what there would have been with more memory, in words.
        limit: the Gaussians reckoned with; None: there is no limit, and ``scene`` is of a million.
    """

    config: TrainConfig
    scene: int
    images: int
    photos: int
    given_up: tuple[str, ...]
    limit: int | None

    @property
    def total(self) -> int:
        return self.scene + self.images + self.photos

    def __str__(self) -> str:
        parts = f"images {in_words(self.images)}, photos {in_words(self.photos)}"
        if self.limit is None:
            return f"{in_words(self.scene)} for each million Gaussians, {parts}"
        scene = f"{self.limit:,} Gaussians {in_words(self.scene)}"
        return f"{in_words(self.total)} at most ({scene}, {parts})"


def plan_memory(
    dataset: Dataset,
    config: TrainConfig,
    device: torch.device,
    available: int,
    budget: int | None = None,
    present: int = 0,
) -> MemoryPlan:
    """What a training of ``capture`` takes; with a ``budget``, made to take no more.

    First fewer photos stay decoded, then there are fewer Gaussians.

    Args:
        available: bytes that the device has left, which photos may have half of.
        budget: bytes; None: as much as it takes.
        present: Gaussians of a training that goes on: none of them is taken away.

    Raises:
        UserError: too little for photos of this size, or for what is present.
    """
    cost = GPU if device.type == "cuda" else CPU
    sizes = [view.camera.width * view.camera.height for view in dataset.train]
    largest = max(sizes)
    fewest = 3 * sum(sorted(sizes)[-_FEWEST_PHOTOS:])
    masked = (size for view, size in zip(dataset.train, sizes, strict=True) if view.mask)
    all_photos = 3 * sum(sizes) + sum(masked)
    images = cost.of(0, largest, config.sh_degree)
    stored = max(largest, *(view.image.stored for view in dataset.train))
    if cost is CPU:
        images += DECODERS * _DECODING * stored
    each = cost.of(1, 0, config.sh_degree) - cost.fixed
    random = config.initial_points if dataset.points is None and not present else 0
    wide = _WIDE * cost.gaussian

    def scene(count: int) -> int:
        return each * count + wide * min(count, random)

    config = config.capped(sorted(sizes)[len(sizes) // 2])
    cap = config.density.max_gaussians or None
    photos = min(all_photos, config.image_memory or available // 2)
    given_up = []
    if budget is not None:
        least = images + fewest + scene(max(_FEWEST_GAUSSIANS, present))
        if budget < least and present > _FEWEST_GAUSSIANS:
            raise UserError(
                f"--memory {in_words(budget)} is too little to go on with {present:,} Gaussians, "
                f"which take {in_words(least)} with photos of this size; give more"
            )
        if budget < least:
            # -r leaves the files as they are, and each is decoded whole.
            smaller = "the files smaller" if stored > largest else "them smaller with -r"
            raise UserError(
                f"--memory {in_words(budget)} is too little for photos of this size, which take "
                f"{in_words(least)}; give more, or make {smaller}"
            )
        left = budget - images - min(photos, fewest)
        room = max(min(random, left // (each + wide)), (left - wide * random) // each)
        if cap is None or cap > room:
            more = "no limit of them" if cap is None else f"{cap:,}"
            given_up.append(f"at most {room:,} Gaussians instead of {more}")
            cap = room
            config = changed(config, max_gaussians=room)
        left = max(fewest, budget - images - scene(cap))
        if photos > left:
            share = 100 * left // all_photos
            given_up.append(f"{share}% of the photos stay decoded, the others are read again")
            photos = left
        config = replace(config, image_memory=photos)
    count = 1_000_000 if cap is None else cap
    return MemoryPlan(config, scene(count), images, photos, tuple(given_up), cap)


_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


def parse_bytes(text: str) -> int:
    """Bytes of "4GB", "800 MB", "1.5g" or a plain number; "GiB" and its like are powers of 1024.

    Raises:
        UserError: anything else.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]?)(i?)b?\s*", text.lower())
    if match is None or (match[3] and not match[2]) or float(match[1]) <= 0:
        raise UserError(f"--memory is {text!r}; it must be like 4GB or 800MB")
    unit = _UNITS[match[2]]
    if match[3]:
        unit = 1024 ** (list(_UNITS).index(match[2]))
    return int(float(match[1]) * unit)


def in_words(count: int) -> str:
    """Such as "1.3 GB" or "240 MB"."""
    return f"{count / 1e9:.1f} GB" if count >= 0.95e9 else f"{max(1, round(count / 1e6))} MB"
