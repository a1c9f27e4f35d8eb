"""Photos of the same picture are found, and photos that only look alike are not."""

import shutil

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.search.copies import find_copies

from ...pictures import photo, write_photos


def copies(root):
    names = [path.relative_to(root).as_posix() for path in sorted(root.rglob("*.*"))]
    return find_copies(root, names)


def test_equal_files_have_any_names(tmp_path):
    root = write_photos(tmp_path / "p")
    shutil.copy(root / "1.jpg", root / "beautiful.jpg")
    assert copies(root) == {"beautiful.jpg": "1.jpg"}


@pytest.mark.parametrize(
    "name",
    ["IMG_1 (1).jpg", "IMG_1 copy.jpg", "IMG_1 - Copy (2).jpg", "img_1.png", "IMG_1.webp",
     "IMG_1_thumb.jpg", "small/IMG_1.jpg", "IMG_1-edited.jpg"],
)  # fmt: skip
def test_the_same_picture_in_another_file(name, tmp_path):
    photo(20).save(tmp_path / "IMG_1.jpg", quality=95)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    image = Image.eval(photo(20), lambda value: value * 0.9 + 10).resize((160, 120))
    image.save(tmp_path / name, **({} if name.endswith("png") else {"quality": 60}))
    assert copies(tmp_path) == {name: "IMG_1.jpg"}


def test_other_pictures_with_such_names(tmp_path):
    photo(20).save(tmp_path / "IMG_1.jpg")
    for number, name in enumerate(("IMG_1 (1).jpg", "IMG_1.png", "IMG_1 copy.jpg"), 1):
        photo(20 + 6 * number).save(tmp_path / name)
    photo(20).crop((0, 0, 240, 240)).save(tmp_path / "IMG_1.webp")
    assert copies(tmp_path) == {}


def test_cameras_of_a_rig_have_the_same_names(tmp_path):
    write_photos(tmp_path / "left", 6)
    write_photos(tmp_path / "right", 6, start=8)
    assert copies(tmp_path) == {}


def test_folders_of_smaller_copies(tmp_path):
    write_photos(tmp_path / "images", 7)
    (tmp_path / "images_2").mkdir()
    for path in (tmp_path / "images").iterdir():
        Image.open(path).reduce(2).save(tmp_path / "images_2" / path.name)
    assert copies(tmp_path) == {f"images_2/{i}.jpg": f"images/{i}.jpg" for i in range(7)}


def test_a_photo_without_its_background_is_used(tmp_path):
    photo(20).save(tmp_path / "1.jpg")
    image = photo(20)
    alpha = np.zeros((image.height, image.width), np.uint8)
    alpha[60:180, 80:240] = 255
    image.putalpha(Image.fromarray(alpha))
    image.save(tmp_path / "1.png")
    assert copies(tmp_path) == {"1.jpg": "1.png"}


def test_plain_and_damaged_files_are_no_copies(tmp_path):
    for name in ("a.png", "b.png"):
        Image.new("L", (40, 40), 255).save(tmp_path / name)
        (tmp_path / f"{name}.jpg").write_bytes(b"\xff\xd8\xff damaged")
    assert copies(tmp_path) == {}
