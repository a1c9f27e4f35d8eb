"""The server of the live page: what it serves, to whom, and its limits for hostile clients."""

import gc
import logging
import os
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from snowsplat.data import Dataset, load_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.live import viewer as live
from snowsplat.viewer.live.viewer import NetworkViewer

from ...waiting import wait_until
from ..clients import (
    HOSTILE,
    Visitor,
    frame,
    get,
    hostile,
    path,
    pour,
    status,
    upgrade,
    view,
    wrong_messages,
)

PAGE = Path(live.__file__).parent / "page"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    root = tmp_path_factory.mktemp("page") / "dataset"
    return load_dataset(write_toy_dataset(root, "colmap-bin", 3, 48, 36, n_points=50))


@pytest.fixture
def viewer(dataset) -> Iterator[NetworkViewer]:
    viewer = NetworkViewer(dataset, label="a <scene>")
    viewer.session.training = True  # the server's time is limited
    yield viewer
    viewer.close()


def megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def test_what_is_served(viewer):
    page = get(viewer.url)
    assert status(page) == 200
    assert b"<title>a &lt;scene&gt; - snowsplat</title>" in page
    assert b"frame-ancestors 'self'" in page.partition(b"\r\n\r\n")[0]
    names = {file.name for file in PAGE.iterdir()} | {"theme.css"}
    assert {"index.html", "main.js", "style.css"} < names
    for name in names:
        answer = get(viewer.url, path(viewer.url) + name)
        assert status(answer) == 200, name
        for used in re.findall(r"""(?:from|src=|href=) ?["']([^"':]+)["']""", answer.decode()):
            assert used.removeprefix("./") in names, (name, used)
    for name in ("live", "page", "../viewer.py", "main.js/", "."):
        assert status(get(viewer.url, path(viewer.url) + name)) == 404, name


def test_invalid_messages_are_ignored(viewer, dataset, capfd, caplog):
    """The server prints nothing, stores nothing, and serves the next client."""
    with Visitor(viewer.url) as visitor:
        for message in wrong_messages()[::7]:
            visitor.socket.send(message)
        visitor.socket.send(b"\x00\x01")
        visitor.view(position=[0.0, 1.0, -3.0])
        seen = viewer.session._visitors
        wait_until(lambda: [v for v in seen.values() if v.view and v.view.position[1] == 1.0])
    threads = [
        threading.Thread(target=hostile, args=(kind, viewer.url, 1.0)) for kind in sorted(HOSTILE)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    wait_until(lambda: not viewer.session.visitors)
    assert not viewer._browsers
    with Visitor(viewer.url) as visitor:
        visitor.view()
        wait_until(lambda: viewer.serve(Gaussians.from_points(dataset.points), 0, training=False))
        assert visitor.pictures(20.0, most=1) == 1
    assert capfd.readouterr() == ("", "")
    gc.collect()  # asyncio then reports exceptions that were never retrieved
    time.sleep(0.1)
    assert [each for each in caplog.records if each.levelno >= logging.WARNING] == []


def test_hostile_messages_leave_no_memory(viewer):
    hostile("millions of messages", viewer.url, 0.3)
    before = megabytes()
    for kind in ("garbage", "millions of messages"):
        hostile(kind, viewer.url, 0.7)
    assert megabytes() - before < 24


def test_a_client_that_does_not_read_is_not_read_from(viewer):
    """States that are not received replace one another; its messages are not read."""
    with upgrade(viewer.url) as client:
        client.sendall(frame(view()))
        wait_until(lambda: len(viewer._browsers) == 1 and next(iter(viewer._browsers)).visitor.view)
        (browser,) = viewer._browsers
        before = 0.0
        for i in range(60):  # 60 MB if all were kept
            if i == 20:  # what the system and one message take
                before = megabytes()
            viewer.tell({"type": "about", "lines": ["x" * (1 << 20)]})
            time.sleep(0.005)
        time.sleep(0.2)
        assert megabytes() - before < 16
        version = browser.visitor.version
        pour(client, frame(view()), 0.5)
        time.sleep(0.3)
        assert browser.visitor.version - version < 40


def test_answers_that_are_not_received_are_few(viewer):
    with Visitor(viewer.url) as visitor:
        visitor.view()
        for _ in range(300):
            visitor.send("key")
        visitor.wait_for("key")
        visitor.pictures(1.0)
        assert len(visitor.keys) <= 300
        (browser,) = viewer._browsers
        while browser._keys:
            visitor.pictures(0.1)
        viewer.server.call(lambda: [browser.tell_key({}) for _ in range(300)])
        visitor.keys.clear()
        visitor.pictures(0.5)
        assert len(visitor.keys) <= 9


def test_a_browser_cannot_claim_images_that_were_not_sent(viewer, dataset):
    """The number of images on the way stays right, so that few are rendered."""
    gaussians = Gaussians.from_points(dataset.points)
    with upgrade(viewer.url) as client:
        client.sendall(frame(view()))
        wait_until(lambda: viewer.serve(gaussians, 0, training=False))
        (seen,) = viewer.session._visitors.values()
        for number in (10**9, 1, 0, -5, 10**9):
            client.sendall(frame(f'{{"type": "shown", "number": {number}}}'))
        wait_until(lambda: seen.on_the_way == 0)
        client.sendall(frame(view()))
        wait_until(lambda: viewer.serve(gaussians, 0, training=False))
        time.sleep(0.2)
        assert seen.on_the_way == 1


def test_a_photo_that_cannot_be_read_is_named(tmp_path):
    root = write_toy_dataset(tmp_path, "colmap-bin", 3, 48, 36, n_points=50)
    dataset = load_dataset(root)
    (root / "images" / dataset.train[1].name).unlink()
    viewer = NetworkViewer(dataset)
    try:
        with Visitor(viewer.url) as visitor:
            visitor.view(photo=1)
            told = visitor.wait_for("photo")
            assert told["index"] == 1
            assert dataset.train[1].name in told["error"]["en"]
            visitor.view(photo=0)
            wait_until(lambda: [v for v in viewer.session._visitors.values() if v.photo_view])
            for count, thumbnails in ((1, {0}), (10**9, {0, 2})):
                visitor.send("thumbnails", count=count)
                visitor.pictures(0.5)
                assert visitor.thumbnails == thumbnails
    finally:
        viewer.close()
