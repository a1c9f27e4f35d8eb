"""Level, north and scale from the metadata of photos, in an arbitrary SfM frame."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from snowsplat.data.frame.bounds import near_of
from snowsplat.data.frame.placement import PLACEMENT, Placement, placement_of, read_placement
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.sfm.gps import east_north_up, location_of
from snowsplat.sfm.ingest.photo import Attitude, Photo
from snowsplat.sfm.orient import orientation
from snowsplat.util.messages import message

F64 = torch.float64
HOME = np.array([52.5, 13.4, 40.0])
# The true frame of the tests: metres east, north and up.
UP = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
SFM = Similarity(
    0.11,
    rotation_from_quat(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=F64)),
    torch.tensor([4.0, 5.0, -6.0], dtype=F64),
)


def walk(count=30, step=6.0, wobble=0.05, seed=0):
    """A straight walk to the east-north-east; the cameras look ahead and 10° down."""
    random = np.random.default_rng(seed)
    ahead = np.array([math.cos(0.3), math.sin(0.3), 0.0])
    centres = np.arange(count)[:, None] * step * ahead + [0, 0, 1.6]
    targets = centres + 10 * ahead + [0, 0, -1.76] + random.normal(0, wobble, (count, 3))
    return poses_of(centres, targets)


def lanes(pitch=-90):
    """A drone at 40 m that flies to and fro; the upper edge of each photo points north-east."""
    x, y = np.meshgrid(np.arange(6) * 10.0, np.arange(3) * 15.0)
    centres = np.stack([x.ravel(), y.ravel(), np.full(18, 40.0)], 1)
    ahead = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0])
    slope = math.radians(pitch)
    return poses_of(centres, centres + math.cos(slope) * ahead + [0, 0, math.sin(slope)], ahead)


def poses_of(centres, targets, up=(0.0, 0.0, 1.0)):
    ups = torch.tensor(up, dtype=F64)
    pairs = zip(torch.from_numpy(centres), torch.from_numpy(targets), strict=True)
    return torch.stack([look_at(centre, target, ups) for centre, target in pairs])


def rolled(poses, degrees):
    half = math.radians(degrees) / 2
    turn = rotation_from_quat(torch.tensor([math.cos(half), 0, 0, math.sin(half)], dtype=F64))
    return turn @ poses


def turned_down(poses, degrees):
    half = math.radians(degrees) / 2
    turn = rotation_from_quat(torch.tensor([math.cos(half), math.sin(half), 0, 0], dtype=F64))
    return turn @ poses


def centres_of(poses):
    return -np.einsum("nji,nj->ni", poses[:, :, :3].numpy(), poses[:, :, 3].numpy())


def photos_of(poses, gps=None, sensors=None, stated=None):
    """Photos with GPS errors of ``gps`` metres, or with attitudes, ``gimbal`` or ``phone``."""
    random = np.random.default_rng(1)
    photos = []
    for i, (pose, centre) in enumerate(zip(poses.numpy(), centres_of(poses), strict=True)):
        location = None
        if gps is not None:
            noise = random.normal(0, 1, 3) * (gps, gps, 2.5 * gps)
            location = location_of(centre + noise, HOME)
        attitude = None
        if sensors:
            up, north = (tuple(map(float, pose[:, axis])) for axis in (2, 1))
            attitude = Attitude(up, north, sensors == "gimbal")
        name = f"{i:04d}.png"
        photos.append(
            Photo(name, name, 160, 120, "", None, None, location, False, False, stated, attitude)
        )
    return photos


def around(poses, count=600):
    """Points around the path, and a few on the ground: not enough for a plane."""
    random = np.random.default_rng(2)
    centres = centres_of(poses)
    near = centres[random.integers(0, len(centres), count)]
    ahead = poses[:, 2, :3].numpy().mean(axis=0)
    away = random.uniform(4, 20, (count, 1)) * ahead + random.normal(0, 4, (count, 3))
    return torch.from_numpy(near + away)


def placed(model_of, poses, photos, points=None):
    """``scene_from_true`` and the placement."""
    points = around(poses) if points is None else points
    found = orientation(model_of(SFM.apply_to_poses(poses), SFM.apply(points)), photos)
    scene = found.scene_from_sfm
    shift = scene.apply(SFM.apply(torch.zeros(1, 3, dtype=F64)))[0]
    similarity = Similarity(scene.scale * SFM.scale, scene.rotation @ SFM.rotation, shift)
    return similarity, found.placement


def tilt(similarity):
    """Degrees between the true and the estimated up direction."""
    return math.degrees(math.acos(min(1.0, -float(similarity.rotation[1] @ UP))))


def turn(similarity):
    """Degrees between +z and north."""
    return math.degrees(math.acos(min(1.0, float(similarity.rotation[2, 1]))))


def test_a_straight_walk_with_gps_is_metric_and_points_north(model_of):
    poses = walk()
    found, placement = placed(model_of, poses, photos_of(poses, gps=3.0))
    assert placement.is_metric
    assert found.scale == pytest.approx(1, abs=0.03)
    assert placement.scale_error < 0.05
    assert 2 < placement.position_error < 5
    assert turn(found) < 2
    assert placement.north == (0, 0, 1)
    # Only the slope of the path is known from GPS; without it, the common pitch of 10° remains.
    assert tilt(placed(model_of, poses, [])[0]) > 7
    assert tilt(found) < 4
    # The origin is where the record says.
    origin = found.inverse().apply(torch.zeros(1, 3, dtype=F64))[0].numpy()
    recorded = east_north_up(np.array([placement.origin]), HOME)[0]
    assert np.linalg.norm(recorded - origin) < 6


def test_an_accelerometer_levels_a_walk(model_of):
    poses = walk()
    photos = photos_of(poses, gps=3.0, sensors="phone")
    # One photo was taken in a movement, and one has no sensor.
    photos[3] = replace(photos[3], attitude=replace(photos[3].attitude, up=(0.6, -0.8, 0.0)))
    photos[4] = replace(photos[4], attitude=None)
    found, placement = placed(model_of, poses, photos)
    assert tilt(found) < 1
    assert placement.level_error < 1.2
    assert "accelerometers of 29 photos" in placement.lines()[0]


def test_wrong_gps_positions_are_outliers(model_of):
    poses = walk()
    photos = photos_of(poses, gps=2.0)
    for i in range(0, 30, 4):
        latitude, longitude, altitude = photos[i].location
        photos[i] = replace(photos[i], location=(latitude + 0.01, longitude, altitude + 500))
    found, placement = placed(model_of, poses, photos)
    assert placement.is_metric
    assert found.scale == pytest.approx(1, abs=0.06)
    assert turn(found) < 5


@pytest.mark.parametrize("step", [0.0, 0.1])
def test_positions_that_do_not_differ_give_no_scale(step, model_of):
    """Indoors: a step of a few centimetres, and an error of metres."""
    poses = walk(step=step, wobble=0.5)
    before, _ = placed(model_of, poses, [])
    found, placement = placed(model_of, poses, photos_of(poses, gps=4.0 if step else 0.0))
    assert placement.metres_per_unit is None
    assert placement.origin is None
    assert found.scale == pytest.approx(before.scale)
    assert torch.allclose(found.rotation, before.rotation)
    assert any("GPS gives no scale" in line for line in placement.lines())


def test_positions_that_contradict_the_poses_give_no_scale(model_of):
    poses = walk()
    photos = photos_of(poses, gps=1.0)
    order = np.random.default_rng(3).permutation(len(photos))
    mixed = [
        replace(photo, location=photos[i].location) for photo, i in zip(photos, order, strict=True)
    ]
    _, placement = placed(model_of, poses, mixed)
    assert placement.metres_per_unit is None
    assert any("do not agree with the camera poses" in line for line in placement.lines())


def test_without_altitudes_gps_still_gives_the_scale(model_of):
    poses = walk()
    photos = [
        replace(photo, location=(*photo.location[:2], 0.0)) for photo in photos_of(poses, gps=2.0)
    ]
    found, placement = placed(model_of, poses, photos)
    assert found.scale == pytest.approx(1, abs=0.05)
    assert 4 < placement.level_error < 10  # the path may slope by a tenth


def test_a_near_scene_is_in_metres_and_not_cut(model_of):
    """A long wall at 5 cm: the near plane is relative to the distance."""
    centres = np.stack([np.arange(160) * 0.5, np.zeros(160), np.ones(160)], 1)
    poses = poses_of(centres, centres + np.array([0, 1, 0]))
    random = np.random.default_rng(0)
    points = torch.from_numpy(random.uniform((-1, 0.045, 0.9), (80, 0.055, 1.1), (40_000, 3)))
    found, placement = placed(model_of, poses, photos_of(poses, gps=2.0), points)
    assert placement.is_metric
    assert found.scale == pytest.approx(1, rel=0.05)
    cameras = [Camera(160, 120, 100.0, 100.0, 80.0, 60.0, pose) for pose in poses]
    assert near_of(cameras, points) < 0.045 / 2


def test_a_gimbal_levels_photos_that_look_straight_down(model_of):
    """All upper edges point to the same side, so the way of holding them tells little."""
    poses = turned_down(lanes(), 5)
    points = torch.from_numpy(
        np.random.default_rng(0).uniform((-20, -20, -8), (70, 60, 8), (1500, 3))
    )
    photos = photos_of(poses, sensors="gimbal")
    found, placement = placed(model_of, poses, photos, points)
    assert tilt(found) < 0.1
    assert turn(found) < 0.1
    assert placement.level_error < 1
    assert str(placement.north_from) == "the gimbal angles of 18 photos"
    assert tilt(placed(model_of, poses, [], points)[0]) > 3


def test_yaws_that_contradict_one_another_are_not_used(model_of):
    """Straight down, the yaw of a gimbal may be that of the other side."""
    poses = lanes()
    photos = photos_of(poses, gps=1.0, sensors="gimbal")
    for i in range(6, 12):
        attitude = photos[i].attitude
        opposite = tuple(-value for value in attitude.north)
        photos[i] = replace(photos[i], attitude=replace(attitude, north=opposite))
    found, placement = placed(model_of, poses, photos)
    assert str(placement.north_from) == "GPS positions of 18 photos"
    assert turn(found) < 2
    alone = [replace(photo, location=None) for photo in photos]
    assert placed(model_of, poses, alone)[1].north is None


def test_sensors_that_contradict_the_poses_are_not_used(model_of):
    poses = walk()
    photos = photos_of(poses, sensors="phone")
    directions = np.random.default_rng(0).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    wrong = [
        replace(photo, attitude=Attitude(tuple(direction.tolist()), None, False))
        for photo, direction in zip(photos, directions, strict=True)
    ]
    found, placement = placed(model_of, poses, wrong)
    assert any("accelerometers of the photos contradict" in line for line in placement.lines())
    assert torch.allclose(found.rotation, placed(model_of, poses, [])[0].rotation)


@pytest.mark.parametrize("sensors", [None, "phone"])
@pytest.mark.parametrize(("turned", "degrees"), [(6, -90), (8, 90), (3, 180)])
def test_photos_that_are_not_stored_upright(turned, degrees, sensors, model_of):
    poses = walk()
    photos = [replace(photo, turned=turned) for photo in photos_of(poses, sensors=sensors)]
    found, _ = placed(model_of, rolled(poses, degrees), photos)
    upright, _ = placed(model_of, poses, photos_of(poses, sensors=sensors))
    assert torch.allclose(found.rotation, upright.rotation, atol=1e-6)


def test_a_contradiction_with_the_way_of_holding_is_said(model_of):
    """All photos were turned by a quarter, and the orientation in EXIF was lost."""
    poses = rolled(walk(), 90)
    found, placement = placed(model_of, poses, photos_of(poses, sensors="gimbal"))
    assert tilt(found) < 0.1
    assert any("up differs by" in line for line in placement.lines())


def test_a_compass_tells_north_but_not_the_axes(model_of):
    poses = walk()
    found, placement = placed(model_of, poses, photos_of(poses, sensors="phone"))
    assert placement.north_error > 14
    north = found.rotation @ torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    assert float(north @ torch.tensor(placement.north, dtype=F64)) > math.cos(math.radians(2))
    # The walk leads 73° clockwise of north, and z along it.
    assert "287° clockwise from +z" in placement.lines()[1]


def test_the_ground_levels_photos_that_look_ahead_and_down(model_of):
    """Without metadata, a common pitch is visible only in the ground."""
    poses = walk(step=1.0)
    random = np.random.default_rng(0)
    ground = random.uniform((-5, -20, 0), (45, 30, 0.02), (1500, 3))
    others = random.uniform((-5, -20, 0), (45, 30, 8), (1500, 3))
    points = torch.from_numpy(np.concatenate([ground, others]))
    found, placement = placed(model_of, poses, [], points)
    assert message("the ground") in placement.up_from
    assert tilt(found) < 1
    # A wall beside the path is no ground, and neither is a ceiling.
    wall = torch.from_numpy(np.concatenate([ground[:, [0, 2, 1]] + np.array([0, 20, 0]), others]))
    assert message("the ground") not in placed(model_of, poses, [], wall)[1].up_from
    ceiling = torch.from_numpy(np.concatenate([ground + np.array([0, 0, 4]), others]))
    assert message("the ground") not in placed(model_of, poses, [], ceiling)[1].up_from


def test_the_record_is_restored(model_of, tmp_path):
    poses = walk()
    _, placement = placed(model_of, poses, photos_of(poses, gps=3.0))
    record = json.loads(json.dumps({PLACEMENT: asdict(placement)}))
    assert placement_of(record) == placement
    assert read_placement(tmp_path) is None
    for text in ("[]", '{"stages": []}', "{"):
        (tmp_path / "sfm.json").write_text(text)
        assert read_placement(tmp_path) is None
    (tmp_path / "sfm.json").write_text(json.dumps({"stages": {"images": {"result": record}}}))
    assert read_placement(tmp_path) == placement
    assert placement_of({}) is None
    assert placement_of({PLACEMENT: {"up_from": 3}}) is None
    assert Placement([message("the ground")], 12.3).lines() == [
        "level: from the ground, to about 12°"
    ]


@pytest.mark.parametrize("latitude", [-70.0, 0.0, 46.8])
@pytest.mark.parametrize("longitude", [13.0, 179.9999])
def test_metres_of_a_location(latitude, longitude):
    """Against the earth-centred coordinates of the same ellipsoid."""

    def earth_centred(latitude, longitude, altitude):
        phi, lam = math.radians(latitude), math.radians(longitude)
        radius = 6378137.0 / math.sqrt(1 - 0.00669437999 * math.sin(phi) ** 2)
        across = (radius + altitude) * math.cos(phi)
        up = (radius * (1 - 0.00669437999) + altitude) * math.sin(phi)
        return np.array([across * math.cos(lam), across * math.sin(lam), up])

    home = np.array([latitude, longitude, 100.0])
    place = np.array([300.0, -200.0, 20.0])
    there = location_of(place, home)
    assert -180 <= there[1] < 180
    np.testing.assert_allclose(east_north_up(np.array([there]), home)[0], place, atol=1e-6)
    distance = np.linalg.norm(earth_centred(*there) - earth_centred(*home))
    assert distance == pytest.approx(np.linalg.norm(place), rel=1e-3)
