"""The state of the browsers and of the training, and the choice of the next image to render.

The thread of the server changes this state when browsers send messages. The thread of the training
reads it between two steps. This module does not render or send images.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from snowsplat.scene.camera import Camera
from snowsplat.util.image_size import scaled_size
from snowsplat.viewer.live.pictures import Display, View

STILL = 0.2  # seconds without motion after which a camera counts as still
# While the camera moves, images are made so small that rendering takes at most this many seconds.
_MOVING_SECONDS = 0.05
_MIN_SIDE = 160  # pixels: minimum of the longer side of such an image
# Images that may be on the way to a browser. More would wait for a slow link, and arrive late.
_ON_THE_WAY = 3
# An image is "requested" if a user moved the camera or changed a setting, and "idle" if only the
# scene has changed.
IDLE_SHARE = 0.05  # maximum share of the training time for idle images
_IDLE_SECONDS = 1.0  # minimum time between two idle images


@dataclass(frozen=True, eq=False)
class PhotoView:
    """A photo at whose pose a browser is, to compare the photo with its rendering."""

    index: int  # index of the photo in the viewer's list
    camera: Camera  # camera of the photo
    photo: np.ndarray  # (h, w, 3) uint8, of any size


@dataclass(frozen=True)
class RenderRequest:
    """An image to render for a browser."""

    visitor: Visitor
    # "moving": a small image, because the camera moves; "still": full size; "idle": full size,
    # because only the scene has changed.
    kind: Literal["moving", "still", "idle"]
    width: int
    height: int
    version: int  # `Visitor.version` when the image was requested
    view: View
    display: Display
    photo_view: PhotoView | None


@dataclass(eq=False)
class Visitor:
    """One browser that shows the page. Change its attributes through `Session.change`."""

    view: View | None = None
    display: Display = field(default_factory=Display)
    photo_view: PhotoView | None = None  # the photo of the view, as soon as it is read
    on_the_way: int = 0  # images that were rendered, and have not arrived at the browser
    version: int = 0  # incremented with each change of the attributes above
    changed: float = 0.0  # time of the last change
    # About the last image that was rendered:
    shown_version: int = -1  # `RenderRequest.version`
    shown_full: bool = False  # whether it had full size
    shown_scene: int = -1  # the number of the scene
    seconds_per_pixel: float = 0.0  # rendering time, averaged over the last images

    @property
    def photo(self) -> int | None:
        """The index of the photo at whose pose the browser is."""
        return None if self.view is None else self.view.photo

    def request(self, scene: int, now: float) -> RenderRequest | None:
        """The image that the browser needs at the time ``now``; None if it needs none.

        ``scene``: a number that changes when the scene changes.
        """
        if self.view is None or self.on_the_way >= _ON_THE_WAY:
            return None
        full = scaled_size(self.view.width, self.view.height, self.display.longest)
        moving = now - self.changed < STILL
        kind: Literal["moving", "still", "idle"]
        if moving and self.shown_version != self.version:
            kind, size = "moving", self._moving_size(full)
        elif not moving and (self.shown_version != self.version or not self.shown_full):
            kind, size = "still", full
        elif not moving and self.shown_scene != scene:
            kind, size = "idle", full
        else:
            return None
        return RenderRequest(
            self, kind, *size, self.version, self.view, self.display, self.photo_view
        )

    def _moving_size(self, full: tuple[int, int]) -> tuple[int, int]:
        """A size that can be rendered fast enough, estimated from the times of previous images."""
        if not self.seconds_per_pixel:
            return scaled_size(*full, max(full) // 2)
        pixels = _MOVING_SECONDS / self.seconds_per_pixel
        scale = min(1.0, (pixels / (full[0] * full[1])) ** 0.5)
        return scaled_size(*full, max(round(max(full) * scale), _MIN_SIDE))

    def record_rendering(self, request: RenderRequest, scene: int, seconds: float) -> None:
        """Record that the image was rendered in ``seconds``."""
        self.shown_version, self.shown_scene = request.version, scene
        self.shown_full = request.kind != "moving"
        cost = seconds / (request.width * request.height)
        before = self.seconds_per_pixel or cost
        self.seconds_per_pixel = before + 0.3 * (cost - before)


class Session:
    """All browsers and the training; thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._visitors: dict[int, Visitor] = {}
        self._paused = False
        self._steps = 0  # single steps that are allowed while paused
        self.training = False  # whether training is running or paused
        self.share = 0.5  # maximum share of the time for requested images during training
        # For each budget, the time from which the next image is allowed:
        self._next_allowed = {"requested": 0.0, "idle": 0.0}
        self.busy = False  # whether a browser is connected or the training is paused

    # Called when browsers send messages

    def enter(self, number: int) -> Visitor:
        """Add a browser."""
        with self._changed:
            visitor = self._visitors[number] = Visitor()
            self._notify()
            return visitor

    def leave(self, number: int) -> None:
        """Remove a browser."""
        with self._changed:
            self._visitors.pop(number, None)
            self._notify()

    def change(self, visitor: Visitor, **changes: object) -> None:
        """Set attributes of a visitor; this requests a new image."""
        with self._changed:
            for name, value in changes.items():
                setattr(visitor, name, value)
            visitor.version += 1
            visitor.changed = self._clock()
            self._notify()

    def move(self, visitor: Visitor, view: View) -> None:
        """Set the view of a browser."""
        kept = visitor.photo_view
        if kept is not None and kept.index != view.photo:
            kept = None
        self.change(visitor, view=view, photo_view=kept)

    def show_photo(self, visitor: Visitor, photo_view: PhotoView) -> None:
        """Show a photo that was read, if the browser is still at its pose."""
        if visitor.photo == photo_view.index:
            self.change(visitor, photo_view=photo_view)

    def pause(self) -> None:
        """Pause the training after the current step."""
        with self._changed:
            self._paused, self._steps = True, 0
            self._notify()

    def resume(self) -> None:
        """Resume the training."""
        with self._changed:
            self._paused, self._steps = False, 0
            self._notify()

    def step(self) -> None:
        """Allow one step, then pause."""
        with self._changed:
            self._steps = self._steps + 1 if self._paused else 0
            self._paused = True
            self._notify()

    def _notify(self) -> None:
        self.busy = bool(self._visitors) or self._paused
        self._changed.notify_all()

    # Called by the training

    @property
    def paused(self) -> bool:
        return self._paused

    @property
    def visitors(self) -> int:
        """Number of browsers."""
        return len(self._visitors)

    def may_step(self) -> bool:
        """Whether the training may run a step. While paused, each True uses one allowed step."""
        with self._changed:
            if self._paused and self._steps:
                self._steps -= 1
                return True
            return not self._paused

    def next_request(self, scene: int, training: bool) -> RenderRequest | None:
        """The next image to render; None if there is none, or if the training has to run first.

        ``scene`` changes when the scene changes. ``training``: whether it waits to continue.
        """
        now = self._clock()
        with self._changed:
            found = [request for v in self._visitors.values() if (request := v.request(scene, now))]
        if training:
            found = [request for request in found if now >= self._next_allowed[_budget_of(request)]]
        # Moving cameras are first; of one kind, the browser that has waited longest is first.
        order = ("moving", "still", "idle")
        return min(
            found,
            key=lambda request: (order.index(request.kind), request.visitor.changed),
            default=None,
        )

    def record_rendering(self, request: RenderRequest, scene: int, seconds: float) -> None:
        """Record that an image was rendered in ``seconds``."""
        with self._changed:
            request.visitor.record_rendering(request, scene, seconds)
        self.charge(_budget_of(request), seconds)

    def begin_sending(self, visitor: Visitor) -> None:
        """Record that an image is on the way to a browser, until `arrived`."""
        with self._changed:
            visitor.on_the_way += 1

    def arrived(self, visitor: Visitor, images: int) -> None:
        """Record that images have arrived at a browser, or were not sent."""
        with self._changed:
            visitor.on_the_way -= images
            self._notify()

    def record_sending(self, request: RenderRequest, seconds: float) -> None:
        """Record that an image was encoded, ``seconds`` after rendering began."""
        self.charge(_budget_of(request), seconds)

    def charge(self, budget: Literal["requested", "idle"], seconds: float) -> None:
        """Record that ``seconds`` were used, and delay the next image of this budget accordingly,
        so that rendering does not exceed its share of the time during training. Requested images
        also delay the next idle image.
        """
        now = self._clock()
        share = min(max(self.share, 0.01), 1.0)
        if budget == "requested":
            self._next_allowed["requested"] = now + seconds * (1.0 / share - 1.0)
        pause = max(_IDLE_SECONDS, seconds * (1.0 / min(share, IDLE_SHARE) - 1.0))
        self._next_allowed["idle"] = max(self._next_allowed["idle"], now + pause)

    def wait(self, seconds: float) -> None:
        """Wait until the state changes, at most ``seconds``."""
        with self._changed:
            self._changed.wait(seconds)


def _budget_of(request: RenderRequest) -> Literal["requested", "idle"]:
    return "idle" if request.kind == "idle" else "requested"
