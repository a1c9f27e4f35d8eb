"""Training with hostile clients: it continues, nearly as fast, with a bit-identical result."""

import dataclasses
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from viser.infra._async_message_buffer import AsyncMessageBuffer

from snowsplat import ops
from snowsplat.data import Dataset, load_dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.config import TrainConfig
from snowsplat.viewer.live import guard
from snowsplat.viewer.live.curves import SampledPsnr
from snowsplat.viewer.live.guard import call_in_server_thread
from snowsplat.viewer.live.training import TrainingViewer
from snowsplat.viewer.live.viewer import NetworkViewer

from .. import clients
from ..clients import Visitor, camera, status

pytestmark = pytest.mark.slow

TICKS = os.sysconf("SC_CLK_TCK")
STEPS = 1_000_000


class Watched:
    """A training run with a page; the test makes its steps."""

    def __init__(self, dataset: Dataset) -> None:
        self.trainer = Trainer(dataset, TrainConfig(iterations=STEPS))
        self.viewer = NetworkViewer(dataset)
        sampled_psnr = SampledPsnr(dataset.train, self.viewer.background)
        self._training = TrainingViewer(self.viewer, sampled_psnr)
        thread = self.viewer.server._websock_server._server_thread
        self._stat = Path(f"/proc/self/task/{thread.native_id}/stat")

    def step(self) -> None:
        loss = self.trainer.step_once()
        self._training.after_step(self.trainer.step, STEPS, loss, self.trainer.gaussians)

    def run(self, seconds: float) -> float:
        """Make steps for this time; returns the steps per second.

        Half of the time is idle: each step is repeated later without clients, and an idle thread
        does not limit the server's share.
        """
        began, first = time.monotonic(), self.trainer.step
        while time.monotonic() - began < seconds:
            step_began = time.monotonic()
            self.step()
            time.sleep(time.monotonic() - step_began)
        return (self.trainer.step - first) / (time.monotonic() - began)

    def server_seconds(self) -> float:
        """Processor time of the server's thread."""
        fields = self._stat.read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def close(self) -> None:
        self.viewer.close()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    root = tmp_path_factory.mktemp("hostile") / "dataset"
    return load_dataset(write_toy_dataset(root, "colmap-bin", 9, 96, 72, n_points=1000))


@pytest.fixture
def watched(dataset) -> Iterator[Watched]:
    threads = ops.get_num_threads()
    ops.set_num_threads(1)
    watched = Watched(dataset)
    yield watched
    watched.close()
    ops.set_num_threads(threads)


def _politely() -> None:
    os.nice(5)


def attack(url: str, seconds: float, **kinds: int) -> subprocess.Popen[str]:
    """Start hostile clients in another process, at low priority."""
    words = [f"{kind.replace('_', ' ')}={count}" for kind, count in kinds.items()]
    command = [sys.executable, clients.__file__, url, str(seconds), *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=_politely)
    assert process.stdout.readline() == "begun\n"
    return process


def test_the_training_continues_bit_identically(watched, dataset, capfd):
    """The server's thread uses at most its share; the scene is the same as without clients."""
    watched.run(0.5)
    seconds = 3.0
    for kinds in (
        {"half_open": 10, "strangers": 4},  # of the first, a thousand connections
        {"comers": 3, "garbage": 2, "millions_of_messages": 2, "pings": 2, "never_reads": 8},
    ):
        process = attack(watched.viewer.url, seconds + 1.0, **kinds)
        before = watched.server_seconds()
        began = time.monotonic()
        rate = watched.run(seconds)
        share = (watched.server_seconds() - before) / (time.monotonic() - began)
        assert share < guard._SHARE + 0.15
        assert rate > 0
        process.kill()
        process.wait()
    plain = Trainer(dataset, TrainConfig(iterations=STEPS))
    while plain.step < watched.trainer.step:
        plain.step_once()
    ours, theirs = plain.state_tensors(), watched.trainer.state_tensors()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert capfd.readouterr() == ("", "")


def test_viser_is_only_used_in_its_own_thread(watched, monkeypatch):
    """Its buffers are not thread-safe: a connecting browser could end a training run."""
    threads = set()
    push = AsyncMessageBuffer.push

    def noting(buffer: AsyncMessageBuffer, message: object) -> None:
        threads.add(threading.current_thread().name)
        push(buffer, message)

    monkeypatch.setattr(AsyncMessageBuffer, "push", noting)
    with Visitor(watched.viewer.url) as visitor:
        visitor.send_camera()
        while len(visitor.controls) < 20 or not visitor.shown:
            watched.step()
            visitor.pictures(0.05)
        for label, value in (("Show", "Depth"), ("Cameras", True), ("Go to", "Next")):
            visitor.press(label, value)
        visitor.press("Store this view")
        end = time.monotonic() + 2.5
        while time.monotonic() < end:
            watched.step()
    assert threads == {watched.viewer.server._websock_server._server_thread.name}


