"""A small trained scene."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from snowsplat.cli.main import main
from snowsplat.formats import read_gaussians
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset


@dataclass
class Trained:
    out: Path
    scene: Path
    gaussians: Gaussians
    cameras: list[Camera]


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Trained:
    """A training run of 200 steps: balls in a sphere, world z up, cameras at a distance of 3.

    Viewers truncate Gaussians in different ways. This matters most where many transparent layers
    overlap, so the recipe is one without a decay of the opacity.
    """
    root = tmp_path_factory.mktemp("trained")
    dataset = write_toy_dataset(root / "dataset", "colmap-bin", 12, 96, 72, n_points=2000)
    flags = ["--recipe", "classic", "--iterations", "200", "--quiet"]
    assert main(["train", str(dataset), "-o", str(root / "out"), *flags]) == 0
    scene = root / "out/point_cloud/iteration_200/point_cloud.ply"
    _, cameras = read_cameras(root / "out/cameras.json")
    return Trained(root / "out", scene, read_gaussians(scene), cameras)
