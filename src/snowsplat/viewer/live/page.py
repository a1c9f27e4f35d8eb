"""The controls of the page: those of the training, for all browsers, and each browser's own."""

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
from snowsplat.viewer.live.gauge import Curve
from snowsplat.viewer.live.guard import tell
from snowsplat.viewer.live.look import Mode
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
    "color": "Drag to turn, right button to shift, wheel to come nearer.",
    "depth": "Yellow is near, violet is far.",
    "alpha": "White is opaque, black is empty.",
    "normals": "Red to the right, green up, blue to you: the shortest axis of each Gaussian.",
    "points": "The centre of each Gaussian.",
    "ellipsoids": "Each Gaussian as a solid body, as far as 1.5 standard deviations.",
    "cost": "How many a pixel blends. Black: none, red: about 30, pale yellow: 256 or more.",
    "error": "Black: none, pale yellow: a quarter of the range or more.",
}
_NOWHERE = "Show the cameras and click one, to stand where its photo was taken."
_NEEDS_PHOTO = "Shown where you stand at a photo: click a camera, or Next below."


def note(text: str) -> str:
    """Lines of small text."""
    style = "font-size:0.85em;padding:0 1em 0.5em 1em;line-height:1.5"
    return f'<div style="{style}">{text}</div>'


def at_once(run: Callable[[], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """A callback of a control that runs in the thread of the server, not in one of many.

    So what is asked is done in order, and nothing is read from a browser before it is.
    """

    async def called(_: Any) -> None:
        run()

    return called


def within(value: Any, low: float, high: float) -> float:
    """The value of a slider, which browsers may set to whatever they like."""
    return min(max(float(value), low), high)


class TrainingPanel:
    """How the training goes, and its controls: the same for all browsers."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        tell(server, self._add)

    def _add(self) -> None:
        server, session = self._server, self._session
        with server.gui.add_folder("Training", order=0):
            self._status = server.gui.add_html(note("waiting for the first step"))
            self._bar = server.gui.add_progress_bar(0.0)
            self._pause = server.gui.add_button("Pause")
            self._step = server.gui.add_button("One step")
            self._share = server.gui.add_slider(
                "Viewing time (%)",
                5,
                95,
                5,
                round(100 * session.share),
                hint="While a camera moves: how much of the time pictures may take from training",
            )
            self._loss = _plot(server, "Loss", "#4a7fe0")
            self._psnr = _plot(server, "PSNR (dB)", "#e08a2a")
        self._pause.on_click(at_once(self._pause_clicked))
        self._step.on_click(at_once(self._step_clicked))
        self._share.on_update(at_once(self._share_changed))

    def _pause_clicked(self) -> None:
        if self._session.paused:
            self._session.resume()
        else:
            self._session.pause()
        self._name_pause()

    def _step_clicked(self) -> None:
        self._session.step()
        self._name_pause()

    def _share_changed(self) -> None:
        self._session.share = within(self._share.value, 5, 95) / 100.0

    def _name_pause(self) -> None:
        self._pause.label = "Go on" if self._session.paused else "Pause"

    def show(self, status: list[str], share: float, loss: Curve, psnr: Curve) -> None:
        """
        Args:
            status: lines about the training.
            share: of its steps that are made, 0..1.
        """
        curves = loss.arrays(), psnr.arrays()

        def put() -> None:
            self._status.content = note("<br>".join(map(html.escape, status)))
            self._bar.value = 100.0 * share  # type: ignore[misc]  # viser's setter has another type
            for plot, curve in zip((self._loss, self._psnr), curves, strict=True):
                if len(curve[0]) > 1:
                    plot.data = curve
                    plot.visible = True

        tell(self._server, put)

    def end(self) -> None:
        """Nothing is left to be paused."""

        def hide() -> None:
            for control in (self._pause, self._step, self._share):
                control.visible = False

        tell(self._server, hide)


def _plot(server: viser.ViserServer, name: str, color: str) -> viser.GuiUplotHandle:
    series = (
        {"label": "step"},
        {"label": name, "stroke": color, "width": 1.5, "points": {"show": False}},
    )
    return server.gui.add_uplot(
        (np.zeros(2), np.zeros(2)),
        series,  # type: ignore[arg-type]  # plain dictionaries are meant
        title=name,
        scales={"x": {"time": False}},
        legend={"show": False},
        height=110,
        visible=False,
    )


class ScenePanel:
    """What is shown, where nothing is trained."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        tell(server, self._add)

    def _add(self) -> None:
        with self._server.gui.add_folder("Scene", order=0):
            self._status = self._server.gui.add_html(note("nothing yet"))

    def show(self, status: list[str]) -> None:
        """Lines about the scene."""

        def put() -> None:
            self._status.content = note("<br>".join(map(html.escape, status)))

        tell(self._server, put)


class Controls:
    """One browser's own: what its pictures show."""

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        visitor: Visitor,
        photos: Photos,
        bounds: Tensor,
    ) -> None:
        """``bounds``: (2, 3) of the scene, for the crop box."""
        self._client, self._session, self._visitor = client, session, visitor
        self._photos = photos
        self._stand: int | None = None
        self._next: int | None = None  # where it is to stand when that photo is read
        self._going: asyncio.Task[None] | None = None
        self._hidden: viser.FrameHandle | None = None  # of this browser, in place of all frustums
        self._add_picture()
        self._add_photos()
        self._add_crop(bounds)

    def _look(self, **changes: Any) -> None:
        look = dataclasses.replace(self._visitor.look, **changes)
        self._session.change(self._visitor, look=look)

    # Picture

    def _add_picture(self) -> None:
        gui, look = self._client.gui, self._visitor.look
        with gui.add_folder("Picture", order=1):
            self._mode = gui.add_dropdown("Show", list(_MODES))
            self._legend = gui.add_html(note(_LEGENDS["color"]))
            degree = gui.add_slider(
                "SH degree", 0, 3, 1, look.sh_degree, hint="How far colours change with direction"
            )
            scale = gui.add_slider(
                *("Gaussian size", 2, 100, 2, 100),
                hint="Percent: shrinks every Gaussian, to see each by itself",
            )
            finest = gui.add_slider(
                *("Most pixels", 320, 2560, 80, self._visitor.longest),
                hint="The longer side of a picture when the camera stands still",
            )

        def size_chosen() -> None:
            longest = int(within(finest.value, 320, 2560))
            self._session.change(self._visitor, longest=longest)

        self._mode.on_update(at_once(self._mode_chosen))
        degree.on_update(at_once(lambda: self._look(sh_degree=int(within(degree.value, 0, 3)))))
        scale.on_update(at_once(lambda: self._look(scale=within(scale.value, 2, 100) / 100.0)))
        finest.on_update(at_once(size_chosen))

    def _mode_chosen(self) -> None:
        if self._mode.value in _MODES:
            self._look(mode=_MODES[self._mode.value])
            self._say_legend()

    def _say_legend(self) -> None:
        mode = self._visitor.look.mode
        missing = mode == "error" and self._stand is None
        self._legend.content = note(_NEEDS_PHOTO if missing else _LEGENDS[mode])

    # Photos

    def _add_photos(self) -> None:
        gui = self._client.gui
        with gui.add_folder("Photos", order=2, visible=bool(self._photos.views)):
            self._shown = gui.add_checkbox("Cameras", False)
            self._where = gui.add_html(note(_NOWHERE))
            self._wipe = gui.add_slider(
                *("Photo (%)", 0, 100, 1, 0), visible=False, hint="From the left, over the render"
            )
            self._flip = gui.add_button_group("Show only", ("Render", "Photo"), visible=False)
            self._move = gui.add_button_group("Go to", ("Previous", "Next"))
        self._show_frustums()
        self._shown.on_update(at_once(self._show_frustums))
        self._wipe.on_update(
            at_once(lambda: self._look(wipe=within(self._wipe.value, 0, 100) / 100.0))
        )
        self._flip.on_click(
            at_once(lambda: self._wipe_to(100 if self._flip.value == "Photo" else 0))
        )
        self._move.on_click(at_once(lambda: self._go(1 if self._move.value == "Next" else -1)))

    def _wipe_to(self, percent: int) -> None:
        self._wipe.value = percent  # type: ignore[misc]
        self._look(wipe=percent / 100.0)

    def _go(self, by: int) -> None:
        count = len(self._photos.views)
        now = self._stand if self._next is None else self._next
        self.stand_at(0 if now is None else (now + by) % count)

    def stand_at(self, index: int) -> None:
        """Go to where a photo was taken, once it has been read; the last that was asked for."""
        self._next = index
        if self._going is None or self._going.done():
            self._going = asyncio.get_running_loop().create_task(self._go_on())

    async def _go_on(self) -> None:
        while self._next is not None:
            index = self._next
            try:
                stand = await self._photos.read(self._visitor, index)
            except UserError as error:
                self._where.content = note(html.escape(str(error)))
                stand = None
            if self._next != index:
                continue  # another one was asked for meanwhile
            self._next = None
            if stand is not None:
                self._photos.send(self._client, self._visitor, stand)
                self.follow()

    def follow(self) -> None:
        """Show whether the browser stands at a photo, if that has changed."""
        stand = self._visitor.stand
        index = None if stand is None else stand.index
        if index == self._stand:
            return
        self._stand = index
        name = _NOWHERE if index is None else f"At {html.escape(self._photos.views[index].name)}"
        self._where.content = note(name)
        self._wipe.visible = self._flip.visible = index is not None
        self._show_frustums()
        self._say_legend()

    def _show_frustums(self) -> None:
        """Not where one stands: the camera's own would be before the eye."""
        shown = self._shown.value and self._stand is None
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
            self._crop = gui.add_checkbox("Crop", False, hint="Show only what is within")
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
            control.on_update(at_once(self._crop_changed))  # type: ignore[attr-defined]

    def _crop_changed(self) -> None:
        crop = None
        if self._crop.value:
            ranges = [sorted(map(float, control.value)) for control in self._ranges]
            low, high = zip(*((values[0], values[-1]) for values in ranges), strict=True)
            crop = (low, high)
        self._look(crop=crop)
