"""The curves of a training run in the viewer: loss of all steps, PSNR of a few views."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.data import View
from snowsplat.data.photos.decode import load_image, load_mask, resize_area
from snowsplat.evaluation.metrics import psnr
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.util.errors import UserError
from snowsplat.util.process import single_threaded
from snowsplat.viewer.live.display import fit

_POINTS = 512  # maximum number of points per curve; if there are more, adjacent ones are merged
_VIEWS = 4  # number of views whose PSNR is averaged
_MAX_SIDE = 480  # pixels: longer side of these views


class Curve:
    """The curve of a value. Each point is the mean of equally many added values.

    The number of points is limited: adjacent points are merged if there are too many.
    """

    def __init__(self) -> None:
        self._points: list[tuple[float, float]] = []
        self._every = 1  # values per point
        self._steps = self._sum = 0.0
        self._count = 0

    def add(self, step: int, value: float) -> None:
        """Add the value of a step."""
        self._steps += step
        self._sum += value
        self._count += 1
        if self._count < self._every:
            return
        self._points.append((self._steps / self._count, self._sum / self._count))
        self._steps = self._sum = 0.0
        self._count = 0
        if len(self._points) > _POINTS:
            pairs = zip(self._points[::2], self._points[1::2], strict=False)
            self._points = [((a + c) / 2, (b + d) / 2) for (a, b), (c, d) in pairs]
            self._every *= 2

    def __len__(self) -> int:
        return len(self._points)

    def lists(self) -> tuple[list[float], list[float]]:
        """The steps and the values of the points."""
        return [step for step, _ in self._points], [value for _, value in self._points]


class SampledPsnr:
    """PSNR of a few fixed views, measured one at a time, because this delays the training."""

    def __init__(self, views: Sequence[View], background: Tensor) -> None:
        """``views``: `_VIEWS` of them are used, evenly spaced; ``background``: (3,) in 0..1."""
        self._background = background
        chosen = [views[i * len(views) // _VIEWS] for i in range(_VIEWS)] if views else []
        unique = list(dict.fromkeys(chosen))
        self._turn = itertools.cycle(unique)
        self._photos: dict[View, tuple[Tensor, Tensor | None]] = {}
        self._newest: deque[float] = deque(maxlen=len(unique))
        self.can_measure = bool(unique)

    def measure(self, gaussians: Gaussians) -> float:
        """Measure the next view (the first time: all views); return the mean of the PSNRs in dB.

        NaN if a photo cannot be read.
        """
        for _ in range(1 if self._newest else self._newest.maxlen or 0):
            self._measure_next(gaussians)
        return sum(self._newest) / len(self._newest) if self.can_measure else math.nan

    @torch.no_grad()
    def _measure_next(self, gaussians: Gaussians) -> None:
        view = next(self._turn)
        size = fit(view.camera.width, view.camera.height, _MAX_SIDE)
        with single_threaded():
            try:
                photo, mask = self._photo(view, size)
            except UserError:
                self.can_measure = False  # the training itself reports the error
                return
            image = render(gaussians, view.camera.scaled(*size), self._background).image
            self._newest.append(psnr(image.clamp(0.0, 1.0).cpu(), photo, mask))

    def _photo(self, view: View, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
        if view not in self._photos:
            planes = load_image(view.image, self._background.tolist())
            small = torch.from_numpy(resize_area(planes.numpy(), *size))
            mask = None
            if view.mask is not None:
                whole = load_mask(view.mask).numpy().astype(np.uint8)[None] * 255
                mask = torch.from_numpy(resize_area(whole, *size)[0] == 255)
            self._photos[view] = (small.permute(1, 2, 0).to(torch.float32) / 255.0, mask)
        return self._photos[view]
