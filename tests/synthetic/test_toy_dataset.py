"""The toy dataset: images, poses and points are consistent."""

from pathlib import Path

import pytest
import torch

from snowsplat.data import ImageLoader, load_dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset


def test_the_same_arguments_write_the_same_files(tmp_path):
    a = write_toy_dataset(tmp_path / "a", n_views=2, width=16, height=12, seed=3)
    b = write_toy_dataset(tmp_path / "b", n_views=2, width=16, height=12, seed=3)
    c = write_toy_dataset(tmp_path / "c", n_views=2, width=16, height=12, seed=4)
    names = sorted(path.relative_to(a) for path in a.rglob("*.*"))
    assert len(names) == 5
    assert all((a / name).read_bytes() == (b / name).read_bytes() for name in names)
    assert (a / "images/view_00.png").read_bytes() != (c / "images/view_00.png").read_bytes()


@pytest.fixture(scope="module")
def datasets(tmp_path_factory) -> dict[str, Path]:
    """The same scene in each format."""
    root = tmp_path_factory.mktemp("datasets")
    formats = ("colmap-bin", "colmap-txt", "blender")
    return {f: write_toy_dataset(root / f, f, 9, 32, 24, n_points=60) for f in formats}


def test_binary_and_text_have_the_same_content(datasets):
    binary, text = load_dataset(datasets["colmap-bin"]), load_dataset(datasets["colmap-txt"])
    assert torch.equal(binary.points.xyz, text.points.xyz)
    assert torch.equal(binary.points.rgb, text.points.rgb)
    for a, b in zip(binary.train, text.train, strict=True):
        assert a.name == b.name
        assert torch.equal(a.camera.cam_from_world, b.camera.cam_from_world)


def test_points_have_the_colours_of_their_pixels(tmp_path):
    dataset = load_dataset(write_toy_dataset(tmp_path, n_views=3), hold_out=None)
    assert len(dataset.points) == 1500
    with ImageLoader(dataset.train) as loader:
        for i, view in enumerate(dataset.train):
            own = slice(500 * i, 500 * (i + 1))  # sampled from this camera, so not occluded
            pixels, depth = view.camera.project(dataset.points.xyz[own].double())
            assert (depth > 0).all()
            column, row = pixels.long().T
            seen = loader.get(view).rgb[row, column].int()
            error = (seen - dataset.points.rgb[own].int()).abs().amax(1).double()
            assert error.median() <= 2
            assert (error < 16).double().mean() > 0.85  # the others are at edges


@pytest.mark.parametrize("format", ["colmap-bin", "blender"])
def test_images_have_content(datasets, format):
    dataset = load_dataset(datasets[format])
    with ImageLoader(dataset.train, background=(1, 1, 1)) as loader:
        for view in dataset.train:
            assert loader.get(view).rgb.double().std() > 15


def test_transforms_json_and_colmap_model_agree(datasets):
    """The readers convert the axes and intrinsics of both formats to the same cameras."""
    colmap = load_dataset(datasets["colmap-bin"], hold_out=None)
    blender = load_dataset(datasets["blender"], hold_out=None)
    by_number = {view.name.split("_")[1].rjust(6, "0"): view.camera for view in blender.train}
    for view in colmap.train:
        other = by_number[view.name.split("_")[1]]
        assert torch.allclose(view.camera.cam_from_world, other.cam_from_world, atol=1e-12)
        assert other.fx == pytest.approx(view.camera.fx)
        assert (other.cx, other.cy) == (view.camera.cx, view.camera.cy)
