"""`GlassScene`: a scene with panes, which show what is behind them, and reflect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from snowsplat.synthetic.light import Lamp
from snowsplat.synthetic.scene import Scene, SceneObject


class GlassScene(Scene):
    """A scene with panes of glass, which cast no shadow."""

    def __init__(
        self, objects: Sequence[SceneObject], panes: Sequence[SceneObject], lamp: Lamp
    ) -> None:
        self._panes = range(len(objects), len(objects) + len(panes))
        super().__init__([*objects, *(replace(pane, emissive=True) for pane in panes)], lamp)

    def candidates(self, origins: np.ndarray, directions: np.ndarray) -> list[int]:
        every = super().candidates(origins, directions)
        return [i for i in every if i not in self._panes]

    def block(
        self, origins: np.ndarray, directions: np.ndarray, spread: float, mirrored: bool
    ) -> np.ndarray:
        colours = super().block(origins, directions, spread, mirrored)
        if not mirrored:
            return colours
        solid, _ = self.nearest(origins, directions, self.candidates(origins, directions))
        panes = [i for i in super().candidates(origins, directions) if i in self._panes]
        distance, pane = self.nearest(origins, directions, panes)
        before = np.flatnonzero(distance < solid)
        positions = (origins + np.where(pane >= 0, distance, 0) * directions)[:, before]
        normals = np.zeros_like(directions)
        for i in panes:
            own = np.flatnonzero(pane[before] == i)
            normals[:, before[own]] = self.shapes[i].surface(positions[:, own])[2]
        self.mirror(colours, before, pane[before], positions, normals, directions, spread)
        return colours
