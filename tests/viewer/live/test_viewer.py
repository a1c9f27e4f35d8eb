"""The page's server with a client that sends poses as a browser does."""

import time
from collections.abc import Callable

import pytest

from snowsplat.data import load_dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.live.session import MOVE_SECONDS
from snowsplat.viewer.live.viewer import NetworkViewer

from ..clients import Visitor

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
            ((_, _, controls),) = viewer._browsers.values()
            wait(lambda: "click one to view the scene" in controls._where.content)
    finally:
        viewer.close()
