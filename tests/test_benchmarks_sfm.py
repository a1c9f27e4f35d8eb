"""`benchmarks/sfm.py` tells correct from wrong poses."""

import math
from pathlib import Path

import pytest
import torch

from snowsplat.scene.geometry import Similarity, rotation_from_quat

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"

pytestmark = pytest.mark.slow


@pytest.fixture
def sfm_modules(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def poses_on_a_spiral(count):
    poses = {}
    for i in range(count):
        turn = torch.tensor([math.cos(i / 9), 0.0, math.sin(i / 9), 0.1]).double()
        centre = torch.tensor([math.cos(i / 5), math.sin(i / 5), i / count]).double()
        rotation = rotation_from_quat(turn / turn.norm())
        poses[f"{i:03d}.jpg"] = torch.cat([rotation, -(rotation @ centre)[:, None]], 1)
    return poses


def in_another_frame(poses, scale, shift=0.0):
    turn = rotation_from_quat(torch.tensor([0.3, -0.5, 0.7, 0.2]).double())
    similarity = Similarity(scale, turn, torch.tensor([4.0 + shift, -1.0, 9.0]))
    return {name: similarity.apply_to_poses(pose) for name, pose in poses.items()}


def test_wrong_photos_do_not_spoil_the_alignment(sfm_modules):
    from sfm_placed import placed

    true = poses_on_a_spiral(50)
    found = in_another_frame(true, 7.5)
    names = sorted(true)
    # The largest consistent part has 20 photos. 13 photos are a part at another place, 12 are at
    # the places of others, and five are missing.
    moved = names[20:33]
    found |= in_another_frame({name: true[name] for name in moved}, 7.5, shift=5.0)
    swapped = names[33:45]
    found |= {name: found[names[i]] for i, name in enumerate(swapped)}
    for name in names[45:]:
        del found[name]
    result = placed(found, true)
    assert result.correct == names[:20]
    assert result.wrong == names[20:45]
    assert result.missing == names[45:]
    assert result.rotations.max() < 1e-6
    assert result.centres.max() < 1e-9
