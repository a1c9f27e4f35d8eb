"""Photos, videos and masks are gathered in input/; unusable files are skipped and named."""

import errno
import logging
import os

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from snowsplat.sfm.ingest.photo import Photo, not_used
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

from ..pictures import (
    HEIGHT,
    WIDTH,
    blurred,
    exif,
    gathered,
    pan,
    photo,
    wall,
    write_photos,
    write_video,
)

pytestmark = pytest.mark.slow  # decodes and writes photos and videos


def files(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def content(folder):
    return {name: (folder / name).read_bytes() for name in files(folder)}


def test_ready_photos_are_linked_unchanged(tmp_path):
    root = write_photos(tmp_path / "p q")
    photo(60).save(root / "Ünïcode name (1).JPG", quality=90)
    (root / "deep").mkdir()
    photo(80).convert("L").save(root / "deep" / "grey.tif")
    made = gathered(root, tmp_path / "out")
    assert [p.name for p in made.photos] == files(root)
    assert content(tmp_path / "out" / "input") == content(root)
    assert (tmp_path / "out" / "input" / "0.jpg").samefile(root / "0.jpg")
    assert made.left_out == []
    assert made.photos[0] == Photo(
        name="0.jpg",
        source=str(root / "0.jpg"),
        width=WIDTH,
        height=HEIGHT,
        group=made.photos[1].group,
    )
    assert made.photos[0].group != next(p for p in made.photos if "grey" in p.name).group
    assert not (tmp_path / "out" / "distorted").exists()


def test_formats_unknown_to_colmap_are_converted_and_upright(tmp_path):
    pillow_heif.register_heif_opener()
    root = write_photos(tmp_path / "p", 1)
    photo(20).save(root / "0.heic", quality=90)
    photo(40).save(root / "a.webp", quality=95)
    data = exif({0x0112: 6, 0x0110: "M1"}, {0xA405: 26})
    photo(60).transpose(Image.Transpose.ROTATE_90).save(root / "turned.jpg", exif=data, quality=95)
    made = gathered(root, tmp_path / "out")
    assert [p.name for p in made.photos] == ["0.jpg", "0_2.jpg", "a.jpg", "turned.jpg"]
    assert [os.path.basename(p.source) for p in made.photos][1] == "0.heic"
    for p, offset in zip(made.photos, (0, 20, 40, 60), strict=True):
        with Image.open(tmp_path / "out" / "input" / p.name) as image:
            assert image.size == (p.width, p.height) == (WIDTH, HEIGHT)
            assert image.getexif().get(0x0112, 1) == 1
            difference = np.abs(np.asarray(image).astype(int) - wall(offset)).mean()
        assert difference < 12
    assert made.photos[3].focal == pytest.approx(26 / 43.267 * 400, rel=1e-3)


def test_size_scales_photos_and_their_focal_lengths(tmp_path):
    root = tmp_path / "p"
    root.mkdir()
    for i in range(3):
        photo(20 * i).save(root / f"{i}.jpg", exif=exif(details={0xA405: 26}))
    made = gathered(root, tmp_path / "out", size=160)
    assert {(p.width, p.height) for p in made.photos} == {(160, 120)}
    assert made.photos[0].focal == pytest.approx(26 / 43.267 * 200, rel=1e-3)
    with Image.open(tmp_path / "out" / "input" / "0.jpg") as image:
        assert image.size == (160, 120)


def test_groups(tmp_path):
    """A group is one camera at one zoom, in one orientation and one folder."""
    root = tmp_path / "p"
    (root / "other").mkdir(parents=True)

    def take(name, model="M1", zoom=26, orientation=1):
        data = exif({0x0110: model, 0x0112: orientation}, {0xA405: zoom})
        photo(20 * len(list(root.rglob("*.jpg")))).save(root / name, exif=data)

    take("a.jpg"), take("b.jpg"), take("other.jpg", model="M2"), take("zoomed.jpg", zoom=52)
    take("portrait.jpg", orientation=6), take("portrait2.jpg", orientation=8)
    take("other/a.jpg")
    group = {p.name: p.group for p in gathered(root, tmp_path / "out").photos}
    assert group["a.jpg"] == group["b.jpg"]
    assert group["portrait.jpg"] == group["portrait2.jpg"]
    assert len(set(group.values())) == 5


def test_masks_and_alpha(tmp_path):
    root = write_photos(tmp_path / "p", 2)
    left = np.zeros((HEIGHT, WIDTH), np.uint8)
    left[:, : WIDTH // 2] = 255
    image = photo(40)
    image.putalpha(Image.fromarray(left[:, ::-1].copy()))
    image.save(root / "cut.png")
    image = photo(60)
    image.putalpha(Image.fromarray(left[:, ::-1].copy()))
    image.save(root / "both.png")
    (root / "masks").mkdir()
    Image.fromarray(left).save(root / "masks" / "0.jpg.png")
    top = np.zeros((HEIGHT, WIDTH), np.uint8)
    top[: HEIGHT // 2] = 255
    Image.fromarray(top).save(root / "masks" / "both.png")
    made = gathered(root, tmp_path / "out", size=160)
    facts = {p.name: (p.mask, p.alpha) for p in made.photos}
    assert facts == {
        "0.jpg": (True, False),
        "1.jpg": (False, False),
        "cut.png": (True, True),
        "both.png": (True, True),
    }
    masks = tmp_path / "out" / "distorted" / "masks"
    assert files(masks) == ["0.jpg.png", "both.png.png", "cut.png.png"]
    read = {name: np.asarray(Image.open(masks / name)) for name in files(masks)}
    assert {(m.shape, m.dtype.name) for m in read.values()} == {((120, 160), "uint8")}
    assert (read["0.jpg.png"][:, :80] == 255).all()
    assert (read["0.jpg.png"][:, 80:] == 0).all()
    assert (read["cut.png.png"][:, 84:] == 255).all()
    assert (read["cut.png.png"][:, :76] == 0).all()
    assert np.array_equal(read["both.png.png"][:60], read["cut.png.png"][:60])
    assert (read["both.png.png"][60:] == 0).all()
    with Image.open(tmp_path / "out" / "input" / "cut.png") as image:
        assert image.mode == "RGBA"


def test_a_mask_of_the_wrong_size_and_a_mask_without_a_photo(tmp_path, caplog):
    root = write_photos(tmp_path / "p")
    (root / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(root / "masks" / "7.png")
    with caplog.at_level(logging.WARNING, "snowsplat"):
        gathered(root, tmp_path / "out")
    assert "7.png: mask not used, there is no such photo" in caplog.text
    Image.new("L", (99, 99)).save(root / "masks" / "1.png")
    with pytest.raises(UserError, match=r"1.png: the mask is 99x99, but its photo is 320x240"):
        gathered(root, tmp_path / "other")


def test_cropped_photos_are_told(tmp_path, caplog):
    root = write_photos(tmp_path / "p")
    data = exif(details={0xA002: 2 * WIDTH, 0xA003: HEIGHT, 0xA405: 26})
    photo().save(root / "x.jpg", exif=data)
    with caplog.at_level(logging.WARNING, "snowsplat"):
        made = gathered(root, tmp_path / "out")
    assert f"1 of {len(made.photos)} photos were cropped after they were taken (such as x.jpg)" in (
        caplog.text
    )


def test_a_completely_masked_photo_is_skipped(tmp_path):
    root = write_photos(tmp_path / "p", 4)
    (root / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT)).save(root / "masks" / "1.png")
    made = gathered(root, tmp_path / "out")
    assert made.left_out == [not_used(root / "1.jpg", message("is completely masked out"))]
    assert files(tmp_path / "out" / "input") == ["0.jpg", "2.jpg", "3.jpg"]


def test_unusable_photos_are_skipped_and_named(tmp_path):
    root = write_photos(tmp_path / "p", 4)
    cut = (root / "1.jpg").read_bytes()
    (root / "1.jpg").write_bytes(cut[: len(cut) // 2])
    (root / "text.jpg").write_text("no photo")
    Image.new("RGB", (WIDTH, HEIGHT)).save(root / "cap.png")
    made = gathered(root, tmp_path / "out")
    assert [p.name for p in made.photos] == ["0.jpg", "2.jpg", "3.jpg"]
    assert files(tmp_path / "out" / "input") == ["0.jpg", "2.jpg", "3.jpg"]
    reasons = {os.path.basename(each.photo): str(each.reason) for each in made.left_out}
    assert reasons.keys() == {"1.jpg", "text.jpg", "cap.png"}
    assert "truncated" in reasons["1.jpg"]
    assert "not an image of a known format" in reasons["text.jpg"]
    assert reasons["cap.png"] == "is completely black"


def test_a_video(tmp_path):
    path = write_video(tmp_path / "walk around.MP4", pan(30))
    made = gathered(path, tmp_path / "out", frames=6)
    assert [p.name for p in made.photos] == [f"frame_{i:05d}.jpg" for i in range(1, 7)]
    assert {p.sequence for p in made.photos} == {"walk around.MP4"}
    assert len({p.group for p in made.photos}) == 1
    assert made.photos[0].source.startswith("walk around.MP4 at 0.")
    assert len(gathered(path, tmp_path / "fps", fps=2).photos) == 6


def test_photos_and_videos_together(tmp_path):
    root = write_photos(tmp_path / "p", 2)
    one = write_video(tmp_path / "a.mp4", pan(12))
    two = write_video(tmp_path / "a.mkv", pan(12, seed=1))
    made = gathered([root, one, two], tmp_path / "out", frames=3)
    assert [p.name for p in made.photos] == [
        "a/frame_00001.jpg",
        "a/frame_00002.jpg",
        "a/frame_00003.jpg",
        "a_2/frame_00001.jpg",
        "a_2/frame_00002.jpg",
        "a_2/frame_00003.jpg",
        "p/0.jpg",
        "p/1.jpg",
    ]
    assert [p.sequence for p in made.photos] == ["a"] * 3 + ["a_2"] * 3 + [None] * 2
    assert files(tmp_path / "out" / "input") == [p.name for p in made.photos]
    assert len({p.group for p in made.photos}) == 3


def test_input_in_place_is_not_changed(tmp_path):
    dataset = tmp_path / "location"
    root = write_photos(dataset / "input", 4)
    (root / "3.jpg").write_text("no photo")
    (root / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(root / "masks" / "0.png")
    before = content(root)
    made = gathered(root, dataset)
    assert [p.name for p in made.photos] == ["0.jpg", "1.jpg", "2.jpg"]
    assert made.left_out[0].photo.endswith("3.jpg")
    assert content(root) == before
    assert files(dataset / "distorted") == ["masks/0.jpg.png"]


@pytest.mark.parametrize("kind", ["webp", "turned", "size", "video"])
def test_input_in_place_that_needs_a_change_is_rejected(kind, tmp_path):
    root = write_photos(tmp_path / "location" / "input", 0 if kind == "video" else 4)
    if kind == "webp":
        photo().save(root / "x.webp")
    elif kind == "turned":
        photo().save(root / "x.jpg", exif=exif({0x0112: 3}))
    elif kind == "video":
        write_video(root / "x.mp4", pan(9))
    before = content(tmp_path)
    with pytest.raises(UserError, match="must be converted.*never changed; .* in a new folder"):
        gathered(root, tmp_path / "location", size=160 if kind == "size" else None)
    assert content(tmp_path) == before


def test_photos_in_place_with_a_model_are_used_as_stored(tmp_path):
    root = write_photos(tmp_path / "location" / "input", 3)
    photo().save(root / "x.jpg", exif=exif({0x0112: 6}))
    before = content(root)
    made = gathered(root, tmp_path / "location", as_stored=True)
    assert content(root) == before
    assert [p.turned for p in made.photos] == [1, 1, 1, 6]
    assert {(p.width, p.height) for p in made.photos} == {(WIDTH, HEIGHT)}


def test_broken_links_are_named(tmp_path):
    root = write_photos(tmp_path / "p", 3)
    for name in ("x.jpg", "y.jpg", "notes.txt"):
        (root / name).symlink_to(tmp_path / "missing" / name)
    made = gathered(root, tmp_path / "out")
    (found,) = made.left_out
    assert found.photo == str(root)
    assert "missing: x.jpg and 1 more" in str(found.reason)
    for photo_file in root.glob("[0-9].jpg"):
        photo_file.unlink()
    with pytest.raises(UserError, match="has links to files that are missing: x.jpg"):
        find_sources([root])


def write_all(folder, picture, count=5):
    folder.mkdir()
    for i in range(count):
        Image.fromarray(picture).save(folder / f"{i}.jpg", quality=90 + i)  # not equal files
    return folder


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (
            np.zeros((240, 320, 3), np.uint8),
            "photos: all 5 images are completely black; check the lens cap",
        ),
        (np.full((240, 320, 3), 255, np.uint8), "all 5 images are completely white"),
        (blurred(wall(), 12), "all 5 images are too blurred.*hold the camera still"),
    ],
)
def test_photos_without_content(picture, message, tmp_path):
    with pytest.raises(UserError, match=message):
        gathered(write_all(tmp_path / "p", picture), tmp_path / "out")


def test_a_video_of_a_static_camera(tmp_path):
    path = write_video(tmp_path / "still.mp4", [wall()] * 20)
    with pytest.raises(UserError, match=r"still.mp4: the camera does not move .* walking around"):
        gathered(path, tmp_path / "out")


def test_too_few_photos(tmp_path):
    root = write_photos(tmp_path / "p", 2)
    with pytest.raises(UserError, match="only 2 usable images; .* at least 3, preferably 20"):
        gathered(root, tmp_path / "out")
    (root / "broken.jpg").write_text("no photo")
    with pytest.raises(UserError, match=r"only 2 .*; .*broken.jpg cannot be decoded \(not an"):
        gathered(root, tmp_path / "out2")
    for name in ("0.jpg", "1.jpg"):
        (root / name).write_text("no photo")
    with pytest.raises(
        UserError, match=r"no usable image; all 3 images .*0.jpg, which cannot be decoded"
    ):
        gathered(root, tmp_path / "out3")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 2.0, "frames": 60}, "fps: cannot be combined with frames"),
        ({"fps": 0.0}, "fps: 0.0 is too small"),
        ({"fps": float("nan")}, "fps: nan is not finite"),
        ({"frames": 2}, "frames: 2 is too small"),
        ({"size": 50}, "size: 50 is too small"),
    ],
)
def test_invalid_settings(options, message, tmp_path):
    with pytest.raises(UserError, match=message):
        gathered(write_photos(tmp_path / "p"), tmp_path / "out", **options)


