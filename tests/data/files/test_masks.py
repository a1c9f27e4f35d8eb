"""The masks of photos, by each convention, and files that are no masks."""

import random

import numpy as np
import pytest
from PIL import Image

from snowsplat.data.files.masks import find_masks
from snowsplat.data.maps.mask_pixels import looks_like_mask, mask_levels


def photo(path, seed=0):
    """Noise: it does not look like a mask."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (12, 16, 3))
    Image.fromarray(pixels.astype(np.uint8)).save(path)


def mask(path, mode="L"):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.new("L", (16, 12))
    image.paste(255, (4, 3, 12, 9))
    image.convert(mode).save(path)


@pytest.mark.parametrize(
    "name",
    [
        "masks/IMG_1.jpg.png",
        "masks/IMG_1.png",
        "masks/img_1.PNG",
        "masks/IMG_1.jpg",
        "Masks/IMG_1_mask.png",
        "mask/IMG_1.mask.png",
        "masks/IMG_1.jpg.mask.png",
        "masks/mask_IMG_1.png",
        "masks/sub/IMG_1.png",
        "masks/images/sub/IMG_1.png",
        "images/masks/sub/IMG_1.png",
        "images/sub/masks/IMG_1.jpg.png",
        "images/sub/_mask/IMG_1.png",
        "images/sub/IMG_1_mask.png",
        "images/sub/IMG_1.jpg.mask.png",
        "images/sub/IMG_1.jpg.png",
        "images/sub/IMG_1.png",
        "images/sub/dynamic_mask_IMG_1.png",
    ],
)
def test_conventions(name, tmp_path):
    photo(tmp_path / "images/sub/IMG_1.jpg")
    photo(tmp_path / "images/sub/IMG_2.jpg")
    mask(tmp_path / name)
    photos = [
        path.relative_to(tmp_path).as_posix()
        for path in sorted((tmp_path / "images/sub").iterdir())
        if path.is_file()
    ]
    found = find_masks(tmp_path, photos)
    assert found.of == {"images/sub/IMG_1.jpg": tmp_path / name}
    assert found.unused == []
    assert found.beside == (set(photos) - {"images/sub/IMG_1.jpg", "images/sub/IMG_2.jpg"})


def test_the_folder_of_images_given_alone(tmp_path):
    for folder in ("images", "scan1"):
        photo(tmp_path / folder / "1.jpg")
    mask(tmp_path / "masks/1.png")
    assert find_masks(tmp_path / "images", ["1.jpg"]).of == {"1.jpg": tmp_path / "masks/1.png"}
    assert find_masks(tmp_path / "scan1", ["1.jpg"]).of == {}


def test_photos_are_no_masks(tmp_path):
    for number, name in enumerate(("a.jpg", "a_mask.jpg", "a.png", "a.jpg.png")):
        photo(tmp_path / name, number)
    found = find_masks(tmp_path, ["a.jpg", "a_mask.jpg", "a.png", "a.jpg.png"])
    assert (found.of, found.unused, found.beside) == ({}, [], set())


def test_masks_without_a_photo(tmp_path):
    photo(tmp_path / "1.jpg")
    mask(tmp_path / "masks/2.png")
    mask(tmp_path / "3_mask.png")
    found = find_masks(tmp_path, ["1.jpg", "3_mask.png"])
    assert found.of == {}
    assert {path.name for path in found.unused} == {"2.png", "3_mask.png"}
    assert found.beside == {"3_mask.png"}


def test_a_mask_that_may_be_of_several_photos_is_not_used(tmp_path):
    photos = ["cam1/1.jpg", "cam2/1.jpg", "cam2/2.jpg"]
    for name in photos:
        photo(tmp_path / name)
    for name in ("1.png", "2.png"):
        mask(tmp_path / "masks" / name)
    found = find_masks(tmp_path, photos)
    assert found.of == {"cam2/2.jpg": tmp_path / "masks/2.png"}
    assert found.unused == [tmp_path / "masks/1.png"]


@pytest.mark.parametrize("mode", ["1", "L", "RGB", "RGBA", "P", "I;16", "F"])
def test_the_pixels_of_all_kinds_of_masks(mode, tmp_path):
    used = np.zeros((12, 16), bool)
    used[3:9, 4:12] = True
    scale = {"I;16": 65535, "F": 1.0}.get(mode, 255)
    image = Image.fromarray(
        (used * scale).astype({"I;16": np.uint16, "F": np.float32}.get(mode, np.uint8))
    )
    if mode not in ("I;16", "F"):
        image = image.convert(mode)
    assert np.array_equal(mask_levels(image) >= 128, used)


def test_masks_of_0_and_1_and_masks_in_the_alpha_channel(tmp_path):
    used = np.zeros((12, 16), np.uint8)
    used[3:9, 4:12] = 1
    assert np.array_equal(mask_levels(Image.fromarray(used)) >= 128, used > 0)
    for colour in ("black", "white"):
        image = Image.new("RGB", (16, 12), colour)
        image.putalpha(Image.fromarray(used * 255))
        assert np.array_equal(mask_levels(image) >= 128, used > 0)
    photo(tmp_path / "cut.png")
    image = Image.open(tmp_path / "cut.png")
    image.putalpha(Image.fromarray(used * 255))  # a photo without its background
    assert np.array_equal(mask_levels(image) >= 128, used > 0)


def test_the_look_of_a_mask(tmp_path):
    mask(tmp_path / "m.jpg", "RGB")
    photo(tmp_path / "p.jpg")
    (tmp_path / "broken.png").write_text("nothing")
    names = ("m.jpg", "p.jpg", "broken.png", "absent.png")
    assert [looks_like_mask(tmp_path / name) for name in names] == [True, False, False, False]


def test_random_names_are_masks_of_one_folder(tmp_path):
    """10,000 files of random names: no fault; a mask has the name of its photo."""
    generator = random.Random(0)
    words = ["a", "A", "1", "mask", "masks", "_", ".", "-", "jpg", "png", "é", " "]
    photos, folder = set(), tmp_path / "masks"
    folder.mkdir()
    for _ in range(5000):
        name = "".join(generator.choices(words, k=generator.randrange(1, 6)))
        (folder / f"{name}.png").touch()
        photos.add("".join(generator.choices(words, k=generator.randrange(1, 6))) + ".jpg")
    names = sorted(name for name in photos if not name.startswith("."))
    found = find_masks(tmp_path, names)
    assert len(found.of) > 100
    for name, path in found.of.items():
        stem = name[:-4].lower()
        assert stem in path.name.lower()
        rest = path.name.lower().replace(stem, "", 1)
        assert set(rest.replace("masks", "").replace("mask", "").replace("dynamic", "")) <= set(
            "._-jpgn"
        ), (name, path.name)
