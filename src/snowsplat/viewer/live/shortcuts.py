"""The keys and the theme of the page. F and R do the same on the page of a finished scene.

viser also lists the keys in its command palette (Ctrl-K).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from torch import Tensor

from snowsplat.viewer.live.controls import Controls, in_server_thread

#: The accent colour of the reports, RGB.
ACCENT = (184, 101, 10)
#: A framed scene fills the window, except for this factor.
_MARGIN = 1.1


class Shortcuts:
    """The keys of one browser."""

    def __init__(self, client: viser.ClientHandle, controls: Controls, bounds: Tensor) -> None:
        """``bounds``: (2, 3) corners of the scene."""
        self._client, self._bounds = client, bounds.double().numpy()
        camera = client.camera
        self._first = camera.position.copy(), camera.look_at.copy(), camera.up_direction.copy()
        self._dark = True
        self._add("F", "Frame the scene", self._frame)
        self._add("R", "Back to the first view", lambda: self._move(*self._first))
        self._add("N", "Next photo", lambda: controls.step_photo(1))
        self._add("P", "Previous photo", lambda: controls.step_photo(-1))
        self._add("L", "Light or dark theme", self._switch_theme)

    def _add(self, key: Any, label: str, run: Callable[[], None]) -> None:
        self._client.gui.add_command(label, hotkey=key).on_trigger(in_server_thread(run))

    def _frame(self) -> None:
        """Show the whole scene, from the present direction."""
        camera = self._client.camera
        middle, radius = self._bounds.mean(0), np.linalg.norm(np.diff(self._bounds, axis=0)) / 2
        away = camera.position - camera.look_at
        direction = away / max(float(np.linalg.norm(away)), 1e-9)
        aspect = camera.image_width / max(camera.image_height, 1)
        half = math.tan(camera.fov / 2) * min(1.0, aspect)
        distance = _MARGIN * radius / math.sin(math.atan(half))
        self._move(middle + distance * direction, middle, camera.up_direction)

    def _move(self, position: np.ndarray, look_at: np.ndarray, up: np.ndarray) -> None:
        with self._client.atomic():
            self._client.camera.position = position
            self._client.camera.up_direction = up
            self._client.camera.look_at = look_at

    def _switch_theme(self) -> None:
        self._dark = not self._dark
        set_theme(self._client.gui, self._dark)


def set_theme(gui: viser.GuiApi, dark: bool) -> None:
    """The look of the page, for all browsers or for one."""
    gui.configure_theme(
        dark_mode=dark, show_logo=False, show_share_button=False, brand_color=ACCENT
    )
