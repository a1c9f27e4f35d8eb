"""The page's server with a client that sends poses as a browser does."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress

import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.live.session import MOVE_SECONDS
from snowsplat.viewer.live.viewer import NetworkViewer, Scene

from ..clients import Visitor, camera, frame, upgrade

pytestmark = pytest.mark.slow


def wait(true: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_user_who_moves_at_once_leaves_the_photo(tmp_path):
    """The browser may send its next pose after the user has moved the camera away again."""
    dataset = load_dataset(write_toy_dataset(tmp_path, "colmap-bin", 3, 48, 36, n_points=50))
    viewer = NetworkViewer(dataset)
    try:
        with Visitor(viewer.url) as visitor:
            visitor.send_camera()
            while "Go to" not in visitor.controls:
                visitor.pictures(0.1)
            (seen,) = viewer.session._visitors.values()
            visitor.press("Go to", "Next")
            wait(lambda: seen.photo_view is not None)
            arrival = time.monotonic()
            visitor.send_camera(position=[0.0, 0.5, -3.0])  # the only pose
            wait(lambda: seen.photo_view is None)
            assert time.monotonic() - arrival > 0.9 * MOVE_SECONDS
            (browser,) = viewer._browsers.values()
            wait(lambda: "click one to view the scene" in browser.controls._where.content)
    finally:
        viewer.close()


def test_a_newer_scene_replaces_the_one_shown(tmp_path):
    """`snowsplat watch` shows each new checkpoint, which may have another number of Gaussians."""
    dataset = load_dataset(write_toy_dataset(tmp_path, "colmap-bin", 3, 48, 36, n_points=50))
    gaussians = Gaussians.from_points(dataset.points)
    few = gaussians.select(torch.arange(30))
    saved, shown = [Scene(few, 1, ["30"])], []
    ended = threading.Event()

    def newest() -> Scene:
        if ended.is_set():
            raise KeyboardInterrupt
        shown.append(saved[-1].number)
        return saved[-1]

    def show() -> None:
        with suppress(KeyboardInterrupt):
            viewer.show_newest(newest)

    viewer = NetworkViewer(dataset)
    thread = threading.Thread(target=show)
    thread.start()
    try:
        with Visitor(viewer.url) as visitor:
            wait(lambda: 1 in shown)
            visitor.send_camera()
            assert visitor.pictures(20.0, most=1) == 1
            saved.append(Scene(gaussians, 2, ["50"]))
            wait(lambda: shown.count(2) >= 2)
            visitor.send_camera(position=[0.0, 0.5, -3.0])
            assert visitor.pictures(20.0, most=1) == 1
    finally:
        ended.set()
        thread.join(timeout=20.0)
        viewer.close()
    assert not thread.is_alive()


def test_a_browser_that_receives_slowly_gets_the_newest_images(tmp_path):
    """Without the answer to a ping, an image has not arrived, and only a few are sent."""
    dataset = load_dataset(write_toy_dataset(tmp_path, "colmap-bin", 3, 48, 36, n_points=50))
    gaussians = Gaussians.from_points(dataset.points)
    viewer = NetworkViewer(dataset)

    def images(move: Callable[[float], None], moves: int) -> int:
        """How many images are rendered while the camera moves."""
        rendered = 0
        for i in range(moves):
            move(0.01 * i)
            end = time.monotonic() + 0.1
            while time.monotonic() < end:
                rendered += viewer.serve(gaussians, 0, training=False)
                time.sleep(0.005)
        return rendered

    try:
        with upgrade(viewer.url) as silent:
            assert images(lambda x: silent.sendall(frame(camera(position=[x, 0.0, -3.0]))), 12) == 3
            (seen,) = viewer.session._visitors.values()
            assert seen.on_the_way == 3
        wait(lambda: not viewer.session.visitors)
        with Visitor(viewer.url) as visitor:
            assert images(lambda x: visitor.send_camera(position=[x, 0.0, -3.0]), 12) >= 9
            (seen,) = viewer.session._visitors.values()
            visitor.pictures(0.5)
            wait(lambda: seen.on_the_way == 0)
    finally:
        viewer.close()
