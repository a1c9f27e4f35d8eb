"""The start of a training on a GPU: the devices of all tensors, and the same scene as on the CPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from snowsplat.data.dataset import Dataset
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.recipes import recipe

from ..pretended_gpu import pretended_gpu
from . import test_sky


@pytest.fixture(scope="module")
def outdoors(tmp_path_factory) -> Dataset:
    found = test_sky.dataset(tmp_path_factory.mktemp("outdoors"), size=48)
    return replace(found, train=found.train[:14])


def config() -> TrainConfig:
    return recipe("default", iterations=1000, exposure="on", batch=2, test_iterations=())


@pytest.mark.emulated
def test_the_start(outdoors: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Trainer(outdoors, config())
    with pretended_gpu(monkeypatch) as device:
        trainer = Trainer(outdoors, config(), device=device)
        print(len(expected.gaussians), len(trainer.gaussians))
        from snowsplat.training.parts.transients import Transients
        expected.part(Transients)._compute(expected)
        trainer.part(Transients)._compute(trainer)
