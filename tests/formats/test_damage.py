"""Scenes with odd values in every format; `tests/fuzz` damages the files."""

import warnings

import pytest
import torch

from snowsplat.formats import FORMATS, read_gaussians, write_gaussians
from snowsplat.scene.gaussians import Gaussians

from ..usd import USD

READ_AND_WRITTEN = [f for f in FORMATS if f.read and f.write and (USD or f.name != "USD")]


@pytest.mark.parametrize("format", READ_AND_WRITTEN, ids=lambda format: format.name)
def test_unusable_gaussians_are_left_out_with_a_warning(tmp_path, make_scene, caplog, format):
    if format.name == "PLY":
        pytest.skip("PLY stores non-finite values")
    scene = make_scene(20, 1)
    scene.means[3, 1] = torch.nan
    scene.log_scales[4, 0] = torch.inf
    scene.quats[5, 2] = torch.nan
    scene.opacity_logits[6] = torch.nan
    scene.sh_rest[7, 1, 1] = torch.inf
    path = tmp_path / f"a{format.suffixes[0]}"
    write_gaussians(path, scene)
    reasons = "positions of 1, scales of 1, rotations of 1, opacities of 1, colours of 1"
    assert f"5 of 20 Gaussians are not finite ({reasons}); left out" in caplog.text
    read = read_gaussians(path)
    assert len(read) == 15
    assert bool(read.usable_rows().all())


@pytest.mark.parametrize("format", READ_AND_WRITTEN, ids=lambda format: format.name)
def test_extreme_but_finite_scenes_are_written_and_read(tmp_path, make_scene, format):
    scene = make_scene(40, 3)
    for i, value in enumerate((1e38, -1e38, 1e20, 0.0, 1e-30)):
        for tensor in scene.parameters().values():
            tensor[i] = value
    path = tmp_path / f"a{format.suffixes[0]}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of NumPy
        write_gaussians(path, scene)
    assert 35 <= len(read_gaussians(path)) <= 40


def test_a_scene_without_gaussians_is_written_and_read(tmp_path):
    for format in READ_AND_WRITTEN:
        path = tmp_path / f"a{format.suffixes[0]}"
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, 15, 3))
        write_gaussians(path, Gaussians(*(torch.zeros(shape) for shape in shapes)))
        assert len(read_gaussians(path)) == 0
