"""The page's server with a client that sends poses as a browser does."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data import Dataset, load_dataset
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.messages import Message, message
from snowsplat.viewer.live.training import SampledPsnr, TrainingViewer
from snowsplat.viewer.live.viewer import NetworkViewer, Scene

from ...training.test_unit import scaled
from ...waiting import wait_until
from ..clients import Visitor, frame, upgrade, view

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("viewer")
    return load_dataset(write_toy_dataset(folder, "colmap-bin", 3, 48, 36, n_points=50))


@pytest.fixture
def gaussians(dataset) -> Gaussians:
    return Gaussians.from_points(dataset.points)


@pytest.fixture
def viewer(dataset) -> Iterator[NetworkViewer]:
    viewer = NetworkViewer(dataset, label="a <scene>")
    yield viewer
    viewer.close()


def test_a_newer_scene_replaces_the_one_shown(viewer, gaussians):
    """`snowsplat watch` shows each new checkpoint, which may have another number of Gaussians."""
    few = gaussians.select(torch.arange(30))
    saved, shown = [Scene(few, 1, [Message("30")])], []
    ended = threading.Event()

    def newest() -> Scene:
        if ended.is_set():
            raise KeyboardInterrupt
        shown.append(saved[-1].number)
        return saved[-1]

    def show() -> None:
        with suppress(KeyboardInterrupt):
            viewer.show_newest(newest)

    thread = threading.Thread(target=show)
    thread.start()
    try:
        with Visitor(viewer.url) as visitor:
            wait_until(lambda: 1 in shown)
            visitor.view()
            assert visitor.pictures(20.0, most=1) == 1
            assert visitor.wait_for("about")["lines"] == [{"en": "30", "zh": "30"}]
            saved.append(Scene(gaussians, 2, [Message("50")]))
            wait_until(lambda: shown.count(2) >= 2)
            visitor.view(position=[0.0, 0.5, -3.0])
            assert visitor.pictures(20.0, most=1) == 1
    finally:
        ended.set()
        thread.join(timeout=20.0)
    assert not thread.is_alive()


def test_a_browser_that_receives_slowly_gets_the_newest_images(viewer, gaussians):
    """An image that the browser does not acknowledge has not arrived, and only a few are sent."""

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

    with upgrade(viewer.url) as silent:
        assert images(lambda x: silent.sendall(frame(view(position=[x, 0.0, -3.0]))), 12) == 3
        (seen,) = viewer.session._visitors.values()
        assert seen.on_the_way == 3
    wait_until(lambda: not viewer.session.visitors)
    with Visitor(viewer.url) as visitor:

        def move(x: float) -> None:
            visitor.view(position=[x, 0.0, -3.0])
            visitor.pictures(0.02)

        assert images(move, 12) >= 9
        (seen,) = viewer.session._visitors.values()
        visitor.pictures(0.5)
        wait_until(lambda: seen.on_the_way == 0)


def test_the_page_does_not_depend_on_the_unit_of_the_scene(dataset, tmp_path):
    images, scenes = [], []
    for factor in (1.0, 2.0**-13, 2.0**13):
        other = scaled(dataset, factor)
        viewer = NetworkViewer(other)
        try:
            with Visitor(viewer.url) as visitor:
                scene = visitor.wait_for("scene")
                lengths = np.array([*scene["focus"], scene["length"], scene["extent"]])
                scenes.append(lengths / factor)
                visitor.view(position=[0.0, 0.0, -3.0 * factor])
                box = [[-9.0 * factor] * 3, [0.0, 9.0 * factor, 9.0 * factor]]
                visitor.display(crop=box)
                (seen,) = viewer.session._visitors.values()
                wait_until(lambda seen=seen: seen.view and seen.display.crop)
                visitor.send("key")
                visitor.wait_for("key")
                (tmp_path / "cameras.json").write_text(json.dumps(visitor.keys))
                (camera,) = read_cameras(tmp_path / "cameras.json")[1]
                assert camera.position.tolist() == [0.0, 0.0, -3.0 * factor]
                assert camera.near == dataset.train[0].camera.near * factor
                request = viewer.session.next_request(0, False)
                gaussians = Gaussians.from_points(other.points)
                images.append(viewer._draw(request, gaussians).astype(int))
        finally:
            viewer.close()
    for lengths, image in zip(scenes[1:], images[1:], strict=True):
        np.testing.assert_allclose(lengths, scenes[0], rtol=1e-5)
        assert images[0].std() > 5
        assert np.abs(image - images[0]).max() <= 1


def test_an_image_has_the_number_of_its_view(viewer, gaussians, dataset):
    """So that the page draws the cameras of the photos where they are in the image."""
    with Visitor(viewer.url) as visitor:
        for number in (5, 6):
            visitor.view(number=number, position=[0.0, 0.1 * number, -3.0])
            wait_until(lambda: viewer.serve(gaussians, 0, training=False))
            assert visitor.pictures(20.0, most=1) == 1
            assert visitor.view_shown == number
            assert max(visitor.newest.size) <= 320
        visitor.view(number=7, photo=1)
        wait_until(lambda: [v for v in viewer.session._visitors.values() if v.photo_view])
        visitor.display(wipe=1.0)
        visitor.pictures(0.3)
        wait_until(lambda: viewer.serve(gaussians, 0, training=False))
        visitor.pictures(0.5)
        shown = np.asarray(visitor.newest.resize((48, 36)), np.float64)
        photo = np.asarray(Image.open(dataset.train[1].image.path), np.float64)
        assert np.abs(shown - photo).mean() < 12.0


def test_the_page_of_a_finished_training_says_so(viewer, gaussians):
    """The result stays, without the controls of the training, and further images are served."""
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
        training.end([message("{gaussians:,} Gaussians", gaussians=9), Message("PSNR <20 dB")])
        assert not viewer.session.paused
        thread.start()
        with Visitor(viewer.url) as visitor:
            finished = visitor.wait_for("training")
            first, second = finished["finished"]
            assert first["en"] == "9 Gaussians"
            assert first["zh"] != first["en"]
            assert second["en"] == second["zh"] == "PSNR <20 dB"
            assert not finished["paused"]
            assert visitor.wait_for("curves")["loss"] == [[8.0], [0.5]]
            visitor.view()
            assert visitor.pictures(20.0, most=1) == 1
    finally:
        ended.set()
        thread.join(timeout=20.0)
