"""Bars are cut off, other fixed parts are masked, and the originals are never changed."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ...pictures import HEIGHT, WIDTH, gathered, pan, write_video

pytestmark = pytest.mark.slow  # writes and decodes photos and videos


def pictures(count=8) -> list[np.ndarray]:
    return [picture.copy() for picture in pan(count)]


def with_logo(count=8) -> list[np.ndarray]:
    """Photos of a moving camera with a logo at the upper left."""
    made = pictures(count)
    for picture in made:
        picture[8:32, 8:72] = 0
        picture[12:28, 12:68:8] = 255
        picture[16:24, 12:64] = 255
    return made


def with_bars(count=8) -> list[np.ndarray]:
    made = pictures(count)
    for picture in made:
        picture[:, :40] = picture[:, -40:] = 0
    return made


def folder_of(folder: Path, made: list[np.ndarray], ending="jpg") -> Path:
    folder.mkdir(parents=True)
    for i, picture in enumerate(made):
        Image.fromarray(picture).save(folder / f"{i}.{ending}", quality=95)
    return folder


def mask(dataset: Path, name: str) -> np.ndarray:
    with Image.open(dataset / "distorted" / "masks" / f"{name}.png") as image:
        return np.asarray(image) > 0


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_bars_are_cut_off_copies_of_the_photos(tmp_path, ending):
    source = folder_of(tmp_path / "p", with_bars(), ending)
    before = {path.name: path.read_bytes() for path in source.iterdir()}
    made = gathered(source, tmp_path / "out")
    width = made.photos[0].width
    assert WIDTH - 90 <= width <= WIDTH - 80
    assert {(p.width, p.height, p.mask) for p in made.photos} == {(width, HEIGHT, False)}
    for photo in made.photos:
        with Image.open(tmp_path / "out" / "input" / photo.name) as image:
            assert image.size == (width, HEIGHT)
            assert np.asarray(image.convert("L")).mean(axis=0).min() > 40
    assert [str(note) for note in made.notes] == [
        "bars at the left and right: cut off in all 8 photos"
    ]
    assert {path.name: path.read_bytes() for path in source.iterdir()} == before
    assert not [path for path in (tmp_path / "out" / "input").iterdir() if path.name[0] == "."]


def test_bars_are_masked_if_the_photos_are_used_in_place(tmp_path):
    source = folder_of(tmp_path / "out" / "input", with_bars())
    before = {path.name: path.read_bytes() for path in source.iterdir()}
    made = gathered(source, tmp_path / "out")
    assert {(p.width, p.height, p.mask) for p in made.photos} == {(WIDTH, HEIGHT, True)}
    used = mask(tmp_path / "out", "0.jpg")
    assert not used[:, :40].any()
    assert not used[:, -40:].any()
    assert used[:, 46:-46].all()
    assert [str(note) for note in made.notes] == [
        "bars at the left and right: masked in all 8 photos"
    ]
    assert {path.name: path.read_bytes() for path in source.iterdir()} == before


def test_the_radius_of_a_disc_is_known_in_pixels_of_the_photo(tmp_path):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    radius = 0.45 * HEIGHT
    dark = np.hypot(columns - WIDTH / 2, rows - HEIGHT / 2) > radius
    made = pictures()
    for picture in made:
        picture[dark] = 0
    large = [np.kron(picture, np.ones((2, 2, 1), np.uint8)) for picture in made]
    photos = gathered(folder_of(tmp_path / "p", large), tmp_path / "out").photos
    assert photos[0].width == 2 * WIDTH
    assert [photo.circle for photo in photos] == pytest.approx([2 * radius] * 8, rel=0.03)


def test_a_logo_is_masked_together_with_the_masks_of_the_user(tmp_path):
    source = folder_of(tmp_path / "p", with_logo())
    own = np.full((HEIGHT, WIDTH), 255, np.uint8)
    own[-30:] = 0
    (source / "masks").mkdir()
    Image.fromarray(own).save(source / "masks" / "0.jpg.png")
    made = gathered(source, tmp_path / "out")
    assert all(photo.mask for photo in made.photos)
    assert (tmp_path / "out" / "input" / "0.jpg").samefile(source / "0.jpg")
    first, second = (mask(tmp_path / "out", name) for name in ("0.jpg", "1.jpg"))
    for used in (first, second):
        assert not used[8:32, 8:72].any()
        assert used[60:-30, 130:].all()
    assert not first[-30:].any()
    assert second[-30:].all()
    (note,) = made.notes
    assert str(note).startswith("something does not move")


def test_five_photos_and_transparent_photos_are_left_alone(tmp_path):
    few = gathered(folder_of(tmp_path / "few", with_logo(5)), tmp_path / "a")
    made = pictures()
    for i, picture in enumerate(made):
        alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        alpha[:, :40] = 0
        picture[:, :40] = 0
        made[i] = np.concatenate([picture, alpha], axis=2)
    transparent = gathered(folder_of(tmp_path / "cut", made, "png"), tmp_path / "b")
    assert few.notes == transparent.notes == []
    assert not any(photo.mask for photo in few.photos)
    assert transparent.photos[0].width == WIDTH


def test_a_video_with_bars_and_logos_moves(tmp_path):
    """The logos cover more blocks of the frame than the scene, but the camera moves."""
    frames = []
    for picture in pan(40, 3):
        frame = np.zeros((HEIGHT, 3 * WIDTH, 3), np.uint8)
        frame[:, WIDTH : 2 * WIDTH] = picture
        frame[::16, : WIDTH - 20] = frame[::16, 2 * WIDTH + 20 :] = 255
        frame[:, : WIDTH - 20 : 16] = frame[:, 2 * WIDTH + 20 :: 16] = 255
        frames.append(frame)
    video = write_video(tmp_path / "v.mp4", frames)
    made = gathered(video, tmp_path / "out")
    assert len(made.photos) >= 10
    assert [str(note) for note in made.notes] == [
        "v.mp4: bars at the left and right: cut off in all frames"
    ]
    for photo in made.photos:
        assert photo.height == HEIGHT
        assert WIDTH - 16 <= photo.width <= WIDTH
        with Image.open(tmp_path / "out" / "input" / photo.name) as image:
            assert image.size == (photo.width, photo.height)


def test_bars_of_a_rotated_video_are_cut_off_at_the_right_sides(tmp_path):
    frames = []
    for frame in pan(30, 3):
        frame = frame.copy()
        frame[:40] = frame[-40:] = 0
        frames.append(frame)
    made = gathered(write_video(tmp_path / "v.mp4", frames, rotation=90), tmp_path / "out")
    assert {photo.height for photo in made.photos} == {WIDTH}
    assert HEIGHT - 92 <= made.photos[0].width <= HEIGHT - 80
    with Image.open(tmp_path / "out" / "input" / made.photos[0].name) as image:
        assert np.asarray(image.convert("L")).mean(axis=0).min() > 40