@pytest.mark.parametrize("writes", ["photos", "video"])
def test_the_disk_becomes_full(writes, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    if writes == "photos":
        source = write_photos(tmp_path / "p", 3, "webp")
        monkeypatch.setattr("snowsplat.sfm.ingest.photos.gather_photos.save", full)
    else:
        source = write_video(tmp_path / "a.mp4", pan(9))
        monkeypatch.setattr("snowsplat.sfm.ingest.video.video_frames.save", full)
    with pytest.raises(UserError, match="disk: full; free some space"):
        gathered(source, tmp_path / "out")


def test_fewer_photos_are_evenly_spread_by_name(tmp_path):
    root = write_photos(tmp_path / "p", 12)
    names = [f"{i}.jpg" for i in range(12)]  # 9.jpg comes before 10.jpg
    some = gathered(root, tmp_path / "some", photos=4)
    assert [p.name for p in some.photos] == [names[i] for i in (0, 4, 7, 11)]
    assert files(tmp_path / "some" / "input") == sorted(p.name for p in some.photos)
    assert some.left_out == []
    assert len(gathered(root, tmp_path / "all", photos=20).photos) == 12
    with pytest.raises(UserError, match="photos"):
        gathered(root, tmp_path / "none", photos=0)


def test_ctrl_c_and_progress(tmp_path):
    root = write_photos(tmp_path / "p", 12)
    calls = []
    gathered(root, tmp_path / "out", report=lambda *call: calls.append(call))
    assert calls == [(i, 12, "photos") for i in range(1, 13)]

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gathered(root, tmp_path / "other", report=stop)


def test_paths_of_sources_are_all_files_that_are_read(tmp_path):
    root = write_photos(tmp_path / "p")
    (root / "masks").mkdir()
    photo().save(root / "masks" / "1.png")
    path = write_video(tmp_path / "a.mp4", pan(3))
    listed = [p.relative_to(tmp_path).as_posix() for p in find_sources([root, path]).paths]
    assert listed == ["p/0.jpg", "p/1.jpg", "p/masks/1.png", "p/2.jpg", "a.mp4"]
    with pytest.raises(UserError):
        find_sources([tmp_path / "absent"])


def test_the_pages_of_a_scan_are_photos(tmp_path):
    root = tmp_path / "p"
    root.mkdir()
    pages = [photo(20 * i) for i in range(3)]
    small = photo().resize((80, 60))  # a preview
    pages[0].save(root / "scan.tif", save_all=True, append_images=[*pages[1:], small])
    made = gathered(root, tmp_path / "out")
    assert [p.name for p in made.photos] == ["scan.png", "scan_page002.png", "scan_page003.png"]
    for p, offset in zip(made.photos, (0, 20, 40), strict=True):
        with Image.open(tmp_path / "out" / "input" / p.name) as image:
            assert np.array_equal(np.asarray(image), wall(offset))


@pytest.mark.parametrize("ending", ["webp", "png"])
def test_an_animation_is_named(tmp_path, ending):
    root = write_photos(tmp_path / "p")
    pages = [photo(20 * i) for i in range(4)]
    pages[0].save(root / f"a.{ending}", save_all=True, append_images=pages[1:])
    made = gathered(root, tmp_path / "out")
    assert len(made.photos) == 4
    assert [str(each.reason) for each in made.left_out] == [
        "is an animation of 4 pictures, of which one is used; save the others as photos or a video"
    ]
