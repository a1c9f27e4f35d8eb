"""The controls of the page: training controls for all browsers, and controls of each browser."""

from __future__ import annotations

import asyncio
import dataclasses
import html
from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np
import viser
from torch import Tensor

from snowsplat.util.errors import UserError
from snowsplat.viewer.live.curves import Curve
from snowsplat.viewer.live.display import Mode
from snowsplat.viewer.live.guard import call_in_server_thread
from snowsplat.viewer.live.photos import FRUSTUMS, Photos
from snowsplat.viewer.live.session import Session, Visitor

_MODES: dict[str, Mode] = {
    "Colour": "color",
    "Depth": "depth",
    "Opacity": "alpha",
    "Normals": "normals",
    "Points": "points",
    "Ellipsoids": "ellipsoids",
    "Gaussians per pixel": "cost",
    "Error against the photo": "error",
}
_LEGENDS: dict[Mode, str] = {
    "color": "Drag to rotate, right button to move, wheel to zoom. Keys: F frames the scene, R "
    "returns, N and P go to photos, L changes the theme.",
    "depth": "Yellow is near, violet is far.",
    "alpha": "White is opaque, black is empty.",
    "normals": "Red: right, green: up, blue: towards you; the shortest axis of each Gaussian.",
    "points": "The centre of each Gaussian.",
    "ellipsoids": "Each Gaussian as a solid body of 1.5 standard deviations.",
    "cost": "Gaussians blended per pixel. Black: none, red: about 30, pale yellow: 256 or more.",
    "error": "Black: none, pale yellow: a quarter of the range or more.",
}
_NOWHERE = "Show the cameras and click one to view the scene from its position."
_NEEDS_PHOTO = "Only available at the position of a photo: click a camera, or Next below."


def note(text: str) -> str:
    """A block of small text; ``text`` is HTML."""
    style = "font-size:0.85em;padding:0 1em 0.5em 1em;line-height:1.5"
    return f'<div style="{style}">{text}</div>'


def lines_of(texts: list[str]) -> str:
    """`note` of lines of plain text."""
    return note("<br>".join(map(html.escape, texts)))


