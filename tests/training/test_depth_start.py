"""The start from depth maps of the dataset: kinds of values, alignment, masks, unusable maps."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.photos.decode import ImageSource
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.starts import depth_points
from snowsplat.training.starts.init import initial_gaussians
from snowsplat.util.errors import SettingError, UserError

from .sphere import SIZE, cameras, dataset

COUNT = 800


def found(data: Dataset) -> Points:
    return depth_points(data, ImageLoader(data.train), COUNT, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("kind", ["png in mm", "distance", "disparity"])
def test_points_lie_on_the_surface(tmp_path: Path, kind: str) -> None:
    points = found(dataset(tmp_path, kind))
    assert COUNT / 2 < len(points) <= COUNT
    error = (points.xyz.norm(dim=1) - 1.0).abs()
    assert float(error.median()) < 0.005
    assert float(error.max()) < 0.05
    # Each point has the grey value of the photos that show it.
    assert int(points.rgb.min()) >= 0
    assert int(points.rgb.max()) <= 200
    assert len(points.rgb.unique()) > 4


def test_without_points_the_maps_are_z_in_world_units(tmp_path: Path) -> None:
    data = replace(dataset(tmp_path, "z"), points=None)
    error = (found(data).xyz.norm(dim=1) - 1.0).abs()
    assert float(error.max()) < 0.03


def test_without_points_maps_may_have_a_unit(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    views = [replace(view, depth_unit=1e-3) for view in data.train]
    error = (found(replace(data, train=views, points=None)).xyz.norm(dim=1) - 1.0).abs()
    assert float(error.max()) < 0.03


@pytest.mark.parametrize("of", ["mask", "depth_confidence"])
def test_masked_pixels_and_depths_of_no_confidence_are_not_used(tmp_path: Path, of: str) -> None:
    data, file = dataset(tmp_path), tmp_path / "lower_half.png"
    white = np.full((SIZE, SIZE), 255, np.uint8)
    white[: SIZE // 2] = 0
    Image.fromarray(white).save(file)
    kept = {of: ImageSource(file, SIZE, SIZE) if of == "mask" else file}
    points = found(replace(data, train=[replace(view, **kept) for view in data.train]))
    camera = cameras()[2]
    all_rows, rows = (camera.project(p.xyz)[0][:, 1] for p in (found(data), points))
    assert int((all_rows < SIZE / 2 - 8).sum()) > 50
    assert int((rows < SIZE / 2 - 8).sum()) == 0
    assert len(points) > 100


def test_the_first_gaussians_are_at_the_points(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    config = replace(TrainConfig(), init="depth", initial_points=COUNT)
    gaussians = initial_gaussians(
        *(data, config, ImageLoader(data.train), torch.Generator().manual_seed(0)),
        torch.device("cpu"),
    )
    assert float((gaussians.means.norm(dim=1) - 1.0).abs().max()) < 0.05


def test_a_map_that_contradicts_the_points_is_not_used(tmp_path: Path, caplog) -> None:
    data = dataset(tmp_path)
    noise = np.random.default_rng(0).uniform(1, 60000, (SIZE, SIZE)).astype(np.uint16)
    Image.fromarray(noise).save(data.train[0].depth)
    with caplog.at_level(logging.WARNING):
        points = found(data)
    assert caplog.messages == ["1 depth maps do not agree with the points; not used"]
    assert float((points.xyz.norm(dim=1) - 1.0).abs().max()) < 0.05
    for view in data.train:
        Image.fromarray(noise).save(view.depth)
    with pytest.raises(UserError, match="no depth map agrees with the points"):
        found(data)


def test_a_dataset_without_usable_maps(tmp_path: Path) -> None:
    data = dataset(tmp_path)
    without = replace(data, train=[replace(view, depth=None) for view in data.train])
    with pytest.raises(SettingError, match="depths/IMG.png"):
        found(without)
    Image.fromarray(np.ones((SIZE, SIZE // 2), np.uint16)).save(data.train[1].depth)
    with pytest.raises(UserError, match="48x96 pixels, but its photo has 96x96"):
        found(data)
    data.train[1].depth.write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"depth1\.png: cannot be read as a depth map"):
        found(data)
