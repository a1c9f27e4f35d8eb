"""`watch` and a training without a page: opening one, steering, leaving, and what a kill leaves."""

import os
import socket
import stat
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run import live_page
from snowsplat.pipeline.run.live_page import FOLDER, LivePage, socket_in
from snowsplat.pipeline.train import train
from snowsplat.pipeline.watch import watch

from ..viewer.clients import Visitor

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no local sockets")

OPTIONS = TrainOptions(settings={"iterations": 30, "initial_points": 300, "init": "points"})


def status_of(url: str) -> int:
    try:
        with urllib.request.urlopen(url, timeout=20) as page:
            assert b"<html" in page.read()
            return page.status
    except urllib.error.HTTPError as error:
        return error.code


class Watcher(Observer):
    """Watches in another thread: pauses the training on its page, and leaves with Ctrl-C."""

    def __init__(self, out: Path, steps: list[int]) -> None:
        self.steps, self.failure, self.seen = steps, None, []
        self.done = threading.Event()
        self._thread = threading.Thread(target=self._watch, args=(out,), daemon=True)
        self._thread.start()

    def _watch(self, out: Path) -> None:
        try:
            watch(out, LivePage(), observer=self)
        except BaseException as error:
            self.failure = error
        finally:
            self.done.set()

    def page_opened(self, page) -> None:
        self.seen = [status_of(page.url), status_of(page.url[: page.url[:-1].rindex("/")])]
        with Visitor(page.url) as visitor:
            visitor.view()
            visitor.pictures(20.0, most=1)
            visitor.send("training", do="pause")
            before = -1
            while before != self.steps[-1]:
                before = self.steps[-1]
                time.sleep(0.3)
            self.seen.append(self.steps[-1])
        self.url = page.url
        raise KeyboardInterrupt


class Watched(Observer):
    """Starts a watcher after step 5, and waits a little in each step until it has left."""

    kind: type[Watcher] = Watcher

    def __init__(self, out: Path) -> None:
        self.out, self.steps = out, [0]
        self.watcher: Watcher | None = None

    def step(self, progress) -> None:
        self.steps.append(progress.step)
        if progress.step == 5:
            folder = self.out / FOLDER
            self.mode = stat.S_IMODE(folder.stat().st_mode)
            assert stat.S_ISSOCK((folder / "socket").stat().st_mode)
            self.watcher = self.kind(self.out, self.steps)
        if self.watcher is not None:
            self.watcher.done.wait(2.0 if progress.step < 20 else 0.0)


def test_a_watcher_steers_a_training_without_a_page(dataset, tmp_path):
    out = tmp_path / ("a long name " * 9) / ("of a folder " * 9) / "out"  # too long for a socket
    seen = Watched(out)
    train(dataset, out, OPTIONS, observer=seen)
    assert seen.mode == 0o700
    assert seen.watcher is not None
    assert seen.watcher.done.wait(30)
    assert seen.watcher.failure is None
    first, without_token, paused = seen.watcher.seen
    assert (first, without_token) == (200, 404)
    assert 5 <= paused < 30
    assert seen.steps[-1] == 30  # it resumed when the watcher left
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(seen.watcher.url, timeout=20)
    assert not (out / FOLDER).exists()
    plain = tmp_path / "plain"
    train(dataset, plain, OPTIONS)
    name = "point_cloud/iteration_30/point_cloud.ply"
    assert (out / name).read_bytes() == (plain / name).read_bytes()


class Looks(Watcher):
    """Leaves at once, without steering."""

    def page_opened(self, page) -> None:
        self.url = page.url
        raise KeyboardInterrupt


def test_a_training_with_a_page_shows_it_and_keeps_it(dataset, tmp_path):
    class Starts(Watched):
        kind = Looks

    seen = Starts(tmp_path / "out")
    with LivePage() as page:
        train(dataset, tmp_path / "out", OPTIONS, observer=seen, page=page)
        assert seen.watcher is not None
        assert seen.watcher.done.wait(30)
        assert seen.watcher.failure is None
        assert seen.watcher.url == page.url
        assert status_of(page.url) == 200


class Shown(Exception):
    """The page of the folder was opened."""


class FolderOnly(Observer):
    def page_opened(self, page) -> None:
        raise Shown


def test_the_socket_of_a_killed_training_is_harmless(dataset, tmp_path):
    out = tmp_path / "out"
    train(dataset, out, OPTIONS)
    with socket_in(out, create=True) as path, socket.socket(socket.AF_UNIX) as stale:
        stale.bind(path)
    assert (out / FOLDER / "socket").exists()
    with LivePage() as page, pytest.raises(Shown):
        watch(out, page, observer=FolderOnly())
    train(dataset, out, OPTIONS, overwrite=True)
    assert not (out / FOLDER).exists()


@pytest.mark.parametrize("files", [None, "/nowhere"], ids=["Linux", "without /proc"])
@pytest.mark.parametrize("name", ["out", "a very long name " * 9, "图像" * 30])
def test_the_name_of_the_folder_may_be_long(tmp_path, monkeypatch, files, name):
    """A path of a socket has at most 107 bytes here, and 103 on macOS."""
    if files is not None:
        monkeypatch.setattr(live_page, "_OPEN_FILES", files)
    out = tmp_path / name
    out.mkdir()
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as watcher:
        with socket_in(out, create=True) as path:
            listener.bind(path)
            listener.listen()
        assert (out / FOLDER / "socket").is_socket()
        with socket_in(out) as path:
            watcher.connect(path)


def test_a_folder_of_others_is_not_used(tmp_path):
    (tmp_path / FOLDER).mkdir()
    os.chmod(tmp_path / FOLDER, 0o755)
    with pytest.raises(PermissionError), socket_in(tmp_path):
        pass
