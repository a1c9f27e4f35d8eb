"""The parts of a job that take long with a large scene are told to the observer."""

from pathlib import Path

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.extras.globe.make_globe import make_globe
from snowsplat.formats import write_gaussians
from snowsplat.pipeline.convert import convert
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.scene import Edits
from snowsplat.pipeline.publish import publish, viewed_scene


class Waits(Observer):
    """Records the stages, and the counts of each."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.open = False
        self.counts: dict[str, list[tuple[int, int]]] = {}

    def begin(self, stage):
        self.stages.append(stage)
        self.open = True
        return lambda done, total, what="", left=None: self.counts.setdefault(what, []).append(
            (done, total)
        )

    def leave(self) -> None:
        self.open = False


@pytest.fixture
def scene(tmp_path) -> Path:
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(box, 300, torch.Generator().manual_seed(0), 1)
    write_gaussians(tmp_path / "box.ply", gaussians)
    return tmp_path / "box.ply"


def test_stages_of_commands_for_scenes(scene, tmp_path):
    def look(observer: Observer) -> None:
        with viewed_scene(scene, observer=observer):
            pass

    small, half = tmp_path / "small.spz", Edits(decimate="50%")
    for job, stages in (
        (lambda seen: convert(scene, small, half, observer=seen), "reading merging writing"),
        (lambda seen: publish(scene, tmp_path / "site", observer=seen), "reading writing"),
        (look, "reading preparing"),
        (lambda seen: make_globe(scene, tmp_path / "globe.html", observer=seen), "reading arrang"),
    ):
        seen = Waits()
        job(seen)
        assert " ".join(seen.stages).startswith(stages)
        assert not seen.open
