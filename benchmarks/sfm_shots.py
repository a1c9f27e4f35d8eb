"""Photos of a scene that are taken in different ways: brackets, several cameras, a zoom."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from snowsplat.synthetic.photographer import CentredLens, phone_lens, photograph
from snowsplat.synthetic.scene import Scene

GAINS = (1.0, 0.25, 4.0)  # of brackets
Shoot = Callable[[Scene, int, np.random.Generator], np.ndarray]


class _Exposed(Scene):
    """A scene that is brighter by a factor."""

    def __init__(self, scene: Scene, gain: float) -> None:
        self._scene, self._gain = scene, gain

    def radiance(self, *rays: Any) -> np.ndarray:
        return self._gain * self._scene.radiance(*rays)


def brackets(lens: CentredLens, poses: Sequence[Tensor]) -> Shoot:
    """The exposures are those of `GAINS`, in turn."""
    return lambda scene, i, noise: photograph(_Exposed(scene, GAINS[i % 3]), lens, poses[i], noise)


def devices(lens: CentredLens, poses: Sequence[Tensor]) -> Shoot:
    """Three cameras in turn: ``lens``, a square one and a wider one."""
    square = phone_lens(lens.height, lens.height, (0.02, -0.03, 0.0, 0.0002))
    wide = phone_lens(4 * lens.width // 3, lens.height, (-0.15, 0.03, 0.0, 0.0))
    three = (lens, square, wide)
    return lambda scene, i, random: photograph(scene, three[i % 3], poses[i], random)


def zoom(lens: CentredLens, poses: Sequence[Tensor]) -> Shoot:
    """The focal length doubles in the middle third."""
    factors = 1 + np.linspace(-1, 2, len(poses)).clip(0, 1)
    lenses = [replace(lens, focal=lens.focal * factor) for factor in factors.tolist()]
    return lambda scene, i, random: photograph(scene, lenses[i], poses[i], random)
