"""`watch` and a training without a page: opening one, steering, leaving, and what a kill leaves."""

import json
import stat
import sys
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client
from pathlib import Path

import pytest

from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.live_page import ADDRESS, LivePage
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
            self.mode = stat.S_IMODE((self.out / ADDRESS).stat().st_mode)
            self.watcher = self.kind(self.out, self.steps)
        if self.watcher is not None:
            self.watcher.done.wait(2.0 if progress.step < 20 else 0.0)


def test_a_watcher_steers_a_training_without_a_page(dataset, tmp_path):
    out = tmp_path / ("a long name " * 9) / ("of a folder " * 9) / "图像"  # too long for a socket
    seen = Watched(out)
    train(dataset, out, OPTIONS, observer=seen)
    assert seen.mode == 0o600
    assert seen.watcher is not None
    assert seen.watcher.done.wait(30)
    assert seen.watcher.failure is None
    first, without_token, paused = seen.watcher.seen
    assert (first, without_token) == (200, 404)
    assert 5 <= paused < 30
    assert seen.steps[-1] == 30  # it resumed when the watcher left
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(seen.watcher.url, timeout=20)
    assert not (out / ADDRESS).exists()
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


def test_what_a_killed_training_leaves_is_harmless(dataset, tmp_path):
    out, short = tmp_path / "out", replace(OPTIONS, settings=OPTIONS.settings | {"iterations": 2})
    train(dataset, out, short)
    for left in ("{}", "damaged", '{"address": "/nowhere/s", "key": "00"}'):
        (out / ADDRESS).write_text(left)
        with LivePage() as page, pytest.raises(Shown):
            watch(out, page, observer=FolderOnly())
    train(dataset, out, short, overwrite=True)
    assert not (out / ADDRESS).exists()


def test_a_watcher_needs_the_key(dataset, tmp_path):
    class Stranger(Observer):
        def step(self, progress) -> None:
            if progress.step == 5:
                place = json.loads((tmp_path / "out" / ADDRESS).read_text())
                with pytest.raises(AuthenticationError):
                    Client(place["address"], authkey=b"another")

    train(dataset, tmp_path / "out", OPTIONS, observer=Stranger())
