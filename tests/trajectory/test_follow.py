"""The smoothed path of the training cameras, and paths through key cameras."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, rotation_from_quat
from snowsplat.trajectory import key_path, training_path
from snowsplat.util.errors import UserError

from .rigs import FOCUS, UP, camera_at, misses, positions, ring, rolls, speeds, turns


def shaken(cameras: list[Camera], by: float) -> list[Camera]:
    """The cameras with random offsets, normally distributed with standard deviation ``by``."""
    random = torch.Generator().manual_seed(3)
    result = []
    for camera in cameras:
        place = camera.position + by * torch.randn(3, generator=random, dtype=torch.float64)
        result.append(camera_at(place.tolist()))
    return result


def test_training_path_removes_hand_shake():
    truth = ring(60, 3.0, 3.0, turn=4.0)
    names = [f"frame_{i}" for i in range(60)]
    given = shaken(truth, 0.05)
    path = training_path(given, names, 200, 3.0)
    assert len(path) == 200
    assert all(camera.fx == pytest.approx(60.0, rel=1e-12) for camera in path)
    offsets = positions(path) - FOCUS
    away = offsets[:, [0, 2]].norm(dim=1) - 3.0
    shaking = (positions(given) - FOCUS)[:, [0, 2]].norm(dim=1) - 3.0
    assert float(away.square().mean().sqrt()) < 0.6 * float(shaking.square().mean().sqrt())
    # The path leads from the first to the last camera, looks at their focus, and stays level.
    assert float((path[0].position - truth[0].position).norm()) < 0.15
    assert float((path[-1].position - truth[-1].position).norm()) < 0.15
    assert float(misses(path, FOCUS).max()) < 3.0
    assert float(rolls(path).abs().max()) < 0.02
    steps, angles = speeds(path, closed=False) / 3.0, turns(path, closed=False)
    moved = (steps.square() + angles.square()).sqrt()
    assert float(moved.max() / moved.min()) < 1.05
    assert float(angles.max()) < 2 * float(angles.median())


def test_training_path_uses_a_tour_if_names_are_not_in_order():
    cameras = ring(30, 3.0, 3.0, turn=5.0)
    names = [f"{(7 * i) % 30:02d}" for i in range(30)]
    path = training_path(cameras, names, 100, 3.0)
    length = float(speeds(path, closed=False).sum())
    assert length == pytest.approx(3.0 * 5.0 * 29 / 30, rel=0.05)


def test_portrait_photos_do_not_roll_the_path():
    quarter = rotation_from_quat(torch.tensor([0.5**0.5, 0, 0, 0.5**0.5]).double())
    cameras = ring(30, 3.0, 3.0, turn=3.0)
    for i in (0, 4, 5, 6, 17):
        c = cameras[i]
        pose = quarter @ c.cam_from_world
        cameras[i] = Camera(48, 64, 60.0, 60.0, 24.0, 32.0, pose)
    path = training_path(cameras, [f"{i:02d}" for i in range(30)], 90, 3.0)
    assert float(rolls(path).abs().max()) < 0.02
    assert {(camera.width, camera.height) for camera in path} == {(64, 48)}


def keys() -> list[Camera]:
    places = [(0.0, 0.0, -3.0), (2.0, -0.5, -2.0), (3.0, -1.0, 0.5), (2.0, 0.3, 3.0)]
    return [camera_at(place) for place in places]


def test_key_path_passes_through_its_keys():
    given = keys()
    path = key_path(given, 400, 3.0)
    for key in given:
        nearest = min(path, key=lambda camera: float((camera.position - key.position).norm()))
        assert float((nearest.position - key.position).norm()) < 0.02
        turned = nearest.cam_from_world[:, :3] - key.cam_from_world[:, :3]
        assert float(turned.norm()) < 0.02
    torch.testing.assert_close(path[0].cam_from_world, given[0].cam_from_world)
    torch.testing.assert_close(path[-1].cam_from_world, given[-1].cam_from_world)
    moved = (speeds(path, False).square() / 9 + turns(path, False).square()).sqrt()
    assert float(moved.max() / moved.min()) < 1.02


def test_an_eased_path_is_the_same_way_at_another_speed():
    given = ring(5, 3.0, 3.0, turn=3.0)
    even, eased = key_path(given, 101, 3.0), key_path(given, 101, 3.0, ease=True)
    # After a quarter of the time, 3t² − 2t³ of the way is done.
    for at in (0, 25, 50, 75, 100):
        way = (at / 100) ** 2 * (3 - 2 * at / 100)
        there = interpolate_position(even, 100 * way)
        assert float((eased[at].position - there).norm()) < 1e-3
    steps = speeds(eased, closed=False)
    assert float(steps[0]) < 0.1 * float(steps.median()) > float(steps[-1])


def interpolate_position(path: list[Camera], at: float) -> torch.Tensor:
    before = min(int(at), len(path) - 2)
    one, two = path[before].position, path[before + 1].position
    return one + (at - before) * (two - one)


def test_key_path_that_ends_at_its_start_is_a_loop():
    given = [keys()[i] for i in (0, 1, 2, 3)]
    given += [camera_at((-2.5, -0.4, 1.0)), given[0]]
    path = key_path(given, 100, 3.0)
    steps = speeds(path, closed=True)
    assert float(steps[-1]) == pytest.approx(float(steps[0]), rel=0.1)
    # There is no corner: the direction changes at the start as little as elsewhere.
    places = positions(path)
    ways = torch.nn.functional.normalize(places.roll(-1, 0) - places, dim=1)
    bends = (ways * ways.roll(1, 0)).sum(1)
    assert float(bends[0]) > float(bends.min()) - 1e-3
    assert float(bends.min()) > math.cos(0.3)


def test_three_keys_and_the_first_again_are_a_loop():
    """The last frame is one step before the first. With two keys, the path goes there and back."""
    one, two, three = keys()[:3]
    steps = speeds(key_path([one, two, three, one], 20, 3.0), closed=True)
    assert float(steps[-1]) == pytest.approx(float(steps[0]), rel=0.1)
    back = key_path([one, two, one], 5, 3.0)[-1]
    torch.testing.assert_close(back.cam_from_world, one.cam_from_world)


def test_key_path_takes_the_shortest_rotation_and_zooms():
    """From −170° to 170° the path rotates by 20°. The fields of view are those of the keys."""
    origin = torch.zeros(3).double()

    def looking(degrees: float, fx: float) -> Camera:
        t = math.radians(degrees)
        target = torch.tensor([math.sin(t), 0.0, math.cos(t)]).double()
        return Camera(64, 48, fx, fx, 32.0, 24.0, look_at(origin, target, UP))

    path = key_path([looking(-170, 50.0), looking(170, 80.0)], 50, 3.0)
    assert float(turns(path, closed=False).sum()) == pytest.approx(math.radians(20), rel=0.01)
    assert path[0].fx == pytest.approx(50.0)
    assert path[-1].fx == pytest.approx(80.0)
    assert path[-1].fy == pytest.approx(80.0)
    widths = [camera.fx for camera in path]
    assert widths == sorted(widths)


def test_equal_keys_count_once_and_a_single_key_is_rejected():
    one, two = keys()[:2]
    with pytest.raises(UserError, match="needs two that differ"):
        key_path([one, one, one], 10, 3.0)
    path = key_path([one, one, two, two], 10, 3.0)
    assert all(bool(camera.cam_from_world.isfinite().all()) for camera in path)
    assert len(key_path([one, two], 1, 3.0)) == 1


def test_a_key_has_a_speed():
    keys = [
        camera_at((x, 0.0, 0.0), torch.tensor([x, 0.0, 5.0]).double()) for x in (-1.0, 0.0, 1.0)
    ]
    even = key_path(keys, 201, 3.0)
    same = key_path(keys, 201, 3.0, speeds=[2.0, 2.0, 2.0])
    assert torch.allclose(positions(even), positions(same), atol=1e-12)
    path = key_path(keys, 2001, 3.0, speeds=[1.0, 4.0, 1.0])
    passed = speeds(path, closed=False)
    assert float(passed[1000] / passed[0]) == pytest.approx(4.0, rel=0.02)
    half = int((positions(path)[:, 0] + 0.5).abs().argmin())  # half of the way, in equal ratios
    assert float(passed[half] / passed[0]) == pytest.approx(2.0, rel=0.02)
    # A loop: the first key, which is also the last one, is slow.
    around = ring(6, 3.0, 3.0)
    path = key_path([*around, around[0]], 1200, 3.0, speeds=[0.25, 1, 1, 1, 1, 1, 0.25])
    passed = speeds(path, closed=True)
    opposite = int((positions(path) - around[3].position).norm(dim=1).argmin())
    assert float(passed[0] / passed[opposite]) == pytest.approx(0.25, rel=0.03)
    assert float(passed[-1] / passed[opposite]) == pytest.approx(0.25, rel=0.03)
