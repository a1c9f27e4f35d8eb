"""The page's server with a client that sends poses as a browser does."""

import gzip
import threading
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.near_plane import NEAR
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.live.curves import SampledPsnr
from snowsplat.viewer.live.key_cameras import KeyCameras
from snowsplat.viewer.live.session import MOVE_SECONDS
from snowsplat.viewer.live.training import TrainingViewer
from snowsplat.viewer.live.viewer import NetworkViewer, Scene

from ...training.test_unit import scaled
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


def test_the_page_does_not_depend_on_the_unit_of_the_scene(tmp_path):
    """Its keys, near plane and limits of distances are absolute, so its unit is not the world's."""
    usual = load_dataset(write_toy_dataset(tmp_path, "colmap-bin", 3, 48, 36, n_points=50))
    starts, images = [], []
    for factor in (1.0, 2.0**-13, 2.0**13):
        dataset = scaled(usual, factor)
        viewer = NetworkViewer(dataset)
        try:
            start = viewer.server.initial_camera
            starts.append(np.concatenate([start.position, start.look_at]))
            with Visitor(viewer.url) as visitor:
                visitor.send_camera()
                wait(lambda on=viewer: [v for v in on.session._visitors.values() if v.pose])
                (seen,) = viewer.session._visitors.values()
                (browser,) = viewer._browsers.values()
                keys = KeyCameras(browser.client, seen, viewer._world_from_page)
                keys.store()
                near = factor * usual.train[0].camera.near
                assert keys.cameras[0].position.tolist() == [0.0, 0.0, -3.0 * (near / NEAR)]
                assert keys.cameras[0].near == near
                box = (-9.0, -9.0, -9.0), (0.0, 9.0, 9.0)
                viewer.session.change(seen, display=replace(seen.display, crop=box))
                request = viewer.session.next_request(0, False)
                gaussians = Gaussians.from_points(dataset.points)
                images.append(viewer._draw(request, gaussians).astype(int))
        finally:
            viewer.close()
    for start, image in zip(starts[1:], images[1:], strict=True):
        np.testing.assert_array_equal(start, starts[0])
        assert images[0].std() > 5
        assert np.abs(image - images[0]).max() <= 1


def test_the_page_of_a_finished_training_says_so(tmp_path):
    """The result stays, without the controls of the training, and further images are served."""
    dataset = load_dataset(write_toy_dataset(tmp_path, "colmap-bin", 3, 48, 36, n_points=50))
    gaussians = Gaussians.from_points(dataset.points)
    viewer = NetworkViewer(dataset, label="a <scene>")
    ended = threading.Event()

    def show() -> None:
        serve = viewer.serve

        def until_ended(*args: Any, **options: Any) -> bool:
            if ended.is_set():
                raise KeyboardInterrupt
            return serve(*args, **options)

        viewer.serve = until_ended
        with suppress(KeyboardInterrupt):
            training.show(9, gaussians)

    thread = threading.Thread(target=show)
    try:
        training = TrainingViewer(viewer, SampledPsnr([], viewer.background))
        training.after_step(8, 9, 0.5, gaussians)
        viewer.session.pause()
        training.end(["Finished: 9 steps", "PSNR <20 dB"])
        panel = training._panel
        wait(lambda: not panel._pause.visible)  # the last control is hidden after the others
        assert "Finished: 9 steps<br>PSNR &lt;20 dB" in panel._status.content
        assert panel._bar.value == 100.0
        assert not viewer.session.paused
        thread.start()
        with Visitor(viewer.url) as visitor:
            visitor.send_camera()
            assert visitor.pictures(20.0, most=1) == 1
        with urllib.request.urlopen(viewer.url, timeout=10) as page:
            assert b"<title>a &lt;scene&gt; - snowsplat</title>" in page.read()
        request = urllib.request.Request(viewer.url, headers={"Accept-Encoding": "gzip"})
        with urllib.request.urlopen(request, timeout=10) as page:
            assert b"<title>a &lt;scene&gt;" in gzip.decompress(page.read())
    finally:
        ended.set()
        thread.join(timeout=20.0)
        viewer.close()