def test_invalid_control_values_are_limited(watched):
    """Browsers may send values outside of the range of a slider or list."""
    with Visitor(watched.viewer.url) as visitor:
        visitor.send_camera()
        while len(visitor.controls) < 20:
            watched.step()
            visitor.pictures(0.05)
        (seen,) = watched.viewer.session._visitors.values()
        for label, value in (
            *(("Image size", 10**9), ("Image size", -5), ("SH degree", 99), ("SH degree", -3)),
            *(("Gaussian size", -1e300), ("Gaussian size", 1e300), ("Show", "Nonsense")),
            *(("Photo (%)", 1e300), ("Viewing time (%)", 1e9), ("Viewing time (%)", -1e9)),
            *(("Crop", True), ("x (right)", []), ("x (right)", [1e300, -1e300]), ("Go to", "x")),
            *(("x (right)", [1.0] * 16), ("Show only", "x"), ("Store this view", None)),
        ):
            visitor.press(label, value)
            end = time.monotonic() + 0.1
            while time.monotonic() < end:
                watched.step()
            display = seen.display
            assert 0 <= display.sh_degree <= 3, label
            assert 0.02 <= display.scale <= 1.0, label
            assert 0.0 <= display.wipe <= 1.0, label
            assert 320 <= seen.longest <= 2560, label
            assert 0.05 <= watched.viewer.session.share <= 0.95, label
            assert display.mode == "color"
        for pose in (
            {"wxyz": [0.0] * 4},
            {"wxyz": [1e300] * 4},
            {"position": [1e300] * 3},
            {"fov": -1.0},
            {"fov": 1e300},
            {"image_width": 16384, "image_height": 1},
        ):
            visitor.socket.send(camera(**pose))
            for _ in range(5):
                watched.step()
        visitor.press("Crop", False)
        visitor.send_camera(position=[0.0, 0.5, -3.0])
        shown = visitor.shown
        end = time.monotonic() + 20
        while visitor.shown == shown:
            assert time.monotonic() < end
            watched.step()
            visitor.pictures(0.02)


def test_an_image_that_cannot_be_rendered_does_not_end_the_training(watched):
    with Visitor(watched.viewer.url) as visitor:
        visitor.send_camera()
        session = watched.viewer.session
        while not session._visitors:
            watched.step()
        (seen,) = session._visitors.values()
        session.change(seen, display=dataclasses.replace(seen.display, crop=((0.0,), (1.0, 2.0))))
        time.sleep(0.3)  # it is still
        for _ in range(20):
            watched.step()
        assert seen.shown_version == seen.version  # it is not repeated
        session.change(seen, display=dataclasses.replace(seen.display, crop=None))
        shown = visitor.shown
        end = time.monotonic() + 20
        while visitor.shown == shown:
            assert time.monotonic() < end
            watched.step()
            visitor.pictures(0.02)


def test_stored_views_and_downloads_are_limited(watched):
    with Visitor(watched.viewer.url) as visitor:
        visitor.send_camera()
        while "Store this view" not in visitor.controls:
            watched.step()
            visitor.pictures(0.05)
        for _ in range(600):
            visitor.press("Store this view")
        for _ in range(200):
            visitor.press("Download the views")
        end = time.monotonic() + 3
        taken = 0
        while time.monotonic() < end:
            watched.step()
            try:
                taken += len(visitor.socket.recv(timeout=0.01))
            except TimeoutError:
                continue
        assert taken < 5_000_000
        assert status(clients.get(watched.viewer.url)) == 200


def test_few_images_are_rendered_while_none_is_sent(watched, monkeypatch):
    """If the server's thread is blocked, images do not accumulate in memory."""
    drawn = []
    draw = watched.viewer._draw
    monkeypatch.setattr(watched.viewer, "_draw", lambda *what: drawn.append(1) or draw(*what))
    with Visitor(watched.viewer.url) as visitor:
        visitor.send_camera()
        while not drawn:
            watched.step()
        (seen,) = watched.viewer.session._visitors.values()
        call_in_server_thread(watched.viewer.server, lambda: time.sleep(1.0))
        first, end = len(drawn), time.monotonic() + 0.8
        while time.monotonic() < end:
            watched.viewer.session.move(seen, seen.pose)
            watched.step()
        assert len(drawn) - first <= 3
