"""The score by its definition: the true model wins over wrong ones, and why."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.checks.matches import PairMatches, read_matches
from snowsplat.sfm.colmap.checks.score import score_of
from snowsplat.sfm.colmap.lenses.prior import log_prior

from .. import look_alikes

WIDTH, HEIGHT, FOCAL = 1600, 1200, 1280.0
PHOTOS = 10


def turned(angle, axis=(0, 1, 0)):
    return pycolmap.Rotation3d(angle * np.asarray(axis, float))


def poses():
    """Cameras on an arc that look at the origin, three units away."""
    return [pycolmap.Rigid3d(turned(0.12 * i), [0.02 * i, 0, 3]) for i in range(PHOTOS)]


def camera(focal=FOCAL, model="SIMPLE_RADIAL", params=None):
    made = pycolmap.Camera.create_from_model_name(1, model, focal, WIDTH, HEIGHT)
    if params is not None:
        made.params = params
    return made


def model_of(poses, lens=None, without=()):
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(lens or camera())
    for number, pose in enumerate(poses, 1):
        if number not in without:
            image = pycolmap.Image(name=f"{number}.jpg", camera_id=1, image_id=number)
            model.add_image_with_trivial_frame(image, pose)
    return model


@pytest.fixture(scope="module")
def matches():
    """Of all pairs of photos: 200 true ones with an error of 0.7 pixels, and 10 false ones."""
    random = np.random.default_rng(0)
    points = random.uniform(-0.8, 0.8, (200, 3))
    seen = [np.asarray(camera().img_from_cam(pose * points)) for pose in poses()]
    pairs = []
    for one, two in combinations(range(PHOTOS), 2):
        false = random.uniform(0, 1, (2, 10, 2)) * (WIDTH, HEIGHT)
        both = [
            np.concatenate([seen[i] + 0.7 * random.standard_normal((200, 2)), wrong])
            for i, wrong in zip((one, two), false, strict=True)
        ]
        pairs.append(PairMatches(one + 1, two + 1, *both, np.zeros((210, 2), int)))
    return pairs


def bent():
    """The second half is turned about its first camera, as at a turn of the path."""
    made = poses()
    turn = pycolmap.Rigid3d(turned(0.3), [0.5, 0, 0])
    return [*made[:5], *(turn * pose for pose in made[5:])]


def mirrored():
    """The scene behind the cameras: the same epipolar lines, another sign of the depths."""
    return [pycolmap.Rigid3d(pose.rotation, -np.asarray(pose.translation)) for pose in poses()]


def shuffled():
    made = poses()
    made[2], made[7] = made[7], made[2]
    return made


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: model_of(bent()),
        lambda: model_of(mirrored()),
        lambda: model_of(shuffled()),
        lambda: model_of(poses(), camera(0.7 * FOCAL)),
        lambda: model_of(poses(), camera(1.4 * FOCAL)),
        lambda: model_of(poses(), camera(params=[FOCAL, WIDTH / 2, HEIGHT / 2, -0.3])),
        lambda: model_of(poses(), without=(4,)),
        lambda: model_of(poses(), without=(1, 2, 3, 4, 5)),
    ],
    ids=["bent", "mirrored", "shuffled", "short", "long", "barrel", "without one", "half"],
)
def test_the_true_model_wins(matches, wrong):
    true, other = score_of(model_of(poses()), matches, {}), score_of(wrong(), matches, {})
    assert true.total > other.total + 100
    assert true.explained > other.explained


def test_a_photo_in_a_wrong_place_is_worse_than_none(matches):
    wrong = poses()
    wrong[4] = pycolmap.Rigid3d(turned(2.0), [0, 0, 3])
    misplaced = score_of(model_of(wrong), matches, {})
    left_out = score_of(model_of(poses(), without=(5,)), matches, {})
    assert left_out.total > misplaced.total


def test_noise_and_false_matches_are_estimated(matches):
    found = score_of(model_of(poses()), matches, {})
    # Of the two errors of a match, the distance has the part across the line: once, not twice.
    assert found.noise == pytest.approx(0.7, rel=0.05)
    assert found.false == pytest.approx(10 / 210, rel=0.1)
    assert found.explained == pytest.approx(200 / 210, rel=0.02)


def test_scale_rotation_and_position_of_the_whole_do_not_matter(matches):
    whole = pycolmap.Sim3d(2.5, turned(0.7, (1, 0, 0)), [3, -2, 1])
    model = model_of(poses())
    before = score_of(model, matches, {}).total
    model.transform(whole)
    assert score_of(model, matches, {}).total == pytest.approx(before, rel=1e-6)


def test_where_the_matches_say_nothing_the_lens_decides():
    """At one place, all focal lengths have the same epipolar lines: there are none."""
    with_exif = [log_prior(camera(factor * FOCAL), FOCAL) for factor in (1.0, 1.05, 1.2, 3.0)]
    assert with_exif == sorted(with_exif, reverse=True)
    assert with_exif[0] - with_exif[1] == pytest.approx(0.5, rel=0.1)  # one standard deviation
    # EXIF may be wrong, so a contradiction costs no more than this.
    assert with_exif[0] - with_exif[2] < 8
    usual, tele = (log_prior(camera(focal), None) for focal in (FOCAL, 20 * WIDTH))
    assert usual > tele + 10


def test_a_walk_past_two_places_that_look_alike_is_not_folded(tmp_path):
    """The folded model agrees with the false matches, and contradicts true ones."""
    scene = look_alikes.walk(1600)
    pairs = read_matches(look_alikes.write_database(tmp_path / "database.db", scene))
    true, folded = (score_of(look_alikes.model(scene, fold), pairs, {}) for fold in (False, True))
    assert true.total > folded.total + 1000
