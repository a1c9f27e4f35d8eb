"""The procedural capture: images, poses and points agree with each other."""

import pytest
import torch

from snowsplat.capture import ImageLoader, load_capture
from snowsplat.capture.synthetic import write_synthetic_capture


def test_the_same_arguments_give_the_same_files(tmp_path):
    a = write_synthetic_capture(tmp_path / "a", n_views=2, width=16, height=12, seed=3)
    b = write_synthetic_capture(tmp_path / "b", n_views=2, width=16, height=12, seed=3)
    c = write_synthetic_capture(tmp_path / "c", n_views=2, width=16, height=12, seed=4)
    names = sorted(path.relative_to(a) for path in a.rglob("*.*"))
    assert len(names) == 5
    assert all((a / name).read_bytes() == (b / name).read_bytes() for name in names)
    assert (a / "images/view_00.png").read_bytes() != (c / "images/view_00.png").read_bytes()


def test_binary_and_text_hold_the_same(pristine):
    binary, text = load_capture(pristine["colmap-bin"]), load_capture(pristine["colmap-txt"])
    assert torch.equal(binary.points.xyz, text.points.xyz)
    assert torch.equal(binary.points.rgb, text.points.rgb)
    for a, b in zip(binary.train, text.train, strict=True):
        assert a.name == b.name
        assert torch.equal(a.camera.cam_from_world, b.camera.cam_from_world)


def test_points_have_the_colour_of_the_pixels_they_fall_on(tmp_path):
    capture = load_capture(write_synthetic_capture(tmp_path, n_views=3), hold_out=None)
    assert len(capture.points) == 1500
    with ImageLoader(capture.train) as loader:
        for i, view in enumerate(capture.train):
            own = slice(500 * i, 500 * (i + 1))  # those this camera saw, so nothing hides them
            pixels, depth = view.camera.project(capture.points.xyz[own].double())
            assert (depth > 0).all()
            column, row = pixels.long().T
            seen = loader.get(view).rgb[row, column].int()
            error = (seen - capture.points.rgb[own].int()).abs().amax(1).double()
            assert error.median() <= 2
            assert (error < 16).double().mean() > 0.85  # the others are at edges


@pytest.mark.parametrize("format", ["colmap-bin", "blender"])
def test_images_show_something(pristine, format):
    capture = load_capture(pristine[format])
    with ImageLoader(capture.train, background=(1, 1, 1)) as loader:
        for view in capture.train:
            assert loader.get(view).rgb.double().std() > 15


def test_transforms_and_model_agree(pristine):
    """The same cameras through both readers: axes and intrinsics are converted rightly."""
    colmap = load_capture(pristine["colmap-bin"], hold_out=None)
    blender = load_capture(pristine["blender"], hold_out=None)
    by_number = {view.name.split("_")[1].rjust(6, "0"): view.camera for view in blender.train}
    for view in colmap.train:
        other = by_number[view.name.split("_")[1]]
        assert torch.allclose(view.camera.cam_from_world, other.cam_from_world, atol=1e-12)
        assert other.fx == pytest.approx(view.camera.fx)
        assert (other.cx, other.cy) == (view.camera.cx, view.camera.cy)
