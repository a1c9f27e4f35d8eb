"""The true scale: known from a distance, and kept by every way through files."""

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat import Trainer, recipe
from snowsplat.data import load_dataset
from snowsplat.data.frame.placement import PLACEMENT, Placement
from snowsplat.formats import read_arrays, read_gaussians, write_gaussians
from snowsplat.pipeline.convert import convert
from snowsplat.pipeline.describe import describe
from snowsplat.pipeline.options.scene import Edits
from snowsplat.pipeline.true_scale import KnownDistance
from snowsplat.project.edit_record import EditRecord, record_file
from snowsplat.project.project import Project
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.edit import merge, transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.length import metres_of, stored_metres
from snowsplat.util.errors import SettingError
from snowsplat.util.files import write_json
from snowsplat.util.messages import message

FORMATS = ["ply", "compressed.ply", "spz", "sog", "glb", "splat", "lod-meta.json"]
A, B = (0.0, 0.5, 2.0), (-1.0, 0.5, 2.0)  # a unit apart


def scene(count: int = 40) -> Gaussians:
    """Of which the first two are at A and B."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    means[:2] = torch.tensor([A, B])
    scales = torch.full((count, 3), -3.0)
    others = [torch.randn(count, *s, generator=generator) for s in ((4,), (), (1, 3), (0, 3))]
    return Gaussians(means, scales, *others)


def text(point: tuple[float, ...]) -> str:
    return ",".join(map(str, point))


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    write_gaussians(tmp_path / "plain.ply", scene())
    return tmp_path / "plain.ply"


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_keeps_it(plain: Path, name: str) -> None:
    """From a known distance to any format, `info`, and back to a PLY; crop and decimate keep it."""
    known = KnownDistance("45 cm", (text(A), text(B)))
    target = plain.parent / "made" / (name if name.endswith("json") else f"scene.{name}")
    convert(plain, target, known=known)
    back = plain.with_name("back.ply")
    convert(target, back, Edits(crop=(-9, -9, -9, 9, 9, 9), decimate=30))
    assert describe(target)["metres_per_unit"] == read_arrays(back).metres_per_unit == 1
    found = read_arrays(target).means
    distance = np.linalg.norm(0.45 * np.array([A, B])[:, None] - found, axis=2).min(1)
    assert distance.max() < 0.45 * 0.005  # coarse formats round positions


def test_units_are_metres_in_gltf(tmp_path: Path) -> None:
    """A scene in other units is placed by its node; an unknown scale stays unknown."""
    known, origin = 0.25, (4000.0, 0.0, -800.0)
    write_gaussians(tmp_path / "a.glb", replace(scene(), metres_per_unit=known, origin=origin))
    back = read_arrays(tmp_path / "a.glb")
    assert back.metres_per_unit == 1
    expected = known * (scene().means.double().numpy() + np.array(origin))
    assert np.abs(back.world_means() - expected).max() < 1e-4
    write_gaussians(tmp_path / "b.glb", scene())
    assert read_arrays(tmp_path / "b.glb").metres_per_unit is None


def test_edits_keep_lengths() -> None:
    """The length of a thing in metres is that of before, in whatever units the scene is."""
    known = replace(scene(), metres_per_unit=0.5)
    turned = transform(known, replace(Similarity.identity(), scale=4.0))
    assert turned.metres_per_unit == 0.125
    lengths = [float((s.means[0] - s.means[1]).norm()) * s.metres_per_unit for s in (known, turned)]
    assert lengths == pytest.approx([0.5, 0.5])
    for changed in (known.select(torch.arange(5)), known.detach(), merge([known, known])):
        assert changed.metres_per_unit == 0.5


def test_it_is_between_photos(tmp_path: Path) -> None:
    """Names with and without suffix; also of an edited scene, which has another scale."""
    out = tmp_path / "scene"
    file = out / "point_cloud" / "iteration_7" / "point_cloud.ply"
    file.parent.mkdir(parents=True)
    write_gaussians(file, scene())
    pose = torch.eye(3, 4, dtype=torch.float64)
    poses = {"room/IMG_1": pose.clone(), "IMG_2": pose.clone()}
    poses["IMG_2"][0, 3] = -3.0
    cameras = ((name, Camera(8, 6, 9, 9, 4, 3, p)) for name, p in poses.items())
    write_cameras(out / "cameras.json", cameras)
    between = ("room/IMG_1.jpg", "IMG_2")
    assert KnownDistance("6m", between).metres_per_unit(Project.open(file)) == pytest.approx(2)
    edited = file.with_name("point_cloud_edited.ply")
    write_gaussians(edited, scene())
    write_json(record_file(edited), asdict(EditRecord(file.name, 0, scale=4.0)))
    assert KnownDistance("6m", between).metres_per_unit(Project.open(edited)) == pytest.approx(0.5)
    convert(file, tmp_path / "true.ply", known=KnownDistance("6m", between))
    assert read_gaussians(tmp_path / "true.ply").metres_per_unit == 1


@pytest.mark.parametrize(
    ("length", "between", "message"),
    [
        ("45", (text(A), text(B)), "45' is not a length"),
        ("-1m", (text(A), text(B)), "is not a length"),
        ("nan m", (text(A), text(B)), "is not a length"),
        ("1 ell", (text(A), text(B)), "mm, cm, m, km, in, ft"),
        ("1m", ("", ""), "add `between`"),
        ("1m", (text(A), text(A)), "twice"),
        ("1m", ("0,1,2", "0.0,1,2"), "same place"),
        ("1m", ("IMG_1.jpg", text(A)), "photos of this file are not known"),
        ("1m", ("1,2,nan", text(A)), "no point"),
    ],
)
def test_what_is_no_distance(
    plain: Path, length: str, between: tuple[str, str], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        convert(plain, plain.with_name("x.ply"), known=KnownDistance(length, between))
    assert not plain.with_name("x.ply").exists()


def test_two_scales_are_one_too_many(plain: Path) -> None:
    known = KnownDistance("1m", (text(A), text(B)))
    with pytest.raises(SettingError, match="leave one of them out"):
        convert(plain, plain.with_name("x.ply"), Edits(scale=2.0), known=known)


def test_a_training_keeps_it(dataset: Path, tmp_path: Path) -> None:
    """From the record of `sfm`; a start that has a scale has priority over it."""
    shutil.copytree(dataset, tmp_path / "dataset")
    placement = asdict(Placement([message("gimbal")], 1.0, metres_per_unit=1.0))
    stages = {"images": {"result": {PLACEMENT: placement}}}
    write_json(tmp_path / "dataset" / "sfm.json", {"stages": stages})
    metric = load_dataset(tmp_path / "dataset")
    assert metric.metres_per_unit == 1
    assert load_dataset(dataset).metres_per_unit is None
    config = recipe("default", iterations=1)
    assert Trainer(metric, config).gaussians.metres_per_unit == 1
    start = replace(scene(), metres_per_unit=2.0)
    assert Trainer(metric, config, initial=start).gaussians.metres_per_unit == 2


def test_lengths_are_read() -> None:
    texts = {"0.45m": 0.45, "45 cm": 0.45, "450MM": 0.45, "10in": 0.254, "1e1ft": 3.048, ".5m": 0.5}
    assert {text: metres_of(text) for text in texts} == pytest.approx(texts)
    for value in (0, -1, float("nan"), float("inf"), True, "1", None, 1e300):
        assert stored_metres(value) is None
    assert stored_metres(2) == 2.0
