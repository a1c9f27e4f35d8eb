"""Key cameras: the views that somebody keeps in the browser, for a film along them."""

from __future__ import annotations

import json
import math
import time

import viser

from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import entries_of
from snowsplat.viewer.live.page import at_once, note
from snowsplat.viewer.live.session import Visitor

FILE = "cameras.json"
# Views that a browser may keep, and seconds between two downloads of them.
_MOST, _PAUSE = 500, 2.0
_NONE = "Go somewhere, keep the view, go on: two or more make a film."


class KeyCameras:
    """The views kept by one browser, and the buttons for it."""

    def __init__(self, client: viser.ClientHandle, visitor: Visitor) -> None:
        self.cameras: list[Camera] = []
        self._client, self._visitor = client, visitor
        self._sent = -math.inf
        gui = client.gui
        with gui.add_folder("Film", order=4, expand_by_default=False):
            self._status = gui.add_html(note(_NONE))
            keep = gui.add_button("Keep this view")
            self._forget = gui.add_button("Forget the last", disabled=True)
            self._save = gui.add_button("Download them", disabled=True)
        keep.on_click(at_once(self.keep))
        self._forget.on_click(at_once(self.forget))
        self._save.on_click(at_once(self._download))

    def _download(self) -> None:
        now = time.monotonic()
        if now - self._sent > _PAUSE:  # what a browser does not fetch is kept for it
            self._sent = now
            self._client.send_file_download(FILE, self.content())

    def keep(self) -> None:
        """Add where the browser looks from."""
        pose = self._visitor.pose
        if pose is not None and len(self.cameras) < _MOST:
            self.cameras.append(pose.camera(pose.width, pose.height))
            self._show()

    def forget(self) -> None:
        """Take the last one back."""
        del self.cameras[-1:]
        self._show()

    def content(self) -> bytes:
        """The file, as `snowsplat render --path` takes it."""
        named = [(f"key_{i:03d}", camera) for i, camera in enumerate(self.cameras)]
        return json.dumps(entries_of(named), indent=1).encode()

    def _show(self) -> None:
        count = len(self.cameras)
        self._forget.disabled, self._save.disabled = count == 0, count < 2
        told = f"{count} kept. With the file: snowsplat render OUT --path {FILE}"
        self._status.content = note(told if count else _NONE)