def in_server_thread(run: Callable[[], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """A callback of a control, which calls ``run`` in the server's thread.

    viser would call ``run`` itself in a thread pool. In the server's thread, events are processed
    in order, and the next message is read only after the previous one is processed.
    """

    async def called(_: Any) -> None:
        run()

    return called


def within(value: Any, low: float, high: float) -> float:
    """The value of a slider, limited to its range, because browsers can send any number."""
    return min(max(float(value), low), high)


class TrainingPanel:
    """The part of the page with state and controls of the training, the same for all browsers."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        call_in_server_thread(server, self._add)

    def _add(self) -> None:
        server, session = self._server, self._session
        with server.gui.add_folder("Training", order=0):
            self._status = server.gui.add_html(note("waiting for the first step"))
            self._bar = server.gui.add_progress_bar(0.0)
            self._pause = server.gui.add_button("Pause")
            self._step = server.gui.add_button("One step")
            hint = "While a camera moves: share of the time for rendering its images"
            share = round(100 * session.share)
            self._share = server.gui.add_slider("Viewing time (%)", 5, 95, 5, share, hint=hint)
            self._loss = _plot(server, "Loss", "#4a7fe0")
            self._psnr = _plot(server, "PSNR (dB)", "#e08a2a")
        self._pause.on_click(in_server_thread(self._pause_clicked))
        self._key = server.gui.add_command("Pause or resume the training", hotkey="space")
        self._key.on_trigger(in_server_thread(self._pause_clicked))
        self._step.on_click(in_server_thread(self._step_clicked))
        self._share.on_update(in_server_thread(self._share_changed))

    def _pause_clicked(self) -> None:
        if self._session.paused:
            self._session.resume()
        else:
            self._session.pause()
        self._update_pause_label()

    def _step_clicked(self) -> None:
        self._session.step()
        self._update_pause_label()

    def _share_changed(self) -> None:
        self._session.share = within(self._share.value, 5, 95) / 100.0

    def _update_pause_label(self) -> None:
        self._pause.label = "Resume" if self._session.paused else "Pause"

    def show(self, status: list[str], share: float, loss: Curve, psnr: Curve) -> None:
        """Show lines of text, the finished share of the steps, 0..1, and the curves."""
        curves = loss.arrays(), psnr.arrays()

        def put() -> None:
            self._status.content = lines_of(status)
            self._bar.value = 100.0 * share  # type: ignore[misc]  # viser's setter has another type
            for plot, curve in zip((self._loss, self._psnr), curves, strict=True):
                if len(curve[0]) > 1:
                    plot.data = curve
                    plot.visible = True

        call_in_server_thread(self._server, put)

    def end(self, status: list[str]) -> None:
        """Show lines of text, and hide the controls: the training has finished."""

        def hide() -> None:
            self._status.content = lines_of(status)
            self._bar.value = 100.0  # type: ignore[misc]
            for control in (self._share, self._step, self._pause):
                control.visible = False
            self._key.remove()

        call_in_server_thread(self._server, hide)


def _plot(server: viser.ViserServer, name: str, color: str) -> viser.GuiUplotHandle:
    series = (
        {"label": "step"},
        {"label": name, "stroke": color, "width": 1.5, "points": {"show": False}},
    )
    return server.gui.add_uplot(
        (np.zeros(2), np.zeros(2)),
        series,  # type: ignore[arg-type]  # viser accepts plain dictionaries
        title=name,
        scales={"x": {"time": False}},
        legend={"show": False},
        height=110,
        visible=False,
    )


class ScenePanel:
    """The part of the page with the state of the scene, if there is no training."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        call_in_server_thread(server, self._add)

    def _add(self) -> None:
        with self._server.gui.add_folder("Scene", order=0):
            self._status = self._server.gui.add_html(note("no scene yet"))

    def show(self, status: list[str]) -> None:
        """Show lines of text."""

        def put() -> None:
            self._status.content = lines_of(status)

        call_in_server_thread(self._server, put)


class Controls:
    """The controls of one browser: display settings, photos, crop box."""

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        visitor: Visitor,
        photos: Photos,
        bounds: Tensor,
    ) -> None:
        """``bounds``: (2, 3) corners of the scene, for the crop box."""
        self._client, self._session, self._visitor = client, session, visitor
        self._photos = photos
        self._photo_index: int | None = None
        self._next: int | None = None  # index of the requested photo, while it is read
        self._going: asyncio.Task[None] | None = None
        self._hidden: viser.FrameHandle | None = None  # hides all frustums in this browser
        self._add_display()
        self._add_photos()
        self._add_crop(bounds)

    def _set_display(self, **changes: Any) -> None:
        display = dataclasses.replace(self._visitor.display, **changes)
        self._session.change(self._visitor, display=display)

    # Display

    def _add_display(self) -> None:
        gui, display = self._client.gui, self._visitor.display
        with gui.add_folder("Display", order=1):
            self._mode = gui.add_dropdown("Show", list(_MODES))
            self._legend = gui.add_html(note(_LEGENDS["color"]))
            degree = gui.add_slider(
                "SH degree", 0, 3, 1, display.sh_degree, hint="Degree of view-dependent colour"
            )
            hint = "In percent; small values separate the Gaussians"
            scale = gui.add_slider("Gaussian size", 2, 100, 2, 100, hint=hint)
            hint = "Longer side in pixels while the camera does not move"
            finest = gui.add_slider("Image size", 320, 2560, 80, self._visitor.longest, hint=hint)

        def size_chosen() -> None:
            longest = int(within(finest.value, 320, 2560))
            self._session.change(self._visitor, longest=longest)

        self._mode.on_update(in_server_thread(self._mode_chosen))
        degree.on_update(
            in_server_thread(lambda: self._set_display(sh_degree=int(within(degree.value, 0, 3))))
        )
        scale.on_update(
            in_server_thread(lambda: self._set_display(scale=within(scale.value, 2, 100) / 100.0))
        )
        finest.on_update(in_server_thread(size_chosen))

    def _mode_chosen(self) -> None:
        if self._mode.value in _MODES:
            self._set_display(mode=_MODES[self._mode.value])
            self._show_legend()

    def _show_legend(self) -> None:
        mode = self._visitor.display.mode
        missing = mode == "error" and self._photo_index is None
        self._legend.content = note(_NEEDS_PHOTO if missing else _LEGENDS[mode])

    # Photos

    def _add_photos(self) -> None:
        gui = self._client.gui
        with gui.add_folder("Photos", order=2, visible=bool(self._photos.views)):
            self._shown = gui.add_checkbox("Cameras", False)
            self._where = gui.add_html(note(_NOWHERE))
            hint = "How much of the rendering the photo covers, from the left"
            self._wipe = gui.add_slider("Photo (%)", 0, 100, 1, 0, visible=False, hint=hint)
            self._flip = gui.add_button_group("Show only", ("Render", "Photo"), visible=False)
            self._move = gui.add_button_group("Go to", ("Previous", "Next"))
        self._show_frustums()
        self._shown.on_update(in_server_thread(self._show_frustums))
        self._wipe.on_update(
            in_server_thread(
                lambda: self._set_display(wipe=within(self._wipe.value, 0, 100) / 100.0)
            )
        )
        self._flip.on_click(
            in_server_thread(lambda: self._wipe_to(100 if self._flip.value == "Photo" else 0))
        )
        self._move.on_click(
            in_server_thread(lambda: self.step_photo(1 if self._move.value == "Next" else -1))
        )

    def _wipe_to(self, percent: int) -> None:
        self._wipe.value = percent  # type: ignore[misc]
        self._set_display(wipe=percent / 100.0)

    def step_photo(self, by: int) -> None:
        """Go to the next photo, or with −1 to the previous one."""
        if not self._photos.views:
            return
        count = len(self._photos.views)
        now = self._photo_index if self._next is None else self._next
        self.go_to_photo(0 if now is None else (now + by) % count)

    def go_to_photo(self, index: int) -> None:
        """Read a photo, then go to its position. A later call replaces this one."""
        self._next = index
        if self._going is None or self._going.done():
            self._going = asyncio.get_running_loop().create_task(self._go_to_requested())

    async def _go_to_requested(self) -> None:
        while self._next is not None:
            index = self._next
            try:
                photo_view = await self._photos.read(self._visitor, index)
            except UserError as error:
                self._where.content = note(html.escape(str(error)))
                photo_view = None
            if self._next != index:
                continue  # another photo was requested meanwhile
            self._next = None
            if photo_view is not None:
                self._photos.go_to(self._client, self._visitor, photo_view)
                self.follow()

    def follow(self) -> None:
        """Update the controls if the browser has reached the position of a photo or left it."""
        photo_view = self._visitor.photo_view
        index = None if photo_view is None else photo_view.index
        if index == self._photo_index:
            return
        self._photo_index = index
        name = _NOWHERE if index is None else f"At {html.escape(self._photos.views[index].name)}"
        self._where.content = note(name)
        self._wipe.visible = self._flip.visible = index is not None
        self._show_frustums()
        self._show_legend()

    def _show_frustums(self) -> None:
        """Show or hide frustums. At a photo they are hidden: its frustum would cover the view."""
        shown = self._shown.value and self._photo_index is None
        if shown and self._hidden is not None:
            self._hidden.remove()
            self._hidden = None
        elif not shown and self._hidden is None:
            self._hidden = self._client.scene.add_frame(FRUSTUMS, show_axes=False, visible=False)

    # Crop

    def _add_crop(self, bounds: Tensor) -> None:
        gui = self._client.gui
        middle, half = bounds.mean(0), (bounds[1] - bounds[0]) / 2
        low, high = (middle - 2 * half).tolist(), (middle + 2 * half).tolist()
        with gui.add_folder("Crop box", order=3, expand_by_default=False):
            self._crop = gui.add_checkbox("Crop", False, hint="Show only Gaussians in the box")
            self._ranges = [
                gui.add_multi_slider(
                    name,
                    min=round(low[i], 3),
                    max=round(high[i], 3),
                    step=max(round((high[i] - low[i]) / 200, 3), 0.001),
                    initial_value=(round(bounds[0, i].item(), 3), round(bounds[1, i].item(), 3)),
                )
                for i, name in enumerate(("x (right)", "y (down)", "z (forward)"))
            ]
        for control in (self._crop, *self._ranges):
            control.on_update(in_server_thread(self._crop_changed))  # type: ignore[attr-defined]

    def _crop_changed(self) -> None:
        crop = None
        if self._crop.value:
            ranges = [sorted(map(float, control.value)) for control in self._ranges]
            low, high = zip(*((values[0], values[-1]) for values in ranges), strict=True)
            crop = (low, high)
        self._set_display(crop=crop)
