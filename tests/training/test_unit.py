"""The unit of a dataset does not matter: scaled by a power of two, it trains to the same scene."""

from dataclasses import replace

import pytest
import torch

from snowsplat.data import Dataset, View, load_dataset
from snowsplat.scene.render import render
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("unit") / "toy"
    return load_dataset(write_toy_dataset(folder, "colmap-bin", 8, 48, 36, n_points=300))


def scaled(dataset: Dataset, factor: float) -> Dataset:
    def view(given: View) -> View:
        camera, factors = given.camera, torch.tensor([1.0, 1.0, 1.0, factor]).double()
        pose = camera.cam_from_world * factors
        return replace(
            given, camera=replace(camera, cam_from_world=pose, near=factor * camera.near)
        )

    assert dataset.points is not None
    return replace(
        dataset,
        train=[view(each) for each in dataset.train],
        test=[view(each) for each in dataset.test],
        points=replace(dataset.points, xyz=factor * dataset.points.xyz),
        extent=factor * dataset.extent,
    )


@pytest.mark.parametrize("init", ["points+sweep", "points+random"])
def test_powers_of_two(dataset: Dataset, init: str) -> None:
    """The first means are the same bits. Only logarithms of scales are rounded differently."""
    config = recipe("default", iterations=200, init=init, max_gaussians=400)
    images = []
    first: list[torch.Tensor] = []
    for factor in (1.0, 2.0**13, 2.0**-13):
        own = scaled(dataset, factor)
        trainer = Trainer(own, config)
        first.append(trainer.gaussians.means.detach() / factor)
        assert torch.equal(first[-1], first[0])
        for _ in range(20):
            trainer.step_once()
        images.append(render(trainer.gaussians.detach(), own.test[0].camera).image)
    for image in images[1:]:
        error = float((image - images[0]).square().mean())
        assert error < 1e-6  # 60 dB
