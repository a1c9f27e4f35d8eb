"""Estimates the memory of a training run before it starts, and reduces it to a budget.

The memory that a process needs after importing PyTorch is not included; on a GPU, neither is the
memory that the driver allocates for itself.
"""

from dataclasses import dataclass, replace

import torch

from snowsplat.data.dataset import Dataset
from snowsplat.data.photos.image_loader import DECODERS, available_memory
from snowsplat.scene.gaussians import SH_REST_COUNTS
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.names import changed
from snowsplat.util.byte_size import format_bytes, parse_bytes
from snowsplat.util.errors import SettingError
from snowsplat.util.machine import peak_bytes
from snowsplat.util.messages import Message, message

#: Bytes per pixel of a decoded photo, and of its mask.
_RGB = 3
_MASK = 1
#: Minimum number of photos that are decoded at a time: that of the step, and those of the next
#: steps.
_FEWEST_PHOTOS = 6
#: A budget must suffice for at least this many Gaussians.
_FEWEST_GAUSSIANS = 1000
#: A random Gaussian is initially so large that it touches about three times as many tiles: the
#: memory per Gaussian for splats and instances is needed this many times in addition.
_EXTRA_OF_RANDOM = 2


@dataclass(frozen=True)
class Cost:
    """Memory that a training run takes on one kind of device.

    Attributes:
        fixed: bytes that do not depend on the scene.
        pixel: bytes per pixel of the largest photo: renderings and their gradients.
        gaussian: bytes per Gaussian besides its parameters and their two moments: its splat, the
            gradient of the splat, its instances, statistics.
        decoding: bytes per pixel of the largest image file while photos are being decoded.
    """

    fixed: int
    pixel: int
    gaussian: int
    decoding: int

    def bytes_for(self, gaussians: int, pixels: int, sh_degree: int) -> int:
        """Bytes, without the photos that stay decoded."""
        return self.fixed + self.pixel * pixels + self.of_gaussian(sh_degree) * gaussians

    def of_gaussian(self, sh_degree: int) -> int:
        """Bytes per Gaussian, with its float32 parameters and two moments of each parameter."""
        parameters = 11 + 3 + 3 * SH_REST_COUNTS[sh_degree]
        return 3 * 4 * parameters + self.gaussian


#: Measured with Gaussians that touch about seven tiles each: 1.0 to 1.1 kB per Gaussian besides
#: parameters and moments. `DECODERS` threads decode photos at a time, at 18 bytes per pixel.
CPU = Cost(fixed=66_000_000, pixel=170, gaussian=1150, decoding=18 * DECODERS)
#: Computed from the sizes of the tensors that are allocated; measured on a GPU, 0.85 to 0.9 times
#: as much, before `rasterizer` kept states of pixels: about 64 bytes more per Gaussian, which is
#: still within it. Photos are decoded in the memory of the CPU.
GPU = Cost(fixed=50_000_000, pixel=70, gaussian=240, decoding=0)


@dataclass(frozen=True)
class MemoryPlan:
    """The result of `plan_memory`.

    Attributes:
        config: the configuration, with settings that keep the memory within the budget.
        scene: bytes for Gaussians.
        images: bytes for renderings and their gradients.
        photos: bytes for photos that stay decoded.
        reductions: descriptions of the reductions that a larger budget would not need.
        limit: maximum number of Gaussians. None: no limit; ``scene`` is then the number of bytes of
            a million Gaussians.
        device: whose memory is planned.
    """

    config: TrainConfig
    scene: int
    images: int
    photos: int
    reductions: tuple[str, ...]
    limit: int | None
    device: torch.device

    @property
    def total(self) -> int:
        """Bytes."""
        return self.scene + self.images + self.photos

    def summary(self) -> Message:
        """The plan in a few words."""
        values = {
            "scene": format_bytes(self.scene),
            "images": format_bytes(self.images),
            "photos": format_bytes(self.photos),
        }
        if self.limit is None:
            plan = message(
                "{scene} for each million Gaussians, images {images}, photos {photos}", **values
            )
        else:
            plan = message(
                "{total} at most ({limit:,} Gaussians {scene}, images {images}, photos {photos})",
                total=format_bytes(self.total),
                limit=self.limit,
                **values,
            )
        if self.device.type == "cuda":
            return message("memory of the GPU: {plan}", plan=plan)
        return message("memory: {plan}", plan=plan)

    def peak(self, before: int) -> Message:
        """The peak memory so far, in a few words.

        ``before``: resident bytes of the process before the training: Python and its libraries.
        """
        if self.device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(self.device)
            return message("at most {peak:.0f} MB of the GPU", peak=peak / 1e6)
        return message(
            "at most {peak:.0f} MB, {before:.0f} of them Python and its libraries",
            peak=peak_bytes() / 1e6,
            before=before / 1e6,
        )


