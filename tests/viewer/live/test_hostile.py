"""Training with hostile clients: it continues, with a bit-identical result."""

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import torch

from snowsplat import ops
from snowsplat.data import Dataset, load_dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.config import TrainConfig
from snowsplat.viewer.live.training import SampledPsnr, TrainingViewer
from snowsplat.viewer.live.viewer import NetworkViewer

from .. import clients
from ..clients import Visitor

pytestmark = pytest.mark.slow

STEPS = 1_000_000


class Watched:
    """A training run with a page; the test makes its steps."""

    def __init__(self, dataset: Dataset) -> None:
        self.trainer = Trainer(dataset, TrainConfig(iterations=STEPS))
        self.viewer = NetworkViewer(dataset)
        sampled_psnr = SampledPsnr(dataset.train, self.viewer.background)
        self._training = TrainingViewer(self.viewer, sampled_psnr)

    def step(self) -> None:
        loss = self.trainer.step_once()
        self._training.after_step(self.trainer.step, STEPS, loss, self.trainer.gaussians)

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
    """The scene is the same as without clients."""
    for kinds in (
        {"half_open": 10, "strangers": 4},  # of the first, a thousand connections
        {
            "comers": 3,
            "garbage": 2,
            "millions_of_messages": 2,
            "random_messages": 2,
            "never_reads": 6,
            "keys": 2,
        },
    ):
        process = attack(watched.viewer.url, 600.0, **kinds)
        for _ in range(150):
            watched.step()
        process.kill()
        process.wait()
    plain = Trainer(dataset, TrainConfig(iterations=STEPS))
    while plain.step < watched.trainer.step:
        plain.step_once()
    ours, theirs = plain.state_tensors(), watched.trainer.state_tensors()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert capfd.readouterr() == ("", "")


def test_an_image_that_cannot_be_rendered_does_not_end_the_training(watched):
    with Visitor(watched.viewer.url) as visitor:
        visitor.view()
        session = watched.viewer.session
        while not session._visitors:
            watched.step()
        (seen,) = session._visitors.values()
        while seen.view is None:
            watched.step()
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


def test_few_images_are_rendered_while_none_is_sent(watched, monkeypatch):
    """If the server's thread is blocked, images do not accumulate in memory."""
    drawn = []
    draw = watched.viewer._draw
    monkeypatch.setattr(watched.viewer, "_draw", lambda *what: drawn.append(1) or draw(*what))
    with Visitor(watched.viewer.url) as visitor:
        visitor.view()
        while not drawn:
            watched.step()
        (seen,) = watched.viewer.session._visitors.values()
        watched.viewer.server.call(time.sleep, 1.0)
        first, end = len(drawn), time.monotonic() + 0.8
        while time.monotonic() < end:
            watched.viewer.session.move(seen, seen.view)
            watched.step()
        assert len(drawn) - first <= 3
