"""The logs of steps: CSV and TensorBoard, also of an interrupted training."""

import csv
import sys
from pathlib import Path

import pytest

from snowsplat.pipeline.observer import COLUMNS, LOGS, CsvLog, Observer, Observers
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.results import TrainingStopped
from snowsplat.pipeline.train import resume, train
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.util.errors import UserError

SETTINGS = {"iterations": 12, "initial_points": 200, "init": "points", "checkpoint_every": 5}
OPTIONS = TrainOptions(hold_out=6, settings=SETTINGS | {"test_iterations": (4,)})


class StopAfter(Observer):
    """Ctrl-C after a step."""

    def __init__(self, step: int) -> None:
        self._step = step

    def step(self, progress) -> None:
        if progress.step == self._step:
            raise KeyboardInterrupt


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def test_csv_has_a_row_for_each_step_also_after_a_resume(dataset, tmp_path):
    whole, out = tmp_path / "whole", tmp_path / "out"
    train(dataset, whole, OPTIONS, observer=LOGS["csv"](TrainingFolder(whole)))
    log = LOGS["csv"](TrainingFolder(out))
    with pytest.raises(TrainingStopped):
        train(dataset, out, OPTIONS, observer=Observers(log, StopAfter(8)))
    assert [row["step"] for row in rows_of(out / "log.csv")] == [str(i) for i in range(1, 9)]
    with (out / "log.csv").open("a") as file:  # steps after the checkpoint of a killed training
        file.write("9,0.5,200,1.0,,,\nnonsense\n")
    result = resume(out, observer=CsvLog(out / "log.csv"))
    one, two = rows_of(whole / "log.csv"), rows_of(out / "log.csv")
    assert tuple(one[0]) == COLUMNS
    assert [row["step"] for row in one] == [*map(str, range(1, 13)), "12"]
    assert [{**row, "seconds": ""} for row in one] == [{**row, "seconds": ""} for row in two]
    seconds = [float(row["seconds"]) for row in two]
    assert seconds == sorted(seconds)
    assert [bool(row["psnr"]) for row in two] == [i in (4, 13) for i in range(1, 14)]
    assert float(two[-1]["psnr"]) == result.evaluation[1].psnr
    train(dataset, out, OPTIONS, overwrite=True)
    assert not (out / "log.csv").exists()  # that of the training that was replaced


def test_a_training_without_a_step_leaves_nothing(dataset, tmp_path):
    class Never(Observer):
        def steps_begin(self, step, iterations) -> None:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        train(dataset, out, OPTIONS, observer=Observers(LOGS["csv"](TrainingFolder(out)), Never()))
    assert not out.exists()


def test_a_missing_tensorboard_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(UserError, match=r"pip install .snowsplat\[tensorboard\]"):
        LOGS["tensorboard"](TrainingFolder(tmp_path))


def test_tensorboard_gets_the_same_figures(dataset, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    out = tmp_path / "out"
    logs = Observers(LOGS["csv"](TrainingFolder(out)), LOGS["tensorboard"](TrainingFolder(out)))
    with pytest.raises(TrainingStopped):
        train(dataset, out, OPTIONS, observer=Observers(logs, StopAfter(8)))
    resume(
        out,
        observer=Observers(
            LOGS["csv"](TrainingFolder(out)), LOGS["tensorboard"](TrainingFolder(out))
        ),
    )
    events = EventAccumulator(str(out / "tensorboard"))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    rows = [row for row in rows_of(out / "log.csv") if row["loss"]]
    assert losses == [(int(row["step"]), pytest.approx(float(row["loss"]))) for row in rows]
    assert [event.step for event in events.Scalars("psnr")] == [4, 12]
