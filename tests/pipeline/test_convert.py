"""`convert` and its edits from Python."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.formats import read_arrays, read_gaussians, write_gaussians
from snowsplat.formats.spz import spz_version
from snowsplat.pipeline.convert import convert, transform_of
from snowsplat.pipeline.options.scene import Edits, file_size, gaussians_to_keep
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.options.video import VideoSize
from snowsplat.pipeline.output.scene_source import cameras_of
from snowsplat.pipeline.train import train
from snowsplat.pipeline.videos import cameras_along
from snowsplat.project.project import Project
from snowsplat.scene import edit
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.ply import open_table


def test_number_of_gaussians_to_keep():
    assert [gaussians_to_keep(text, 400) for text in ("0", "17", "0%", "50%", "12.5%", "100%")] == [
        *(0, 17, 0, 200, 50, 400)
    ]
    with pytest.raises(UserError):
        gaussians_to_keep("¾", 400)


def test_size_of_a_file():
    sizes = [file_size(text) for text in ("10MB", "0.5 gb", "800kB", "800", "50%", 7, None)]
    assert sizes == [10_000_000, 500_000_000, 800_000, None, None, None, None]


def test_two_scenes_are_merged(tmp_path):
    zeros = torch.zeros(3, 1, 3)
    one = Gaussians(
        torch.arange(9.0).reshape(3, 3),
        zeros[:, 0],
        torch.ones(3, 4),
        zeros[:, 0, 0],
        zeros,
        zeros[:, :0],
    )
    write_gaussians(tmp_path / "a.ply", one)
    edits = Edits(translate=(1.0, 0.0, 0.0), decimate=5)
    format = convert([tmp_path / "a.ply", tmp_path / "a.ply"], tmp_path / "b.ply", edits)
    assert format.name == "PLY"
    both = read_gaussians(tmp_path / "b.ply")
    assert len(both) == 5
    torch.testing.assert_close(both.means[:, 0].unique(), torch.tensor([1.0, 4.0, 7.0]))
    with pytest.raises(UserError, match="exists; use `overwrite`"):
        convert(tmp_path / "a.ply", tmp_path / "b.ply")


def test_versions_of_spz(tmp_path):
    zeros = torch.zeros(3, 1, 3)
    scene = Gaussians(
        zeros[:, 0], zeros[:, 0], torch.ones(3, 4), zeros[:, 0, 0], zeros, zeros[:, :0]
    )
    write_gaussians(tmp_path / "a.ply", scene)
    for given, written in ((None, "3"), (2, "2"), (3, "3"), (4, "4")):
        path = tmp_path / f"{given}.spz"
        convert(tmp_path / "a.ply", path, spz_version=given)
        assert spz_version(path) == written
        assert len(read_gaussians(path)) == 3
    edits = Edits(decimate="10KB")
    convert(tmp_path / "a.ply", tmp_path / "small.spz", edits, spz_version=2)
    assert spz_version(tmp_path / "small.spz") == "2"
    for name, version, message in (("b.spz", 1, "1 cannot"), ("b.sog", 2, "b.sog is SOG")):
        with pytest.raises(SettingError, match=message) as error:
            convert(tmp_path / "a.ply", tmp_path / name, spz_version=version)
        assert error.value.setting == "spz_version"
        assert not (tmp_path / name).exists()


UTM = (500_000.0, 5_400_000.0, 300.0)


def test_a_georeferenced_scene(tmp_path, caplog):
    """The origin survives every way through files; doubles have the positions in the world."""
    generator = torch.Generator().manual_seed(0)
    shapes = ((300, 3), (300, 3), (300, 4), (300,), (300, 1, 3), (300, 0, 3))
    tensors = [torch.randn(shape, generator=generator) for shape in shapes]
    scene = Gaussians(*tensors, origin=UTM)
    write_gaussians(tmp_path / "local.ply", scene)
    world = scene.means.double().numpy() + np.array(UTM)
    convert(tmp_path / "local.ply", tmp_path / "utm.ply", georeferenced=True)
    columns = open_table(tmp_path / "utm.ply").columns
    assert [columns[axis] for axis in "xyz"] == ["f8"] * 3
    np.testing.assert_allclose(read_arrays(tmp_path / "utm.ply").world_means(), world, atol=1e-7)
    # By way of a format without a place for the origin, of limited size, and back to 0.
    convert(tmp_path / "utm.ply", tmp_path / "a.spz", Edits(decimate="5KB"))
    assert read_arrays(tmp_path / "a.spz").origin == UTM
    assert sorted(path.name for path in tmp_path.glob("*.json")) == ["a.spz.origin.json"]
    back = Edits(translate=tuple(-x for x in UTM))
    convert(tmp_path / "utm.ply", tmp_path / "a.spz", back, overwrite=True)
    assert not list(tmp_path.glob("*.json"))
    at_0 = read_arrays(tmp_path / "a.spz")
    assert at_0.origin == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(at_0.means, scene.means, atol=2e-4)
    with pytest.raises(UserError, match="no doubles"):
        convert(tmp_path / "utm.ply", tmp_path / "b.sog", georeferenced=True)
    write_gaussians(tmp_path / "plain.ply", replace(scene, origin=(0.0, 0.0, 0.0)))
    convert([tmp_path / "utm.ply", tmp_path / "plain.ply"], tmp_path / "both.ply")
    assert "do they have the same frame?" in caplog.text


def test_cameras_of_a_file_may_be_in_the_world(tmp_path):
    """Both kinds of coordinates give the same path."""
    scene = Gaussians(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(0)),
        *(torch.zeros(shape) for shape in ((50, 3), (50, 4), (50,), (50, 1, 3), (50, 0, 3))),
        origin=UTM,
    )
    pose = torch.tensor([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 4]], dtype=torch.float64)
    local = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose)
    world = local.seen_from((-UTM[0], -UTM[1], -UTM[2]))
    paths = []
    for name, camera in (("local", local), ("world", world)):
        other = camera.seen_from((1.0, 0.0, 0.0))
        write_cameras(tmp_path / f"{name}.json", [("a", camera), ("b", other)])
        size = VideoSize(None, None)
        paths.append(cameras_along(str(tmp_path / f"{name}.json"), scene, None, 3, size))
    for a, b in zip(*paths, strict=True):
        torch.testing.assert_close(a.cam_from_world, b.cam_from_world, rtol=0, atol=1e-6)
        assert float(a.position.norm()) < 10


@pytest.fixture(scope="module")
def out(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained") / "out"
    train(dataset, out, TrainOptions(settings={"iterations": 60}))
    return out


def test_the_photos_improve_a_decimated_scene(dataset, out, tmp_path, monkeypatch):
    monkeypatch.setattr("snowsplat.pipeline.convert._REFINED_STEPS", 40)
    count = len(read_gaussians(out / "point_cloud/iteration_60/point_cloud.ply")) // 3
    plain, refined = tmp_path / "plain.ply", tmp_path / "refined.ply"
    convert(out, plain, Edits(decimate=count))
    convert(out, refined, Edits(decimate=count), dataset=dataset)
    views = load_dataset(dataset, hold_out=None).train
    before, after = (evaluate_views(read_gaussians(path), views).psnr for path in (plain, refined))
    assert after > before + 1.0
    assert len(read_gaussians(refined)) == len(read_gaussians(plain)) == count


def test_edits_that_hide_a_part_are_refused(dataset, tmp_path):
    (tmp_path / "a.ply").touch()
    for edits in (Edits(), Edits(decimate=9, crop=(0, 0, 0, 1, 1, 1))):
        with pytest.raises(SettingError) as error:
            convert(tmp_path / "a.ply", tmp_path / "b.ply", edits, dataset=dataset)
        assert error.value.setting == "refine"


def test_the_cameras_of_an_output_folder_are_used(out, tmp_path):
    file = out / "point_cloud/iteration_60/point_cloud.ply"
    whole, bare = read_gaussians(file), tmp_path / "bare.ply"
    shutil.copy(file, bare)
    _, cameras = cameras_of(Project.open(out).training)
    wanted = [render(whole, camera).image for camera in cameras]

    def loss(source, edits):
        """The mean error against the whole scene, of what `convert` makes of ``source``."""
        convert(source, tmp_path / "small.ply", edits, overwrite=True)
        found = read_gaussians(tmp_path / "small.ply")
        assert len(found) == len(whole) // 3
        transform = transform_of(edits)
        if transform:
            found = edit.transform(found, transform.inverse())
        images = [render(found, camera).image for camera in cameras]
        return sum(float((a - b).abs().mean()) for a, b in zip(images, wanted, strict=True))

    count = len(whole) // 3
    distilled = loss(out, Edits(decimate=count))
    assert distilled < 0.8 * loss(bare, Edits(decimate=count))
    # Training is chaotic: the rounding of the transform changes its result a little.
    moved = loss(out, Edits(decimate=count, scale=0.01, translate=(0.0, 0.0, 0.5)))
    assert moved == pytest.approx(distilled, rel=0.05)
