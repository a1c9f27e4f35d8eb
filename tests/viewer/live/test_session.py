"""Which picture is due, what the training keeps of its time, pause and step."""

import threading
import time

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.viewer.live.display import DisplaySettings, Pose
from snowsplat.viewer.live.session import IDLE_SHARE, STILL, PhotoView, Session


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


def pose(x: float = 0.0) -> Pose:
    position = torch.tensor([x, 0.0, 0.0]).double()
    return Pose(torch.tensor([1.0, 0, 0, 0]).double(), position, 1.0, 1600, 900)


def serve(session: Session, clock: Clock, scene: int, seconds: float, training=True) -> str | None:
    """Take ``seconds`` over the picture that is due; which kind that was."""
    due = session.next_due(scene, training)
    if due is None:
        return None
    clock.now += seconds
    session.spent(due, scene, seconds)
    return due.kind


def test_small_while_it_moves_then_full_then_as_the_scene_goes_on(session, clock):
    visitor = session.enter(1)
    assert session.next_due(0, training=False) is None  # from where it looks is not known
    session.move(visitor, pose())
    due = session.next_due(0, training=False)
    assert (due.kind, due.width, due.height) == ("moving", 640, 360)
    session.spent(due, 0, 0.01)
    assert session.next_due(0, training=False) is None
    clock.now += STILL + 0.01
    due = session.next_due(0, training=False)
    assert (due.kind, due.width, due.height) == ("still", 1280, 720)
    session.spent(due, 0, 0.04)
    clock.now += 10
    assert session.next_due(0, training=False) is None
    assert session.next_due(1, training=False).kind == "idle"


def test_pictures_of_a_moving_camera_are_as_large_as_is_quick(session, clock):
    visitor = session.enter(1)
    for i in range(30):
        session.move(visitor, pose(i))
        due = session.next_due(0, training=False)
        session.spent(due, 0, 1e-6 * due.width * due.height)  # a microsecond a pixel
    assert due.width * due.height == pytest.approx(50_000, rel=0.1)
    for i in range(30):
        session.move(visitor, pose(i))
        due = session.next_due(0, training=False)
        session.spent(due, 0, 1e-8 * due.width * due.height)
    assert (due.width, due.height) == (1280, 720)


def test_every_change_makes_a_picture_due(session, clock):
    visitor = session.enter(1)
    session.move(visitor, pose())
    clock.now += 1
    assert serve(session, clock, 0, 0.01) == "still"
    for change in ({"look": DisplaySettings("depth")}, {"longest": 320}):
        session.change(visitor, **change)
        clock.now += 1
        assert serve(session, clock, 0, 0.01, training=False) == "still", change
    assert session.next_due(0, training=False) is None


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_the_share_while_it_moves(session, clock, share):
    """A training of steps of 10 ms, a camera that never rests, pictures of 30 ms."""
    session.share = share
    visitor = session.enter(1)
    viewing, start = 0.0, clock.now
    for i in range(2000):
        clock.now += 0.01
        session.move(visitor, pose(i))
        if serve(session, clock, i, 0.03):
            viewing += 0.03
    assert viewing / (clock.now - start) == pytest.approx(share, rel=0.2)


def test_one_picture_at_a_time_is_under_way(session, clock):
    """They do not pile up where they cannot be sent as fast as they are made."""
    visitor, other = session.enter(1), session.enter(2)
    session.move(visitor, pose())
    due = session.next_due(0, training=False)
    session.send_to(visitor)
    assert session.next_due(0, training=False) is None
    session.move(other, pose())
    assert session.next_due(0, training=False).visitor is other
    session.leave(2)
    session.sent(due, 0.1)
    assert session.next_due(0, training=True) is None  # what sending took is the training's too
    assert session.next_due(0, training=False).visitor is visitor
    clock.now += 0.11
    assert session.next_due(0, training=True).visitor is visitor


def test_the_share_while_nobody_moves(session, clock):
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


def test_who_moves_goes_first(session, clock):
    still, moving = session.enter(1), session.enter(2)
    session.move(still, pose())
    clock.now += 1
    session.move(moving, pose())
    assert session.next_due(0, training=True).visitor is moving
    assert serve(session, clock, 0, 0.01, training=False) == "moving"
    assert session.next_due(0, training=False).visitor is still
    session.leave(1)
    assert session.next_due(0, training=False) is None
    assert not session.is_here(still)
    assert session.is_here(moving)


def test_a_picture_that_was_changed_meanwhile_is_due_again(session, clock):
    visitor = session.enter(1)
    session.move(visitor, pose())
    clock.now += 1
    due = session.next_due(0, training=False)
    session.move(visitor, pose(1))
    session.spent(due, 0, 0.01)
    assert session.next_due(0, training=False).pose.position[0] == 1


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
    session.step()  # of a training that runs: it stops after the one that it is at
    assert not session.may_step()
    assert session.paused


def test_waiting_ends_with_a_change():
    session = Session()
    session.pause()
    threading.Timer(0.05, session.resume).start()
    started = time.monotonic()
    session.wait(10)
    assert time.monotonic() - started < 5
    assert session.may_step()


def test_busy_is_about_visitors(session):
    session.enter(1)
    session.enter(2)
    assert session.busy
    assert session.visitors == 2
    session.leave(1)
    session.leave(1)
    assert session.busy
    session.leave(2)
    assert not session.busy


# Standing at a photo


def test_moving_away_leaves_the_photo(session, clock):
    visitor = session.enter(1)
    session.move(visitor, pose())
    camera = Camera(4, 3, 5.0, 5.0, 2.0, 1.5, torch.eye(3, 4).double())
    photo_view = PhotoView(0, camera, torch.zeros(3, 3, 4, dtype=torch.uint8), pose(5))
    session.send(visitor, photo_view)
    clock.now += 0.1
    session.move(visitor, pose(1))  # was under way already
    assert visitor.photo_view is photo_view
    session.move(visitor, pose(5))
    assert visitor.photo_view is photo_view
    session.move(visitor, pose(5.1))
    assert visitor.photo_view is None


def test_a_browser_that_never_arrives_does_not_stand_there(session, clock):
    visitor = session.enter(1)
    camera = Camera(4, 3, 5.0, 5.0, 2.0, 1.5, torch.eye(3, 4).double())
    session.send(visitor, PhotoView(0, camera, torch.zeros(3, 3, 4, dtype=torch.uint8), pose(5)))
    clock.now += 10
    session.move(visitor, pose(1))
    assert visitor.photo_view is None
