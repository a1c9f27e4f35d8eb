"""What is fixed to the frame is found; what moves, however little, is not."""

import cv2
import numpy as np
import pytest

from snowsplat.sfm.ingest.content.fixed_parts import box_of, describe, find_fixed_parts
from snowsplat.util.messages import message

from ...pictures import HEIGHT, WIDTH, blurred, pan, wall

ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]


def scene(count=12, step=8) -> np.ndarray:
    """(N, H, W): grey photos of a camera that moves sideways."""
    return np.stack([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pan(count, step)])


def zoom(picture: np.ndarray, factor: float) -> np.ndarray:
    shift = [(1 - factor) * WIDTH / 2, (1 - factor) * HEIGHT / 2]
    matrix = np.float32([[factor, 0, shift[0]], [0, factor, shift[1]]])
    return cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)


def with_text(photos: np.ndarray, texts, at, brightness=255) -> tuple[np.ndarray, np.ndarray]:
    """The photos with a text in each, and (H, W) bool: the pixels of all texts."""
    changed, ever = photos.copy(), np.zeros((HEIGHT, WIDTH), np.uint8)
    for photo, text in zip(changed, texts, strict=True):
        cv2.putText(photo, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, brightness, 1)
        cv2.putText(ever, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255, 1)
    return changed, ever > 0


@pytest.mark.parametrize(("count", "step"), [(6, 8), (12, 8), (20, 3)])
def test_a_moving_camera_has_no_fixed_parts(count, step):
    assert find_fixed_parts(scene(count, step)) is None


def test_a_camera_on_a_tripod_has_no_fixed_parts():
    noise = np.random.default_rng(0).normal(0, 3, (10, HEIGHT, WIDTH))
    still = np.clip(scene(1)[0] * np.linspace(0.9, 1.1, 10)[:, None, None] + noise, 0, 255)
    assert find_fixed_parts(still.astype(np.uint8)) is None


def test_a_wall_that_is_white_in_all_photos_is_no_bar():
    photos = scene()
    for i, photo in enumerate(photos):
        photo[60 + 40 * np.sin(COLUMNS / 40 + i) > ROWS] = 255
    assert find_fixed_parts(photos) is None


def test_a_level_horizon_below_a_white_sky_is_not_fixed():
    photos = scene()
    photos[:, :90] = 255
    assert find_fixed_parts(photos) is None


def test_the_point_to_which_the_camera_moves_is_not_fixed():
    first = scene(1)[0]
    assert find_fixed_parts(np.stack([zoom(first, 1.06**i) for i in range(12)])) is None


def test_five_photos_are_too_few():
    photos, _ = with_text(scene(5), ["REC 2024"] * 5, (10, 20))
    assert find_fixed_parts(photos) is None


def test_bars_are_cut_off_so_that_the_centre_remains():
    photos = scene()
    photos[:, :, :40] = photos[:, :, -41:] = 3
    photos = np.stack([blurred(photo, 0.7) for photo in photos])
    parts = find_fixed_parts(photos)
    assert parts is not None
    assert parts.crop is not None
    assert 40 <= parts.bars[0] <= 43
    assert 41 <= parts.bars[2] <= 44
    assert parts.bars[1] == parts.bars[3] == 0
    left, top, right, bottom = box_of(parts.crop, 10 * WIDTH, 10 * HEIGHT)
    assert (top, bottom) == (0, 10 * HEIGHT)
    assert left + right == 10 * WIDTH
    assert 410 <= left <= 440
    assert not parts.overlays.any()
    assert list(map(str, describe(parts, True, message("all 12 photos")))) == [
        "bars at the left and right: cut off in all 12 photos"
    ]


def test_a_frame_of_bars_with_a_logo_in_it():
    photos = scene()
    photos[:, :30] = photos[:, -30:] = 0
    photos[:, :, :50] = photos[:, :, -50:] = 0
    photos, _ = with_text(photos, ["REC"] * 12, (5, 20))
    parts = find_fixed_parts(photos)
    assert parts is not None
    assert parts.crop is not None
    assert np.abs(np.array(parts.bars) - [50, 30, 50, 30]).max() <= 2


