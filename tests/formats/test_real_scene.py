"""Scenes rendered after a round trip: one of the 3DGS reference implementation, and random ones."""

import pytest
import torch

from snowsplat.evaluation import metrics
from snowsplat.formats import FORMATS, read_gaussians, write_gaussians
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render

#: Least PSNR in dB by format; .splat has no view-dependent colour.
LEAST = {"splat": 25.0}


@pytest.mark.parametrize(
    "format", [f for f in FORMATS if f.read and f.write], ids=lambda format: format.name
)
def test_the_rendered_image_is_nearly_the_same(tmp_path, shared, format):
    scene = read_gaussians(shared / "reference_layout_sh3.ply")
    center = scene.means.median(0).values
    distance = 2 * (scene.means - center).norm(dim=1).quantile(0.8)
    pose = look_at(
        center - distance * torch.tensor([0.2, 0.3, 0.93]), center, torch.tensor([0.0, -1.0, 0.0])
    )
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0, pose)
    path = tmp_path / f"a{format.suffixes[0]}"
    write_gaussians(path, scene)
    before, after = (render(g, camera).image for g in (scene, read_gaussians(path)))
    assert before.std() > 0.1  # the image is not empty
    assert metrics.psnr(after.clamp(0, 1), before.clamp(0, 1)) > LEAST.get(format.name, 38.0)
