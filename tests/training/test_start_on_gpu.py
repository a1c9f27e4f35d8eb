"""The start of a training on a GPU, which is pretended: no devices are mixed, and the scene is that
of the CPU.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data.dataset import Dataset
from snowsplat.data.photos import image_loader
from snowsplat.data.photos.decode import ImageSource, load_views
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.ops.native import LAUNCHERS
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.limits import NearLimit
from snowsplat.training.parts.part import REMOVED
from snowsplat.training.parts.sky import INTERVAL, SkyPart
from snowsplat.training.parts.transients import Transients
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.starts.init import initial_gaussians
from snowsplat.util.native_layout import Fields

from ..pretended_gpu import pretended_gpu
from . import sphere, test_sky


@pytest.fixture(scope="module")
def outdoors(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Photos of 49×49, which no factor divides."""
    found = test_sky.dataset(tmp_path_factory.mktemp("outdoors"), size=49)
    return replace(found, train=found.train[:12])


def config() -> TrainConfig:
    return recipe("default", iterations=1000, exposure="on", batch=2, test_iterations=())


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> Counter[Path]:
    """How often each photo was decoded."""
    found: Counter[Path] = Counter()

    def counting(sources, background=None):
        found[sources[0][0].path] += 1
        return load_views(sources, background)

    monkeypatch.setattr(image_loader, "load_views", counting)
    return found


def test_the_first_scene_and_the_masks_are_those_of_the_cpu(
    outdoors: Dataset, decoded: Counter[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pretended GPU has the kernels of the CPU, so all bits are the same."""
    expected = Trainer(outdoors, config())
    expected.part(Transients)._compute(expected)
    with pretended_gpu(monkeypatch) as device:
        launched: list[str] = []
        launch = LAUNCHERS["cuda"]

        def counting(name: str, fields: Fields) -> int:
            launched.append(name)
            return launch(name, fields)

        monkeypatch.setitem(LAUNCHERS, "cuda", counting)
        decoded.clear()
        found = Trainer(outdoors, config(), device=device)
        assert {"plane_sweep", "neighbours"} <= {*launched}
        found.part(Transients)._compute(found)
        assert decoded == {view.image.path: 1 for view in outdoors.train}
        for run in (expected, found):
            run.step = INTERVAL
            run.gaussians.means.mul_(0.2)
            for part in (SkyPart, NearLimit):
                run.part(part).between(run)
        parameters = {name: each.cpu() for name, each in found.gaussians.parameters().items()}
    for name, each in expected.gaussians.parameters().items():
        assert torch.equal(parameters[name], each), name
    assert (parameters["opacity_logits"] == REMOVED).any()
    for one, other in zip(
        found.part(Transients).masks, expected.part(Transients).masks, strict=True
    ):
        assert torch.equal(one, other)


@pytest.mark.parametrize("start", ["depth", "random", "sweep"])
def test_other_starts_and_masks(
    tmp_path: Path, start: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = sphere.dataset(tmp_path)
    levels = np.full((sphere.SIZE, sphere.SIZE), 255, np.uint8)
    levels[: sphere.SIZE // 3] = 0
    Image.fromarray(levels).save(tmp_path / "mask.png")
    mask = ImageSource(tmp_path / "mask.png", sphere.SIZE, sphere.SIZE)
    data = replace(data, train=[replace(view, mask=mask) for view in data.train])
    settings = replace(TrainConfig(), init=start, initial_points=300)

    def first(device: torch.device) -> Tensor:
        with ImageLoader(data.train, device=device) as images:
            generator = torch.Generator().manual_seed(0)
            return initial_gaussians(data, settings, images, generator, device).means.cpu()

    expected = first(torch.device("cpu"))
    with pretended_gpu(monkeypatch) as device:
        found = first(device)
    assert torch.equal(found, expected)
