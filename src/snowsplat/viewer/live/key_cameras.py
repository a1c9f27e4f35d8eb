"""Key cameras: views that a user stores on the page, to render a video along them."""

from __future__ import annotations

import json
import math
import time

import viser

from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import entries_of
from snowsplat.scene.geometry import Similarity
from snowsplat.viewer.live.controls import in_server_thread, note
from snowsplat.viewer.live.session import Visitor

FILE = "cameras.json"
_MAX_VIEWS = 500  # maximum number of views that a browser may store
_PAUSE = 2.0  # minimum time in seconds between two downloads
_NONE = "Store two or more views to make a video."


class KeyCameras:
    """The views that a user has stored in one browser, and the buttons for them."""

    def __init__(
        self, client: viser.ClientHandle, visitor: Visitor, world_from_page: Similarity
    ) -> None:
        self.cameras: list[Camera] = []  # the views, in the world
        self._client, self._visitor, self._world_from_page = client, visitor, world_from_page
        self._sent = -math.inf
        gui = client.gui
        with gui.add_folder("Video", order=4, expand_by_default=False):
            self._status = gui.add_html(note(_NONE))
            store = gui.add_button("Store this view")
            self._remove = gui.add_button("Remove the last view", disabled=True)
            self._save = gui.add_button("Download the views", disabled=True)
        store.on_click(in_server_thread(self.store))
        self._remove.on_click(in_server_thread(self.remove_last))
        self._save.on_click(in_server_thread(self._download))

    def _download(self) -> None:
        now = time.monotonic()
        if now - self._sent > _PAUSE:  # viser keeps a file in memory until the browser fetches it
            self._sent = now
            self._client.send_file_download(FILE, self.content())

    def store(self) -> None:
        """Store the current view of the browser."""
        pose = self._visitor.pose
        if pose is not None and len(self.cameras) < _MAX_VIEWS:
            camera = pose.camera(pose.width, pose.height)
            self.cameras.append(camera.transformed(self._world_from_page))
            self._show()

    def remove_last(self) -> None:
        """Remove the last view."""
        del self.cameras[-1:]
        self._show()

    def content(self) -> bytes:
        """The content of the file, which `snowsplat render --path` reads."""
        named = [(f"key_{i:03d}", camera) for i, camera in enumerate(self.cameras)]
        return json.dumps(entries_of(named), indent=1).encode()

    def _show(self) -> None:
        count = len(self.cameras)
        self._remove.disabled, self._save.disabled = count == 0, count < 2
        usage = f"{count} stored. Use the file with: snowsplat render OUT --path {FILE}"
        self._status.content = note(usage if count else _NONE)
