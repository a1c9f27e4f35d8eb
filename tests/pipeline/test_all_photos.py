"""The last part of `make`: its learning rates, the gains of exposure, and when there is none."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.pipeline import all_photos
from snowsplat.pipeline.all_photos import train_on_all
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.run.training_files import write_beginning, write_scene
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.history import History
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts import transients
from snowsplat.training.parts.exposure import Exposure
from snowsplat.training.parts.transients import KnownTransients
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.settings.schedule import Schedule

CONFIG = recipe("default", iterations=200, init="points", max_gaussians=300, exposure="on")


@pytest.fixture
def trained(tmp_path) -> TrainingFolder:
    """A folder as after 200 steps, with the points of the dataset as its scene."""
    root = write_toy_dataset(tmp_path / "data", "colmap-bin", 9, 48, 36, n_points=300)
    dataset = load_dataset(root, hold_out=4)
    folder = TrainingFolder(tmp_path / "out")
    write_beginning(folder, dataset, DatasetSettings(str(root), hold_out=4), CONFIG)
    write_scene(folder, 200, Gaussians.from_points(dataset.points))
    left_out = {"left_out": [dataset.train[0].name]}
    (folder.path / "metrics.json").write_text(json.dumps(left_out), encoding="utf-8")
    history = History()
    for step in range(1, 201):
        history.step_ends(step, 0.1, 300)
    history.write(folder.history)
    names = [view.name for view in dataset.train]
    exposures = {name: [0.1 * i, 0.0, -0.1] for i, name in enumerate(names)}
    folder.write_files({"exposure.json": {"unit": "EV", "photos": exposures}})
    return folder


def test_it_continues_where_the_training_has_ended(trained, monkeypatch):
    """Rates fall to those of the end, no Gaussian is added, photos left out remain so, and known
    exposures are kept."""
    trainers = []

    def remember(*arguments, **options):
        trainers.append(Trainer(*arguments, **options))
        trainers[-1].before = trainers[-1].part(Exposure).ev.clone()
        trainers[-1].run = lambda on_progress: None
        return trainers[-1]

    ended = Trainer(load_dataset(trained.settings()[0].path, hold_out=4), CONFIG)
    monkeypatch.setattr(all_photos, "Trainer", remember)
    part, scene = train_on_all(trained, 200, math.inf, Compute("cpu", 1), SILENT)
    (trainer,) = trainers
    assert scene is not None
    assert (part.steps, part.photos, part.left_out, part.why_not) == (24, 8, 1, None)
    names = [view.name for view in trainer.dataset.train]
    assert sorted(names) == sorted(
        view.name for view in (*ended.dataset.train[1:], *ended.dataset.test)
    )
    end, last = ended.optimizer.rates_at(200), trainer.optimizer.rates_at(24)
    assert last == pytest.approx(end)
    first = trainer.optimizer.rates.at(0, Schedule(24), trainer.dataset.extent)
    assert first == pytest.approx({name: 6.0 * rate for name, rate in end.items()})
    known = trained.exposures()
    exposure = trainer.part(Exposure)
    for i, name in enumerate(names):
        if name in known:
            assert exposure.ev[i].tolist() == pytest.approx(known[name], abs=1e-5)
    others = [i for i, name in enumerate(names) if name not in known]
    moved = exposure.ev - trainer.before
    kept = [i for i in range(len(names)) if i not in others]
    assert torch.allclose(moved[others], moved[kept].mean(0).expand(len(others), 3), atol=1e-5)


def test_the_mean_of_the_exposures_stays_where_it_is(trained):
    dataset = load_dataset(trained.settings()[0].path)
    trainer = Trainer(dataset, replace(CONFIG, iterations=3))
    exposure = trainer.part(Exposure)
    exposure.continue_with(torch.full((6, 3), 0.5))
    before = exposure.ev.mean(0)
    assert before.abs().min() > 0.1
    trainer.run()
    assert torch.allclose(exposure.ev.mean(0), before, atol=1e-5)


def test_it_tells_its_time_left(trained):
    clock, left = Observer(), []
    clock.step = lambda progress: left.append(progress.seconds_left)
    train_on_all(trained, 200, math.inf, Compute("cpu", 1), clock)
    assert len(left) == 24
    assert left[0] > 0.0
    assert min(left) >= 0.0


def test_when_there_is_no_last_part(trained):
    compute = Compute("cpu", 1)
    assert "less than twice" in str(train_on_all(trained, 200, 1e-9, compute, SILENT)[0].why_not)


def test_what_moves_is_masked_in_all_photos(trained, monkeypatch):
    """Also in the held-out ones. Something is found in the first and in the last photo."""
    found = []

    def moving(maps, before, mode):
        cells = [torch.zeros_like(each.usable) for each in maps]
        cells[0][1, 2] = cells[-1][2, 3] = True
        found.append((len(maps), mode))
        return cells

    trainers = []

    def remember(*arguments, **options):
        trainers.append(Trainer(*arguments, **options))
        trainers[-1].run = lambda on_progress: None
        return trainers[-1]

    monkeypatch.setattr(transients, "_moving_cells", moving)
    monkeypatch.setattr(all_photos, "Trainer", remember)
    train_on_all(trained, 200, math.inf, Compute("cpu", 1), SILENT)
    assert trainers[0].part(KnownTransients) is None
    Path(trained.path / "masks").mkdir()
    part, _ = train_on_all(trained, 200, math.inf, Compute("cpu", 1), SILENT)
    assert (part.photos, found) == (8, [(8, "on")])
    photo = LoadedImage(torch.zeros(3, 36, 48, dtype=torch.uint8))
    known = trainers[1].part(KnownTransients)
    masks = [known.target(trainers[1], SimpleNamespace(index=i), photo).mask for i in range(8)]
    expected = torch.ones(36, 48, dtype=torch.bool)
    expected[9:18, 16:24] = False
    assert torch.equal(masks[0], expected)
    assert masks[7] is not None
    assert masks[1:7] == [None] * 6
