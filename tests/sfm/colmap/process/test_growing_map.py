"""Messages about the photos that have a pose so far."""

import json

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.process import growing_map
from snowsplat.sfm.colmap.process.growing_map import PoseMessages, read_poses

pytestmark = pytest.mark.sfm


def synthetic(points: int) -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig, options.num_points3D = 4, points
    return pycolmap.synthesize_dataset(options)


def test_a_message_has_the_poses_of_the_model():
    model, sent = synthetic(10), []
    PoseMessages(lambda message: sent.append(json.dumps(message)))(model, False)
    photos, points = read_poses(json.loads(sent[0]))
    images = {image.name: image for image in model.images.values()}
    assert {photo.name for photo in photos} == set(images)
    for photo in photos:
        image = images[photo.name]
        np.testing.assert_allclose(photo.centre, image.projection_center(), atol=2e-3)
        assert photo.half_width == pytest.approx(
            image.camera.width / 2 / image.camera.mean_focal_length(), rel=1e-4
        )
    expected = np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(np.sort(points, 0), np.sort(expected, 0), rtol=1e-3)


def test_many_points_are_thinned(monkeypatch):
    monkeypatch.setattr(growing_map, "_MAX_POINTS", 100)
    sent = []
    PoseMessages(sent.append)(synthetic(900), False)
    assert 50 <= len(read_poses(sent[0])[1]) <= 100


def test_no_more_than_a_message_in_a_pause(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(growing_map.time, "monotonic", lambda: now[0])
    model, sent = synthetic(3), []
    send = PoseMessages(sent.append)
    for seconds, forced, total in ((0, False, 1), (1.9, False, 1), (0.05, True, 2), (2, False, 3)):
        now[0] += seconds
        send(model, forced)
        assert len(sent) == total

    def slowly(message):  # a message takes 2 s: less than 0.5% of the time are messages
        now[0] += 2
        sent.append(message)

    slow = PoseMessages(slowly)
    slow(model, False)
    now[0] += 399
    slow(model, False)
    assert len(sent) == 4
    now[0] += 2
    slow(model, False)
    assert len(sent) == 5


def test_a_point_at_infinity_is_left_out():
    message = {"photos": [], "points": [1.0, 2.0, 3.0, 1.0, float("inf"), 0.0]}
    np.testing.assert_array_equal(read_poses(message)[1], [[1.0, 2.0, 3.0]])
