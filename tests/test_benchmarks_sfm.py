"""`benchmarks/sfm.py` runs on a small scene, and tells correct from wrong poses."""

import json
import math
from pathlib import Path

import pytest
import torch

from snowsplat.scene.geometry import Similarity, invert_rigid, rotation_from_quat
from snowsplat.synthetic import light

from . import fork_server

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"

pytestmark = pytest.mark.slow


def benchmark(*arguments: object) -> str:
    """The output of the script."""
    run = fork_server.run(BENCHMARKS / "sfm.py", *arguments)
    assert run.returncode == 0, run.stderr
    return run.stdout


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


def test_the_limits_of_a_correct_pose(sfm_modules):
    import sfm_placed

    true = poses_on_a_spiral(40)
    found = dict(true)
    limit = math.radians(sfm_placed.MAX_ROTATION) / 2
    extent = sfm_placed.placed(found, true).extent
    for name, share in (("003.jpg", 0.95), ("004.jpg", 1.05)):
        turn = torch.tensor([math.cos(share * limit), 0.0, math.sin(share * limit), 0.0]).double()
        rotation = rotation_from_quat(turn)
        found[name] = rotation @ true[name]  # about its own centre
    for name, share in (("013.jpg", 0.9), ("014.jpg", 1.1)):
        found[name] = true[name].clone()
        found[name][2, 3] += share * sfm_placed.MAX_CENTRE * extent
    result = sfm_placed.placed(found, true)
    assert result.wrong == ["004.jpg", "014.jpg"]
    one = {"000.jpg": true["000.jpg"]}
    assert sfm_placed.placed(one, true).wrong == ["000.jpg"]
    assert sfm_placed.placed({}, true).missing == sorted(true)


def test_scenes_for_structure_from_motion(sfm_modules, tmp_path, monkeypatch):
    """Paths stay inside of the scenes, and photos are rendered only once."""
    from sfm_scenes import KINDS, photos_of

    # Light at fewer points: building the scenes takes most of the time.
    monkeypatch.setattr(light, "_SPACING", 0.1)
    monkeypatch.setattr(light, "_MOST_POINTS", 12)
    folder, truth = photos_of("twins", 4, tmp_path, (48, 36))
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == list(truth.poses)
    before = [file.stat().st_mtime_ns for file in files]
    again = photos_of("twins", 4, tmp_path, (48, 36))
    assert [file.stat().st_mtime_ns for file in files] == before
    assert all(torch.equal(again[1].poses[name], truth.poses[name]) for name in truth.poses)
    assert photos_of("twins", 4, tmp_path, (48, 36), seed=1)[0] != folder
    limits = {"room": 3, "plain": 3, "carpet": 3, "twins": 4.7, "rooms": 4.3}
    for kind, half in limits.items():
        for count in (60, 500):
            poses = torch.stack(KINDS[kind].path(count, 0))
            centres = invert_rigid(poses)[..., 3]
            assert len(centres) == count
            assert centres[:, 0].abs().max() < half
            assert 0.9 < centres[:, 2].min() < centres[:, 2].max() < 2.1


@pytest.mark.nightly
def test_stages_and_places(tmp_path):
    file = tmp_path / "sfm.json"
    text = benchmark(
        *("room-20", "walkaround.mp4", "--size", "320x240", "--effort", "draft"),
        *("--datasets", tmp_path, "--cache", tmp_path / "scenes", "--threads", 1, "--json", file),
    )
    assert f"walkaround.mp4: skipped, not in {tmp_path}" in text
    (found,) = json.loads(file.read_text())
    stages = found["stages"]
    assert stages.keys() >= {"decode", "features", "choose pairs", "match", "map", "undistort"}
    for stage in ("decode", "features", "match", "map", "undistort"):
        assert stages[stage]["wall"] > 0, stage
        assert stages[stage]["cpu"] > 0, stage
    assert sum(times["cpu"] for times in stages.values()) == pytest.approx(found["cpu"])
    assert found["photos"] == 20
    assert found["correct"] + len(found["wrong"]) == found["placed"]
    assert found["correct"] >= 18
    assert len(found["rotation_errors"]) == found["correct"]
    assert found["rotation_error"] < 1
    assert found["peak_mb"] > 50
    assert found["points"] > 100
    header, line = text.splitlines()[1:3]
    assert header.split()[:4] == ["photos", "correct", "wrong", "none"]
    cells = line.split()
    assert cells[:3] == ["room-20", "20", str(found["correct"])]
    assert cells[4] == str(20 - found["placed"])


def test_a_failure_is_a_row_of_the_table(tmp_path):
    text = benchmark(
        *("carpet-3", "--size", "64x48", "--effort", "draft"),
        *("--cache", tmp_path, "--json", tmp_path / "sfm.json"),
    )
    (found,) = json.loads((tmp_path / "sfm.json").read_text())
    assert found["error"] in text
    assert (found["placed"], found["correct"], len(found["missing"])) == (0, 0, 3)
