"""The map and the photos while poses are found."""

import re

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data.points_ply import write_points
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.geometry import look_at
from snowsplat.sfm.report.scene_map import PlacedPhoto
from snowsplat.studio.recorder import Recorder, cameras_from_above
from snowsplat.util.errors import UserError
from snowsplat.util.stages import Outcome


def standing(x: float) -> np.ndarray:
    """The pose of a camera at (x, 0, 0) in a frame where z points up."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    return np.column_stack([rotation, -rotation @ [x, 0, 0]])


def test_photos_are_placed_one_by_one(studio):
    scene = studio.library.new("a", [])
    for folder, names in (("input/walk", "abc"), ("images", "z")):  # images of an earlier job
        (scene.made / "dataset" / folder).mkdir(parents=True)
        for name in names:
            Image.new("RGB", (30, 20)).save(scene.made / "dataset" / folder / f"{name}.jpg")
    address = f"scenes/{scene.name}"
    assert studio.ask(f"{address}/photos")[1] == [{"name": "z.jpg", "placed": True}]
    recorder = Recorder(scene)
    recorder.begin("poses")
    cloud = np.random.default_rng(0).uniform((-1, 3, -1), (1, 5, 1), (50, 3))
    drawn = set()
    for count in (2, 3):
        names = [f"walk/{letter}.jpg" for letter in "abc"[:count]]
        photos = [PlacedPhoto(n, None, standing(i), 0.5, 0.4) for i, n in enumerate(names)]
        recorder.show_poses(photos, cloud)
        answer = studio.ask(address)[1]
        assert "placed" not in answer["state"]  # there may be thousands
        drawn.add(answer["map"])
        svg = studio.ask(f"{address}/map")[1].decode()
        assert svg.count("<title>walk/") == count
        listed = [each["placed"] for each in studio.ask(f"{address}/photos")[1]]
        assert listed == [True, True, count == 3]
    assert len(drawn) == 2  # the page sees that there is another one
    # From above: the cameras stand side by side, and the points are in front of them.
    width, height = (float(v) for v in svg.split('viewBox="0 0 ')[1].split('"')[0].split())
    assert height > width / 2
    facts = {"registered": names, "unregistered": {}, "points": 50, "reprojection_error": 0.5}
    result = facts | {"sub_models": [3], "attempts": ["one"]}
    recorder.end("poses", Outcome(result, 1.0, False))
    assert studio.ask(f"{address}/photos")[1] == [{"name": "z.jpg", "placed": True}]


def drawn(folder, up_axis: int, with_points: bool) -> str:
    """A ring of 12 cameras around points, on a level plane."""
    up = torch.eye(3, dtype=torch.float64)[up_axis]
    level = [torch.eye(3, dtype=torch.float64)[(up_axis + k) % 3] for k in (1, 2)]
    angles = torch.arange(12) * (2 * torch.pi / 12)
    eyes = [4 * (level[0] * a.cos() + level[1] * a.sin()) + 0.5 * up for a in angles.double()]
    poses = [look_at(eye, torch.zeros(3, dtype=torch.float64), up) for eye in eyes]
    cameras = [(f"{i}", Camera(60, 40, 50.0, 50.0, 30.0, 20.0, p)) for i, p in enumerate(poses)]
    folder.mkdir()
    write_cameras(folder / "cameras.json", cameras)
    if with_points:
        xyz = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
        write_points(folder / "input.ply", xyz, np.full((50, 3), 128, np.uint8))
    return cameras_from_above(TrainingFolder(folder))


@pytest.mark.parametrize("up_axis", [0, 1, 2])
def test_a_ring_is_drawn_as_a_ring(tmp_path, up_axis):
    """From the side, it would be a line."""
    svg = drawn(tmp_path / "out", up_axis, with_points=False)
    numbers = [float(n) for n in re.search(r'viewBox="([^"]+)"', svg)[1].split()]
    assert 0.8 < numbers[2] / numbers[3] < 1.25
    assert svg.count("<title>") >= 12
    assert len(drawn(tmp_path / "points", up_axis, with_points=True)) > len(svg)


def test_a_folder_without_cameras(tmp_path):
    with pytest.raises(UserError, match=r"cameras\.json"):
        cameras_from_above(TrainingFolder(tmp_path))
