"""Who looks from where, whether the training runs, and which picture is due next.

Browsers change this from threads of their own; the thread that trains asks it between two steps.
Nothing here draws, sends or knows viser.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.viewer.live.look import Look, Pose, fit

# A camera that has not moved for so long is still, seconds.
STILL = 0.2
# What a browser takes to arrive where it is sent, seconds.
_JOURNEY = 2.0
# A picture of a camera that moves is to take no longer than this, seconds; it is made smaller
# until it does, but not smaller than this many pixels at its longer side.
_MOVING_SECONDS, _SMALLEST = 0.05, 160
# What the pictures that nobody asked for (the scene has changed, the camera has not) may take of a
# training's time, and the seconds between two of them at least.
IDLE_SHARE, _IDLE_SECONDS = 0.05, 1.0


@dataclass(frozen=True, eq=False)
class Stand:
    """Standing where a photo was taken.

    Attributes:
        index: of the photo among those of the viewer.
        camera: its camera.
        photo: (3, H, W) uint8.
        pose: that the browser was sent to.
    """

    index: int
    camera: Camera
    photo: Tensor
    pose: Pose


@dataclass(frozen=True)
class Due:
    """A picture that a browser is to get.

    Attributes:
        kind: "moving" small and at once; "still" full size; "idle" the same, of a scene that has
            gone on.
        version: what `Visitor.version` was.
    """

    visitor: Visitor
    kind: Literal["moving", "still", "idle"]
    width: int
    height: int
    version: int
    pose: Pose
    look: Look
    stand: Stand | None


@dataclass(eq=False)
class Visitor:
    """One browser. Change it through `Session.change`."""

    pose: Pose | None = None
    look: Look = field(default_factory=Look)
    stand: Stand | None = None
    arrived: bool = False  # at the stand: from there, moving is leaving
    sent: float = 0.0  # when it was sent there
    longest: int = 1280  # pixels of the longer side of a full picture
    sending: bool = False  # its last picture is under way
    version: int = 0  # of all above
    changed: float = 0.0  # when that was
    # What it was shown last.
    shown_version: int = -1
    shown_full: bool = False
    shown_scene: int = -1
    seconds_per_pixel: float = 0.0

    def due(self, scene: int, now: float) -> Due | None:
        """The picture that would be right now, if it has not been shown."""
        if self.pose is None or self.sending:
            return None
        full = fit(self.pose.width, self.pose.height, self.longest)
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
        return Due(self, kind, *size, self.version, self.pose, self.look, self.stand)

    def _moving_size(self, full: tuple[int, int]) -> tuple[int, int]:
        """Small enough to be quick, by what pictures have taken so far."""
        if not self.seconds_per_pixel:
            return fit(*full, max(full) // 2)
        pixels = _MOVING_SECONDS / self.seconds_per_pixel
        scale = min(1.0, (pixels / (full[0] * full[1])) ** 0.5)
        return fit(*full, max(round(max(full) * scale), _SMALLEST))

    def shown(self, due: Due, scene: int, seconds: float) -> None:
        """The picture was made, and took so long."""
        self.shown_version, self.shown_scene = due.version, scene
        self.shown_full = due.kind != "moving"
        cost = seconds / (due.width * due.height)
        before = self.seconds_per_pixel or cost
        self.seconds_per_pixel = before + 0.3 * (cost - before)


class Session:
    """All browsers and the training."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._visitors: dict[int, Visitor] = {}
        self._paused = False
        self._steps = 0  # that may be made while it is paused
        self.training = False  # steps are made, or wait
        self.share = 0.5  # of the time, for pictures of cameras that move, while it trains
        self._free_at = {"asked": 0.0, "idle": 0.0}  # when the training has had its share
        self.busy = False  # somebody looks, or it is paused: the one thing a training has to ask

    # From the browsers

    def enter(self, number: int) -> Visitor:
        """A browser has come."""
        with self._changed:
            visitor = self._visitors[number] = Visitor()
            self._notify()
            return visitor

    def leave(self, number: int) -> None:
        """A browser has gone."""
        with self._changed:
            self._visitors.pop(number, None)
            self._notify()

    def change(self, visitor: Visitor, **changes: object) -> None:
        """Set attributes of a visitor: a new picture is due."""
        with self._changed:
            for name, value in changes.items():
                setattr(visitor, name, value)
            visitor.version += 1
            visitor.changed = self._clock()
            self._notify()

    def move(self, visitor: Visitor, pose: Pose) -> None:
        """It looks from somewhere else; whoever stands at a photo and moves, leaves it."""
        stand, arrived = visitor.stand, visitor.arrived
        if stand is not None:
            if pose.is_near(stand.pose):
                arrived = True
            # What is still on its way from the browser when it is sent to a photo is no leaving.
            elif arrived or self._clock() - visitor.sent > _JOURNEY:
                stand = None
        self.change(visitor, pose=pose, stand=stand, arrived=arrived)

    def send(self, visitor: Visitor, stand: Stand) -> None:
        """It is being sent to a photo."""
        self.change(visitor, stand=stand, arrived=False, sent=self._clock())

    def pause(self) -> None:
        """Hold the training after the step that it is at."""
        with self._changed:
            self._paused, self._steps = True, 0
            self._notify()

    def resume(self) -> None:
        """Let it go on."""
        with self._changed:
            self._paused, self._steps = False, 0
            self._notify()

    def step(self) -> None:
        """Let it make one more step, and hold it there."""
        with self._changed:
            self._steps = self._steps + 1 if self._paused else 0
            self._paused = True
            self._notify()

    def _notify(self) -> None:
        self.busy = bool(self._visitors) or self._paused
        self._changed.notify_all()

    # From the training

    @property
    def paused(self) -> bool:
        return self._paused

    @property
    def visitors(self) -> int:
        """How many look."""
        return len(self._visitors)

    def may_step(self) -> bool:
        """Whether the training may make a step; one of those allowed is used up."""
        with self._changed:
            if self._paused and self._steps:
                self._steps -= 1
                return True
            return not self._paused

    def is_here(self, visitor: Visitor) -> bool:
        """Whether it has not gone."""
        with self._changed:
            return visitor in self._visitors.values()

    def next_due(self, scene: int, training: bool) -> Due | None:
        """The most urgent picture; None where there is none, or the training has the time now.

        Args:
            scene: a number that changes when the scene does.
            training: steps are waiting.
        """
        now = self._clock()
        with self._changed:
            found = [due for v in self._visitors.values() if (due := v.due(scene, now))]
        if training:
            found = [due for due in found if now >= self._free_at[_purse(due)]]
        # Those that move first; of equals the one that has waited longest.
        order = ("moving", "still", "idle")
        return min(
            found, key=lambda due: (order.index(due.kind), due.visitor.changed), default=None
        )

    def spent(self, due: Due, scene: int, seconds: float) -> None:
        """The picture was made in so many seconds."""
        with self._changed:
            due.visitor.shown(due, scene, seconds)
        self.pay(_purse(due), seconds)

    def send_to(self, visitor: Visitor) -> None:
        """A picture is on its way to it: until it is `sent`, no other is due."""
        with self._changed:
            visitor.sending = True

    def sent(self, due: Due, seconds: float) -> None:
        """It has taken so long in all, from its drawing on."""
        self.pay(_purse(due), seconds)
        with self._changed:
            due.visitor.sending = False
            self._notify()

    def may_pay(self, purse: Literal["asked", "idle"]) -> bool:
        """Whether the training has had its share since the last time."""
        return self._clock() >= self._free_at[purse]

    def pay(self, purse: Literal["asked", "idle"], seconds: float) -> None:
        """The training is left alone until its share is what was promised.

        Also by what nobody asked for, when time went into what somebody did.
        """
        now = self._clock()
        share = min(max(self.share, 0.01), 1.0)
        if purse == "asked":
            self._free_at["asked"] = now + seconds * (1.0 / share - 1.0)
        pause = max(_IDLE_SECONDS, seconds * (1.0 / min(share, IDLE_SHARE) - 1.0))
        self._free_at["idle"] = max(self._free_at["idle"], now + pause)

    def wait(self, seconds: float) -> None:
        """Until something changes, no longer than this."""
        with self._changed:
            self._changed.wait(seconds)


def _purse(due: Due) -> Literal["asked", "idle"]:
    return "idle" if due.kind == "idle" else "asked"