@dataclass(frozen=True)
class _SceneCost:
    """Bytes of the Gaussians of one training run.

    Attributes:
        each: bytes per Gaussian.
        random: number of initial Gaussians that are random.
        extra: additional bytes of each of these.
    """

    each: int
    random: int
    extra: int

    def bytes_for(self, gaussians: int) -> int:
        return self.each * gaussians + self.extra * min(gaussians, self.random)

    def gaussians_in(self, available: int) -> int:
        """The largest number of Gaussians for which `bytes_for` is at most ``available``."""
        if_all_random = available // (self.each + self.extra)
        if_more = (available - self.extra * self.random) // self.each
        return max(min(self.random, if_all_random), if_more)


def plan_memory(
    dataset: Dataset,
    config: TrainConfig,
    device: torch.device,
    available: int | None = None,
    budget: int | str | None = None,
    present: int = 0,
) -> MemoryPlan:
    """Estimate the memory of training on ``dataset``; with a ``budget``, reduce it to this budget.

    First, fewer photos stay decoded; then the number of Gaussians is limited.

    Args:
        available: free bytes of the device; photos may use half of them. None: as many as there
            are.
        budget: bytes, or a text such as "4GB"; None: no limit.
        present: number of Gaussians of a resumed training run; they are not removed.

    Raises: SettingError: ``memory`` is no number of bytes, or too little for photos of this size,
    or for the Gaussians that are present.
    """
    budget = parse_bytes(budget) if isinstance(budget, str) else budget
    available = available_memory(device) if available is None else available
    sizes = sorted(view.camera.width * view.camera.height for view in dataset.train)
    largest, median = sizes[-1], sizes[len(sizes) // 2]
    config = config.capped(median, len(dataset.train))
    cost = GPU if device.type == "cuda" else CPU
    # Random points are also used if the other starts find nothing.
    random = not present and (dataset.points is None or "random" in config.starts)
    scene = _SceneCost(
        each=cost.of_gaussian(config.sh_degree),
        random=config.points_per_start if random else 0,
        extra=_EXTRA_OF_RANDOM * cost.gaussian,
    )
    stored = max(largest, *(view.image.stored for view in dataset.train))
    images = cost.bytes_for(0, largest, config.sh_degree) + cost.decoding * stored
    all_photos = sum(
        (_RGB + (_MASK if view.mask else 0)) * view.camera.width * view.camera.height
        for view in dataset.train
    )
    photos = min(all_photos, config.image_memory or available // 2)
    limit = config.density.max_gaussians or None
    reductions = []
    if budget is not None:
        fewest_photos = _RGB * sum(sizes[-_FEWEST_PHOTOS:])
        least = images + fewest_photos + scene.bytes_for(max(_FEWEST_GAUSSIANS, present))
        if budget < least:
            raise _too_little(budget, least, present, files_too_large=stored > largest)
        fitting = scene.gaussians_in(budget - images - min(photos, fewest_photos))
        if limit is None or limit > fitting:
            before = "no limit" if limit is None else f"{limit:,}"
            reductions.append(f"at most {fitting:,} Gaussians instead of {before}")
            limit = fitting
            config = changed(config, max_gaussians=limit)
        left = max(fewest_photos, budget - images - scene.bytes_for(limit))
        if photos > left:
            share = 100 * left // all_photos
            reductions.append(
                f"{share}% of the photos stay decoded, the others are decoded each time"
            )
            photos = left
        config = replace(config, image_memory=photos)
    gaussians = 1_000_000 if limit is None else limit
    whole = scene.bytes_for(gaussians)
    return MemoryPlan(config, whole, images, photos, tuple(reductions), limit, device)


def _too_little(budget: int, least: int, present: int, files_too_large: bool) -> SettingError:
    needed = f"need {format_bytes(least)}"
    if present > _FEWEST_GAUSSIANS:
        problem = f"to resume with {present:,} Gaussians, which {needed}; use more"
    else:
        # If the image files are too large, a lower resolution does not help: a file is decoded at
        # its full size.
        smaller = "smaller image files" if files_too_large else "a lower resolution"
        problem = f"for photos of this size, which {needed}; use more, or {smaller}"
    return SettingError(
        "memory", "{budget} is too little {problem}", budget=format_bytes(budget), problem=problem
    )
