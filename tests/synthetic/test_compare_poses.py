"""Errors of estimated poses are those that a similarity transform cannot explain."""

import math

import pytest
import torch

from snowsplat.scene.geometry import Similarity, compose_rigid, rotation_from_quat
from snowsplat.synthetic.compare_poses import compare_poses


@pytest.fixture
def true():
    random = torch.Generator().manual_seed(3)
    poses = {}
    for i in range(12):
        quat = torch.randn(4, generator=random, dtype=torch.float64)
        shift = torch.randn(3, 1, generator=random, dtype=torch.float64)
        poses[f"IMG_{i:02d}.jpg"] = torch.cat([rotation_from_quat(quat), shift], 1)
    return poses


def in_another_frame(poses):
    turn = rotation_from_quat(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64))
    similarity = Similarity(7.5, turn, torch.tensor([4.0, -1.0, 9.0]))
    return {name: similarity.apply_to_poses(pose) for name, pose in poses.items()}, similarity


def test_a_similarity_transform_is_not_an_error(true):
    found, _ = in_another_frame(true)
    errors = compare_poses(found, true)
    assert errors.names == sorted(true)
    assert errors.missing == []
    assert errors.rotations.max() < 1e-6
    assert errors.centres.max() < 1e-9


def test_known_errors_are_measured(true):
    found, _ = in_another_frame(true)
    # One camera is rotated by a quarter of a degree about its own centre.
    half = math.radians(0.25) / 2
    turn = rotation_from_quat(torch.tensor([math.cos(half), 0.0, math.sin(half), 0.0]).double())
    still = torch.zeros(3, 1, dtype=torch.float64)
    found["IMG_04.jpg"] = compose_rigid(torch.cat([turn, still], 1), found["IMG_04.jpg"])
    errors = compare_poses(found, true)
    assert errors.rotations[4] == pytest.approx(0.25, abs=1e-6)
    assert errors.rotations.median() < 1e-6
    assert errors.centres.max() < 1e-9


def test_a_moved_centre_is_a_fraction_of_the_extent():
    """There are many cameras along x, so one moved camera hardly changes the alignment."""
    true = {}
    for i in range(400):
        centre = torch.tensor([i / 399 * 10, math.sin(i), math.cos(i)], dtype=torch.float64)
        eye = torch.eye(3, dtype=torch.float64)
        true[f"{i:03d}"] = torch.cat([eye, -centre[:, None]], 1)
    found = {name: pose.clone() for name, pose in true.items()}
    found["200"][1, 3] += 0.1
    errors = compare_poses(found, true)
    assert errors.extent == pytest.approx(10, rel=0.03)
    assert errors.centres[200] == pytest.approx(0.1 / errors.extent, rel=0.02)
    assert errors.centres.median() < 1e-3 * errors.centres[200] + 1e-4


def test_a_rotation_by_180_degrees(true):
    found = {name: pose.clone() for name, pose in true.items()}
    upside_down = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    found["IMG_00.jpg"] = upside_down @ found["IMG_00.jpg"]
    assert compare_poses(found, true).rotations[0] == pytest.approx(180)


def test_missing_poses_are_named(true):
    found, _ = in_another_frame(true)
    del found["IMG_07.jpg"]
    found["elsewhere.jpg"] = found["IMG_01.jpg"]
    errors = compare_poses(found, true)
    assert errors.missing == ["IMG_07.jpg"]
    assert len(errors.names) == len(errors.rotations) == len(errors.centres) == 11


def test_two_poses_are_not_enough(true):
    two = {name: true[name] for name in list(true)[:2]}
    with pytest.raises(ValueError, match="2 poses in common"):
        compare_poses(two, true)
