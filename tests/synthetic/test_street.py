"""The procedural street: a complete dataset, whose poses and points fit the photos."""

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat import load_dataset
from snowsplat.scene.geometry import transform_points

from ..scenes.coarse import coarse_light
from ..scenes.street_dataset import walk_along, write_street_dataset

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        coarse_light(patch, 0.5)
        return write_street_dataset(tmp_path_factory.mktemp("street"), 6, 96, 64, seed=1)


def test_the_dataset_is_complete(folder):
    dataset = load_dataset(folder, hold_out=None)
    assert len(dataset.train) == 6
    assert len(dataset.points) > 300
    for view in dataset.train:
        with Image.open(view.image.path) as photo:
            pixels = np.asarray(photo, np.float32)
        assert pixels.shape == (64, 96, 3)
        assert pixels.std() > 25  # neither empty nor flat


def test_points_are_where_the_photos_show_them(folder):
    """At most pixels, the colour of a point is that of the photos which it is projected into."""
    dataset = load_dataset(folder, hold_out=None)
    differences = []
    for view in dataset.train:
        camera = view.camera
        x, y, z = transform_points(camera.cam_from_world, dataset.points.xyz.double()).unbind(1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        seen = (z > 0.5) & (u >= 0) & (u < 96) & (v >= 0) & (v < 64)
        with Image.open(view.image.path) as photo:
            pixels = torch.from_numpy(np.asarray(photo).copy())
        colours = pixels[v[seen].long(), u[seen].long()].float()
        differences.append((colours - dataset.points.rgb[seen].float()).abs().mean(1))
    difference = torch.cat(differences)
    assert len(difference) > 400
    assert float((difference < 20).float().mean()) > 0.7  # the others are hidden, or at an edge


def test_the_walk_returns_on_the_other_side():
    poses = torch.stack(walk_along(10.0, 40, seed=0))
    centres = -(poses[:, :, :3].transpose(1, 2) @ poses[:, :, 3:])[..., 0]
    assert float(centres[:20, 1].max()) < 0 < float(centres[20:, 1].min())
    assert (centres[:20, 0].diff() > 0.2).all()
    assert (centres[20:, 0].diff() < -0.2).all()
    assert float(centres[:, 0].max()) == pytest.approx(10.0, abs=0.6)
