"""The quality, size and number of photos that `make` chooses for a time budget."""

import re
import shutil

import pytest

from snowsplat.pipeline.make_plan import (
    MakePlan,
    choose_plan,
    described,
    expected,
    expected_seconds,
    given_poses,
)
from snowsplat.pipeline.observer import Observer
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.sfm.cost import Photos, Speed, steps_of
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.synthetic.toy_dataset import write_toy_dataset

FAST = Speed(0.1, 16)
HERE = Speed(1.0, 2)


def of_photos(count: int, longest: int = 4000) -> Photos:
    return Photos(stills=count, longest=longest)


def seconds_of(plan: MakePlan, found: Photos, speed: Speed) -> float:
    count = found.stills if plan.photos is None else plan.photos
    photos = Photos(stills=count, longest=found.longest)
    steps = steps_of(photos, plan.size, plan.quality).values()
    return sum(step.seconds(speed) for step in steps)


@pytest.mark.parametrize("count", [10, 50, 100, 150, 300])
@pytest.mark.parametrize("minutes", [1, 3, 10, 60])
@pytest.mark.parametrize("speed", [FAST, HERE, Speed(2.0, 1.2)])
def test_the_poses_leave_more_than_half_of_the_time_to_the_training(count, minutes, speed):
    found = of_photos(count)
    plan = choose_plan(60 * minutes, found, speed)
    fewest = (plan.photos or count) <= 20
    assert fewest or seconds_of(plan, found, speed) <= 0.45 * 60 * minutes


def test_more_time_never_leads_to_less_quality_or_fewer_photos():
    order = ["draft", "normal", "best"]

    def rank(minutes: float) -> tuple[int, int, int]:
        plan = choose_plan(60 * minutes, of_photos(200), HERE)
        return order.index(plan.quality), plan.size, plan.photos or 200

    ranks = [rank(minutes) for minutes in (0.1, 0.5, 1, 2, 3, 5, 8, 15, 30, 60, 120, 600)]
    assert ranks == sorted(ranks)
    assert ranks[0] == (0, 1000, 20)
    assert ranks[-1] == (2, 3200, 200)


def test_a_slow_machine_uses_fewer_photos_than_a_fast_one():
    found = of_photos(300)
    slow, fast = (choose_plan(120, found, Speed(slowness, 2)) for slowness in (3.0, 1.0))
    assert slow.photos is not None
    assert fast.photos is not None
    assert 20 <= slow.photos < fast.photos < 300


def test_the_requested_quality_is_kept():
    found = of_photos(300)
    plan = choose_plan(180, found, HERE, "normal")
    assert plan.quality == "normal"
    assert plan.size == 1600
    assert plan.photos is not None
    assert choose_plan(1e6, found, HERE, "normal") == MakePlan("normal", 2400)


def test_few_photos_are_all_used():
    assert choose_plan(1, of_photos(12), HERE) == MakePlan("draft", 1000)


def test_fewer_frames_of_each_video_and_fewer_photos():
    found = Photos(stills=100, longest=4000, frames=200, videos=2, decoded=1200, video=1920)
    plan = choose_plan(100, found, HERE)
    assert plan.photos is not None
    assert plan.frames is not None
    assert plan.photos == pytest.approx(plan.frames, abs=1)  # 1/3 of the count, in both videos
    assert str(described(plan, found, 100)) == (
        f"1 min 40 s: {plan.photos} of 100 photos and {2 * plan.frames} of 200 frames, "
        "1000 pixels, draft effort"
    )


def test_a_single_photo_beside_a_long_video_is_kept():
    found = Photos(stills=1, longest=4000, frames=300, videos=1, decoded=9000, video=1920)
    plan = choose_plan(30, found, HERE)
    assert plan.photos in (1, None)
    assert plan.frames is not None
    assert 3 <= plan.frames <= 20


def test_the_description_names_what_was_chosen():
    found = of_photos(300)
    assert str(described(MakePlan("draft", 1000, photos=60), found, 180)) == (
        "3 min 0 s: 60 of 300 photos, 1000 pixels, draft effort"
    )
    assert str(described(MakePlan("best", 3200), of_photos(40, 3000), 3600)) == (
        "1 h 0 min: 40 photos, 3000 pixels, best effort"
    )


def test_what_is_expected_in_one_line():
    """Given poses leave only the training; a slower machine needs the longer time."""
    found = of_photos(36)
    seconds = expected_seconds("draft", found, HERE)
    assert str(expected("draft", found, 180.0)) == "36 photos, draft: about 3 min 0 s"
    assert expected_seconds("draft", found, HERE, poses=False) < seconds
    assert expected_seconds("draft", found, Speed(2.0, 2)) == pytest.approx(2 * seconds)


class Lines(Observer):
    def __init__(self):
        self.lines = []

    def note(self, line):
        self.lines.append(str(line))


@pytest.fixture
def root(tmp_path):
    return write_toy_dataset(tmp_path / "scan", "colmap-txt", 8)


def used(root):
    """Whether the poses in ``root`` are used, and the lines about them."""
    observer = Lines()
    sources = find_sources([root])
    found = given_poses(sources, DatasetSettings(str(sources.posed)), observer)
    return found is not None, observer.lines


def keep_images(root, count):
    """Leave only the first poses in the model."""
    path = root / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines(True) if line[0] != "#"]
    path.write_text("".join(lines[: 2 * count]))


def test_poses_are_used_and_photos_without_one_are_named(root):
    assert used(root)[0]
    keep_images(root, 6)
    yes, (first, second) = used(root)
    assert yes
    assert "its camera poses are used" in first
    assert f"snowsplat make {root}/images" in first
    assert "2 of 8 photos have no pose" in second
    assert "view_06.png" in second


def test_undistorted_copies_have_the_poses_of_the_photos(root):
    shutil.copytree(root / "images", root / "input")
    (root / "input/view_00.png").rename(root / "input/extra.png")
    yes, (_, line) = used(root)
    assert yes
    assert "1 of 8 photos have no pose" in line
    assert "extra.png" in line


def test_poses_of_few_photos_are_not_used(root):
    keep_images(root, 3)
    yes, (line,) = used(root)
    assert not yes
    assert "estimated again: 5 of 8 photos have no pose" in line


def test_impossible_and_damaged_poses_are_not_used(root):
    cameras = root / "sparse/0/cameras.txt"
    text = cameras.read_text()
    cameras.write_text(re.sub(r"PINHOLE 64 48 \S+ \S+", "PINHOLE 64 48 1.1 1.1", text))
    yes, (line,) = used(root)
    assert not yes
    assert "field of view" in line
    cameras.write_text(text.replace("PINHOLE", "PINHOLED"))
    yes, (line,) = used(root)
    assert not yes
    assert "PINHOLED" in line
