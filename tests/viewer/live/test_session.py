"""The next image, the training's share of the time, pause and step."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.viewer.live.pictures import Display, View
from snowsplat.viewer.live.session import IDLE_SHARE, STILL, PhotoView, Session

from ...waiting import wait_until


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def session(clock) -> Session:
    return Session(clock)


def pose(x: float = 0.0, photo: int | None = None) -> View:
    return View(0, (1.0, 0.0, 0.0, 0.0), (x, 0.0, 0.0), 1.0, 1600, 900, photo)


def serve(session: Session, clock: Clock, scene: int, seconds: float, training=True) -> str | None:
    """Render the due image in ``seconds``; returns its kind."""
    request = session.next_request(scene, training)
    if request is None:
        return None
    clock.now += seconds
    session.record_rendering(request, scene, seconds)
    return request.kind


def test_images_are_small_while_the_camera_moves_and_then_full_size(session, clock):
    visitor = session.enter(1)
    assert session.next_request(0, training=False) is None  # its pose is unknown
    session.move(visitor, pose())
    request = session.next_request(0, training=False)
    assert (request.kind, request.width, request.height) == ("moving", 640, 360)
    session.record_rendering(request, 0, 0.01)
    assert session.next_request(0, training=False) is None
    clock.now += STILL + 0.01
    request = session.next_request(0, training=False)
    assert (request.kind, request.width, request.height) == ("still", 1280, 720)
    session.record_rendering(request, 0, 0.04)
    clock.now += 10
    assert session.next_request(0, training=False) is None
    assert session.next_request(1, training=False).kind == "idle"


def test_images_of_a_moving_camera_have_a_size_that_is_fast(session, clock):
    visitor = session.enter(1)
    for i in range(30):
        session.move(visitor, pose(i))
        request = session.next_request(0, training=False)
        session.record_rendering(
            request, 0, 1e-6 * request.width * request.height
        )  # a microsecond per pixel
    assert request.width * request.height == pytest.approx(50_000, rel=0.1)
    for i in range(30):
        session.move(visitor, pose(i))
        request = session.next_request(0, training=False)
        session.record_rendering(request, 0, 1e-8 * request.width * request.height)
    assert (request.width, request.height) == (1280, 720)


def test_every_change_needs_a_new_image(session, clock):
    visitor = session.enter(1)
    session.move(visitor, pose())
    clock.now += 1
    assert serve(session, clock, 0, 0.01) == "still"
    for change in (Display("depth"), Display("depth", longest=320)):
        session.change(visitor, display=change)
        clock.now += 1
        assert serve(session, clock, 0, 0.01, training=False) == "still", change
    assert session.next_request(0, training=False) is None


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_the_share_while_a_camera_moves(session, clock, share):
    """Steps of 10 ms, images of 30 ms, and a camera that always moves."""
    session.share = share
    visitor = session.enter(1)
    viewing, start = 0.0, clock.now
    for i in range(2000):
        clock.now += 0.01
        session.move(visitor, pose(i))
        if serve(session, clock, i, 0.03):
            viewing += 0.03
    assert viewing / (clock.now - start) == pytest.approx(share, rel=0.2)


def test_few_images_are_on_the_way(session, clock):
    """Images do not accumulate if the link is slower than rendering."""
    visitor, other = session.enter(1), session.enter(2)
    session.move(visitor, pose())
    request = session.next_request(0, training=False)
    for _ in range(3):
        assert session.next_request(0, training=False).visitor is visitor
        session.begin_sending(visitor)
    assert session.next_request(0, training=False) is None
    session.move(other, pose())
    assert session.next_request(0, training=False).visitor is other
    session.leave(2)
    session.record_sending(request, 0.1)
    session.arrived(visitor, 1)
    assert session.next_request(0, training=True) is None  # sending counts as viewing time, too
    assert session.next_request(0, training=False).visitor is visitor
    clock.now += 0.11
    assert session.next_request(0, training=True).visitor is visitor


def test_the_share_while_no_camera_moves(session, clock):
    visitor = session.enter(1)
    session.move(visitor, pose())
    viewing, pictures, start = 0.0, 0, clock.now
    for i in range(20_000):
        clock.now += 0.01
        if serve(session, clock, i, 0.08):
            viewing += 0.08
            pictures += 1
    assert viewing / (clock.now - start) < 1.05 * IDLE_SHARE
    assert pictures > 50


def test_a_moving_camera_is_served_first(session, clock):
    still, moving = session.enter(1), session.enter(2)
    session.move(still, pose())
    clock.now += 1
    session.move(moving, pose())
    assert session.next_request(0, training=True).visitor is moving
    assert serve(session, clock, 0, 0.01, training=False) == "moving"
    assert session.next_request(0, training=False).visitor is still
    session.leave(1)
    assert session.next_request(0, training=False) is None


def test_a_change_during_rendering_needs_a_new_image(session, clock):
    visitor = session.enter(1)
    session.move(visitor, pose())
    clock.now += 1
    request = session.next_request(0, training=False)
    session.move(visitor, pose(1))
    session.record_rendering(request, 0, 0.01)
    assert session.next_request(0, training=False).view.position[0] == 1


# Pause


def test_pause_step_and_resume(session):
    assert session.may_step()
    assert not session.busy
    session.pause()
    assert session.busy
    assert session.paused
    assert not session.may_step()
    session.step()
    session.step()
    assert [session.may_step() for _ in range(3)] == [True, True, False]
    session.resume()
    assert session.may_step()
    assert not session.busy
    session.step()  # of an ongoing training run: it pauses after the current step
    assert not session.may_step()
    assert session.paused


def test_wait_returns_after_a_change():
    session = Session()
    session.pause()
    waiting = threading.Thread(target=session.wait, args=(600,), daemon=True)
    waiting.start()
    # Again and again, since the first change may come before the other thread waits.
    wait_until(lambda: session.pause() or session.resume() or not waiting.is_alive())
    assert session.may_step()


def test_busy_depends_on_visitors(session):
    session.enter(1)
    session.enter(2)
    assert session.busy
    assert session.visitors == 2
    session.leave(1)
    session.leave(1)
    assert session.busy
    session.leave(2)
    assert not session.busy


# The view at a photo


def test_a_photo_is_shown_only_at_its_pose(session, clock):
    visitor = session.enter(1)
    camera = Camera(4, 3, 5.0, 5.0, 2.0, 1.5, torch.eye(3, 4).double())
    first, second = (PhotoView(i, camera, np.zeros((3, 4, 3), np.uint8)) for i in range(2))
    session.move(visitor, pose(5, 1))
    session.show_photo(visitor, first)  # it was read too late
    assert visitor.photo_view is None
    session.show_photo(visitor, second)
    assert session.next_request(0, training=False).photo_view is second
    session.move(visitor, replace(pose(5, 1), width=800))  # another size of the window
    assert visitor.photo_view is second
    session.move(visitor, pose(5.1))
    assert visitor.photo_view is None
    assert session.next_request(0, training=False).photo_view is None
