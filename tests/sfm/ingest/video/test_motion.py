"""Camera motion between frames, and the distance that the picture has moved."""

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.video.motion import FrameMotion, has_moved

from ...pictures import blurred, grey, noisy, pan, wall


def textures(count: int) -> list[np.ndarray]:
    """Pictures of ``count`` different scenes, without a common part."""
    return [wall(seed=i, width=640, height=480)[80:, 64:] for i in range(count)]


def path(pictures) -> list[float]:
    motion = FrameMotion()
    return [motion.add(np.asarray(Image.fromarray(picture).convert("L"))) for picture in pictures]


@pytest.mark.parametrize("level", [0, 2, 6])
def test_noise_is_not_motion(level):
    still = wall()
    assert not has_moved(grey(noisy(still, level, 1)), grey(noisy(still, level, 2)))


def test_camera_motion_is_detected():
    frames = [grey(frame) for frame in pan(10, step=4)]
    assert has_moved(frames[0], frames[1])
    assert has_moved(frames[0], frames[9])
    assert not has_moved(frames[3], frames[3])


def test_a_moving_object_is_not_camera_motion():
    before, after = wall().copy(), wall().copy()
    before[60:200, 40:100] = wall(seed=5)[60:200, 40:100]
    after[60:200, 140:200] = wall(seed=5)[60:200, 40:100]
    assert not has_moved(grey(before), grey(after))


def test_a_change_of_light_is_not_camera_motion():
    assert not has_moved(grey(wall()), grey((wall() * 0.8).astype(np.uint8)))


def test_images_without_texture_and_tiny_images():
    flat = np.full((240, 320), 120, np.uint8)
    assert not has_moved(flat, flat)
    assert has_moved(flat, flat + 20)
    assert not has_moved(flat[:20], flat[:20])


@pytest.mark.parametrize("step", [1, 2, 5, 12])
def test_the_distance_of_a_pan(step):
    pictures = pan(30, step=step)
    true = step * 29 / 320
    assert path(pictures)[-1] == pytest.approx(true, rel=0.1)


def test_motion_blur_does_not_hide_the_motion():
    positions = pan(100, step=3)
    # The exposure lasts for the whole time between two frames, and the lens is out of focus.
    smeared = [np.mean(positions[i : i + 4], axis=0).astype(np.uint8) for i in range(0, 96, 4)]
    soft = [blurred(picture, 3) for picture in smeared]
    true = 3 * 4 * 23 / 320
    assert path(smeared)[-1] == pytest.approx(true, rel=0.15)
    assert path(soft)[-1] == pytest.approx(true, rel=0.2)


def test_rotation_and_zoom_are_motion():
    image = Image.fromarray(wall(width=480, height=480))
    turned = [np.asarray(image.rotate(3 * i)) for i in range(30)]
    sizes = [240 * 0.98**i for i in range(30)]
    zoomed = [
        np.asarray(image.resize((480, 480), box=(240 - s, 240 - s, 240 + s, 240 + s)))
        for s in sizes
    ]
    assert path(turned)[-1] > 0.3
    assert path(zoomed)[-1] > 0.1


def test_noise_and_the_shake_of_a_hand_do_not_add_up():
    large, random = wall(width=400, height=300), np.random.default_rng(0)
    offsets = np.clip(random.normal(20, 2, (60, 2)).round().astype(int), 16, 24)
    shaken = [noisy(large[y : y + 240, x : x + 320], 4, i) for i, (y, x) in enumerate(offsets)]
    values = path(shaken)
    assert values[-1] < 0.04
    assert values[-1] == values[30]


def test_the_distance_never_decreases():
    there = pan(10, step=4)
    values = path([*there, *there[::-1]])
    assert values == sorted(values)
    assert values[-1] == pytest.approx(2 * 36 / 320, abs=0.04)


def test_a_cut_is_motion():
    scenes = textures(6)
    steps = np.diff(path([scene for scene in scenes for _ in range(3)]))
    cuts = steps[2::3]
    assert cuts == pytest.approx([16 * 4 / 576] * 5)
    assert np.delete(steps, slice(2, None, 3)).max() == 0


def test_black_frames_and_frames_of_another_size_are_cuts():
    black, scene = np.zeros((240, 320, 3), np.uint8), wall()
    values = path([black, black, scene, scene, scene[:160]])
    assert values[:2] == [0, 0]
    assert 0.09 < values[2] == values[3] < values[4] - 0.09


@pytest.mark.parametrize("shape", [(20, 30), (10, 900), (900, 40), (33, 500)])
def test_narrow_and_tiny_frames(shape):
    picture = np.ascontiguousarray(wall(width=900, height=900)[: shape[0], : shape[1]])
    assert path([picture, picture]) == [0, 0]


def test_what_is_fixed_to_the_frame_does_not_hide_the_motion():
    pictures = [picture.copy() for picture in pan(10, step=4)]
    fixed = np.zeros(pictures[0].shape[:2], bool)
    for top in range(8, 240, 32):  # a grid over most blocks, stronger than the scene
        fixed[top : top + 16] = True
    for picture in pictures:
        picture[fixed] = wall(seed=7)[fixed] // 128 * 255
    first, last = grey(pictures[0]), grey(pictures[3])
    assert not has_moved(first, last)
    assert has_moved(first, last, fixed)
    assert not has_moved(first, first, fixed)
    motion = FrameMotion(fixed)
    values = [motion.add(np.asarray(Image.fromarray(p).convert("L"))) for p in pictures]
    assert path(pictures)[-1] < 0.02
    assert values[-1] == pytest.approx(36 / 320, rel=0.35)