def test_a_single_bar_is_masked_because_the_centre_is_unknown():
    photos = scene()
    photos[:, -40:] = 0
    parts = find_fixed_parts(photos)
    assert parts is not None
    assert parts.crop is None
    assert parts.fixed[-40:].all()
    assert not parts.fixed[:-44].any()
    assert list(map(str, describe(parts, False, message("all 12 photos")))) == [
        "bars at the bottom: masked in all 12 photos"
    ]


def test_a_bright_strip_with_a_text_is_a_bar():
    photos = scene()
    photos[:, -40:] = 250
    photos, _ = with_text(photos, ["SHOT ON A PHONE"] * 12, (10, 225), brightness=20)
    parts = find_fixed_parts(photos)
    assert parts is not None
    assert parts.fixed[-38:].all()
    assert not parts.fixed[:-46].any()


def test_a_clock_is_masked_with_the_digits_that_change():
    times = [f"2024-05-01 12:00:{(37 * i + 13) % 100:02d}" for i in range(12)]
    photos, pixels = with_text(scene(), times, (10, 230))
    parts = find_fixed_parts(photos)
    assert parts is not None
    assert parts.bars == (0, 0, 0, 0)
    assert parts.crop is None
    assert parts.overlays[pixels].all()
    assert parts.fixed.mean() < 0.15
    (line,) = map(str, describe(parts, False, message("all 12 photos")))
    assert line.startswith("something does not move")
    assert "masked in all 12 photos" in line


def test_the_bonnet_of_a_car_is_masked_down_to_the_border():
    photos = scene()
    bonnet = ROWS > 200 + (COLUMNS - WIDTH / 2) ** 2 / 1500
    parts = find_fixed_parts(np.where(bonnet, 230 + photos // 16, photos).astype(np.uint8))
    assert parts is not None
    assert parts.backdrop is None
    assert parts.fixed[bonnet].mean() > 0.95
    assert not parts.fixed[:175].any()


def turntable(count=16) -> tuple[np.ndarray, np.ndarray]:
    """Photos of a plate that turns before a textured wall, and the pixels of the plate.

    In the middle, the plate has one colour and looks the same in all photos.
    """
    back, plate = (cv2.cvtColor(wall(seed=seed), cv2.COLOR_RGB2GRAY) for seed in (1, 2))
    plate[104:137, 120:201] = 128
    square = ((abs(COLUMNS - 160) < 70) & (abs(ROWS - 120) < 30)).astype(np.uint8)
    photos, plates = [], []
    for i in range(count):
        turn = cv2.getRotationMatrix2D((160, 120), 360 * i / count, 1)
        inside = cv2.warpAffine(square, turn, (WIDTH, HEIGHT)) > 0
        photos.append(np.where(inside, cv2.warpAffine(plate, turn, (WIDTH, HEIGHT)), back))
        plates.append(inside)
    noise = np.random.default_rng(0).normal(0, 1, (count, HEIGHT, WIDTH))
    return np.clip(photos + noise, 0, 255).astype(np.uint8), np.stack(plates)


def test_the_background_of_a_turntable_is_masked_in_each_photo():
    photos, plates = turntable()
    parts = find_fixed_parts(photos)
    assert parts is not None
    assert parts.backdrop is not None
    assert not parts.overlays.any()
    assert parts.crop is None
    assert parts.fixed[plates.any(axis=0)].mean() < 0.01
    for photo, plate in zip(photos, plates, strict=True):
        seen = parts.backdrop.seen_in(photo)
        assert seen[~plate].mean() > 0.97
        assert seen[plate].mean() < 0.05
        assert not seen[115:126, 155:166].any()
    (line,) = map(str, describe(parts, False, message("all 16 photos")))
    assert "as on a turntable" in line
