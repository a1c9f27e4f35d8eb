"""`clean` removes a floater from a trained scene, in each of its three situations."""

import shutil

import pytest
import torch

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.pipeline.clean import clean
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.train import train
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError

from .test_waiting import Waits


def with_floater(gaussians: Gaussians, position: torch.Tensor) -> Gaussians:
    """The Gaussians and a small red one, half transparent."""
    floater = gaussians.select(torch.tensor([0])).map(torch.clone)
    floater.means[0] = position.float()
    floater.log_scales[:] = -3.0
    floater.opacity_logits[:] = 0.0
    floater.sh_dc[:] = torch.tensor([4.0, -2.0, -2.0])
    floater.sh_rest[:] = 0.0
    return gaussians.append(floater)


@pytest.fixture(scope="module")
def photos(dataset, tmp_path_factory):
    """A copy of the dataset, which a test may move, and move back."""
    return shutil.copytree(dataset, tmp_path_factory.mktemp("clean") / "photos")


@pytest.fixture(scope="module")
def trained(photos):
    """An output folder whose scene has a floater before the first held-out camera."""
    options = TrainOptions(hold_out=4, settings={"iterations": 150, "visible_only": False})
    out = photos.with_name("out")
    train(photos, out, options)
    scene = load_trained(out)
    camera = scene.dataset.test[0].camera
    ahead = camera.position + 0.8 * camera.cam_from_world[2, :3]
    file = out / "point_cloud/iteration_150/point_cloud.ply"
    write_gaussians(file, with_floater(scene.gaussians, ahead))
    return out, ahead


def nearest(path, position: torch.Tensor) -> float:
    return float((read_gaussians(path).means - position.float()).norm(dim=1).min())


def test_held_out_photos_decide(trained, tmp_path):
    out, ahead = trained
    seen = Waits()
    done = clean(out, tmp_path / "clean.ply", observer=seen)
    assert "held-out" in done.compared
    assert (seen.stages, seen.open) == (["reading", "cleaning"], False)
    views = seen.counts["views"]
    assert [count for count, _ in views] == list(range(views[0][1]))
    for trial, (count, most) in enumerate(seen.counts["trials"]):
        assert trial == count < most <= 40
    assert nearest(tmp_path / "clean.ply", ahead) > 0.01
    assert done.after < done.before
    assert done.psnr[1] > done.psnr[0]
    with pytest.raises(UserError, match="exists"):
        clean(out, tmp_path / "clean.ply")


def test_a_scene_file_needs_its_dataset(trained, photos, tmp_path):
    out, ahead = trained
    alone = tmp_path / "alone.ply"
    shutil.copyfile(out / "point_cloud/iteration_150/point_cloud.ply", alone)
    with pytest.raises(UserError, match="cameras are unknown"):
        clean(alone, tmp_path / "clean.spz")
    done = clean(alone, tmp_path / "clean.spz", dataset=photos)
    assert "training" in done.compared
    assert done.psnr[1] >= done.psnr[0] - 0.03
    assert nearest(tmp_path / "clean.spz", ahead) > 0.01


def test_without_photos_the_images_stay(trained, photos, tmp_path):
    out, _ = trained
    photos.rename(tmp_path / "moved")
    try:
        done = clean(out, tmp_path / "clean.ply")
    finally:
        (tmp_path / "moved").rename(photos)
    assert "renderings" in done.compared
    assert done.psnr[1] >= 40.0
