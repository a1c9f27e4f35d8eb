"""Photos and an SfM model become a dataset for training: files, masks, keypoints, sizes."""

import functools
import io
import json
import threading
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from snowsplat.data import load_dataset
from snowsplat.data.photos.decode import load_image, load_mask
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.progress import silent
from snowsplat.sfm.undistort import undistort
from snowsplat.util.errors import UserError

F64 = torch.float64
NAMES = ["a/dos ñandúes.JPG", "a/one.jpg", "b/cut out.png", "b/three.png", "four.webp", "five.tif"]
WIDTH, HEIGHT = 322, 242  # not divisible by 4

pytestmark = pytest.mark.slow  # resamples photos


def lens(strength: float = -0.12) -> pycolmap.Camera:
    params = [260.0, 258.0, 164.0, 119.0, strength, 0.02, 0.001, -0.002]
    if strength == 0:
        params[4:] = [0.0] * 4
    return pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params)


def photo(name: str, mask: bool = False, alpha: bool = False) -> Photo:
    return Photo(name, name, WIDTH, HEIGHT, "phone", None, None, None, mask, alpha)


PHOTOS = [photo(name, mask=name in (NAMES[1], NAMES[2]), alpha=name == NAMES[2]) for name in NAMES]


@functools.cache
def photo_file(suffix: str, mode: str) -> bytes:
    smooth = Image.effect_noise((WIDTH // 8, HEIGHT // 8), 80).resize((WIDTH, HEIGHT))
    image = Image.merge("RGB", [smooth, smooth.rotate(180), smooth.point(lambda v: 255 - v)])
    if mode == "RGBA":
        alpha = Image.new("L", image.size, 0)
        alpha.paste(255, (40, 30, 250, 200))
        image.putalpha(alpha)
    options = {"quality": 97, "exif": Image.Exif()} if suffix == ".jpg" else {}
    file = io.BytesIO()
    image.save(file, Image.registered_extensions()[suffix.lower()], **options)
    return file.getvalue()


@pytest.fixture
def dataset(tmp_path, model_of) -> Path:
    """The result of SfM: six photos with poses, by two lenses, and one photo without a pose."""
    return make_dataset_folder(tmp_path / "my dataset é", model_of, [lens(), lens(0.06)])


def make_dataset_folder(root: Path, model_of, cameras: list[pycolmap.Camera]) -> Path:
    generator = torch.Generator().manual_seed(0)
    angles = torch.arange(6, dtype=F64) * 0.15
    poses = torch.stack(
        [
            look_at(
                torch.tensor([4 * a.sin(), -1.0, -4 * a.cos()], dtype=F64),
                torch.zeros(3, dtype=F64),
                torch.tensor([0, -1.0, 0], dtype=F64),
            )
            for a in angles
        ]
    )
    points = torch.randn(300, 3, generator=generator, dtype=F64) * 0.6
    model = model_of(poses, points, cameras, NAMES)
    sparse = root / "distorted" / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write(sparse)
    for name in [*NAMES, "unplaced.jpg"]:
        path = root / "input" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(photo_file(path.suffix, "RGBA" if "cut" in name else "RGB"))
    for item in PHOTOS:
        if item.mask:
            path = root / "distorted" / "masks" / f"{item.name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            mask = Image.new("L", (WIDTH, HEIGHT), 255)
            mask.paste(0, (100, 100, 200, 150))
            mask.save(path)
    return root


def test_a_mask_of_a_transparent_photo(dataset):
    # Training treats transparent pixels as empty space; only the rest of a mask is needed.
    path = dataset / "distorted" / "masks" / f"{NAMES[2]}.png"
    alpha = np.asarray(Image.open(dataset / "input" / NAMES[2]))[..., 3]
    opaque = np.where(alpha > 0, 255, 0).astype(np.uint8)
    Image.fromarray(opaque).save(path)
    assert undistort(dataset, PHOTOS, scene(), False, silent).masks == 1
    assert files(dataset / "masks") == [f"{NAMES[1]}.png"]
    opaque[100:150, 100:200] = 0
    Image.fromarray(opaque).save(path)
    assert undistort(dataset, PHOTOS, scene(), False, silent).masks == 2
    left_out = np.asarray(Image.open(dataset / "masks" / f"{NAMES[2]}.png")) == 0
    assert 0.9 < left_out.sum() / 5000 < 1.1
    assert left_out[125, 150]


def scene() -> Similarity:
    rotation = rotation_from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=F64))
    return Similarity(1.7, rotation, torch.tensor([0.3, 0.2, -0.1], dtype=F64))


def files(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_the_result_is_a_dataset_that_can_be_loaded(dataset):
    made = undistort(dataset, PHOTOS, scene(), True, silent)
    assert made.images == 6
    assert made.resampled
    assert made.folders == ["images", "images_2", "images_4", "images_8"]
    assert sum(count for *_, count in made.sizes) == 6
    assert len(made.sizes) == 2  # two lenses
    assert json.loads(json.dumps(asdict(made)))["images"] == 6
    for folder in made.folders:
        assert files(dataset / folder) == sorted(NAMES)
    assert made.masks == 2
    assert files(dataset / "masks") == sorted([f"{NAMES[1]}.png", f"{NAMES[2]}.png"])
    loaded = load_dataset(dataset, hold_out=None)
    assert len(loaded.train) == 6
    assert len(loaded.points.xyz) > 290  # those that two or more photos see
    for divisor in (2, 4, 8):
        smaller = load_dataset(dataset, hold_out=None, resolution=divisor)
        for view in smaller.train:
            assert f"images_{divisor}" in view.image.path.parts
            with Image.open(view.image.path) as image:
                assert image.size == (view.camera.width, view.camera.height)
        masked = next(view for view in smaller.train if view.mask is not None)
        share = load_mask(masked.mask).float().mean()
        assert float(share) == pytest.approx(1 - 100 * 50 / (WIDTH * HEIGHT), abs=0.03)


def test_formats_and_transparency_are_preserved(dataset):
    undistort(dataset, PHOTOS, scene(), True, silent)
    for name, form in zip(NAMES, ["JPEG", "JPEG", "PNG", "PNG", "WEBP", "TIFF"], strict=True):
        for folder in ("images", "images_2"):
            with Image.open(dataset / folder / name) as image:
                assert image.format == form
                assert image.mode == ("RGBA" if "cut" in name else "RGB")
                assert not image.getexif().get(0x0112)
    view = next(v for v in load_dataset(dataset, hold_out=None).train if "cut" in v.name)
    alpha = load_image(view.image)[3]
    assert int(alpha[0, 0]) == 0
    assert int(alpha[100, 150]) == 255


@pytest.mark.parametrize("strength", [-0.12, 0.0])
def test_the_model_matches_the_undistorted_keypoints(tmp_path, model_of, strength):
    dataset = make_dataset_folder(tmp_path, model_of, [lens(strength)])
    before = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    undistort(dataset, PHOTOS, scene(), False, silent)
    after = pycolmap.Reconstruction(dataset / "sparse" / "0")
    assert sorted(image.name for image in after.images.values()) == sorted(NAMES)
    assert {camera.model_name for camera in after.cameras.values()} == {"PINHOLE"}
    for number, point in before.points3D.items():
        there = scene().apply(torch.from_numpy(point.xyz.copy()))
        assert np.allclose(after.points3D[number].xyz, there.numpy())
        assert after.points3D[number].track.length() == point.track.length()
        assert tuple(after.points3D[number].color) == (200, 100, 50)
    errors = [
        np.linalg.norm(image.project_point(after.points3D[p.point3D_id].xyz) - p.xy)
        for image in after.images.values()
        for p in image.points2D
        if p.has_point3D()
    ]
    assert len(errors) > 1000
    assert max(errors) < 1e-3  # pixels; the original keypoints are exact
    assert (dataset / "sparse" / "0" / "points3D.ply").is_file()


def test_pixels_are_where_the_model_predicts(dataset):
    # White blobs are drawn at keypoints, and must be found at the undistorted keypoints.
    before = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    image = before.find_image_with_name(NAMES[3])
    spots: dict[int, np.ndarray] = {}  # keypoints far from each other
    for i, xy in enumerate(p.xy for p in image.points2D):
        inside = (xy > 20).all() and (xy < [300, 220]).all()
        if inside and all(np.abs(xy - spot).max() > 50 for spot in spots.values()):
            spots[i] = xy
    assert len(spots) >= 5
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    distances = [(x - spot[0]) ** 2 + (y - spot[1]) ** 2 for spot in spots.values()]
    blobs = sum(255 * np.exp(-distance / (2 * 3.0**2)) for distance in distances)
    Image.fromarray(np.rint(blobs).astype(np.uint8)).save(dataset / "input" / NAMES[3])
    undistort(dataset, PHOTOS, scene(), False, silent)
    after = pycolmap.Reconstruction(dataset / "sparse" / "0")
    pixels = np.asarray(Image.open(dataset / "images" / NAMES[3]), np.float64)
    rows, columns = np.indices(pixels.shape) + 0.5
    for i in spots:
        expected = after.find_image_with_name(NAMES[3]).points2D[i].xy
        near = (np.abs(columns - expected[0]) < 18) & (np.abs(rows - expected[1]) < 18)
        weights = pixels[near] / pixels[near].sum()
        found = np.array([(weights * columns[near]).sum(), (weights * rows[near]).sum()])
        assert np.abs(found - expected).max() < 0.1


def test_without_distortion_photos_are_copied(tmp_path, model_of):
    dataset = make_dataset_folder(tmp_path, model_of, [lens(0.0)])
    made = undistort(dataset, PHOTOS, scene(), False, silent)
    assert not made.resampled
    for name in NAMES:
        copied = (dataset / "images" / name).read_bytes()
        assert copied == (dataset / "input" / name).read_bytes()
    mask = Image.open(dataset / "masks" / f"{NAMES[1]}.png")
    assert sorted(mask.getcolors()) == sorted([(5000, 0), (WIDTH * HEIGHT - 5000, 255)])


@pytest.mark.parametrize("threads", [1, 3])
def test_the_number_of_threads_does_not_change_the_result(dataset, threads):
    before = torch.get_num_threads()
    steps: list[tuple[int, int]] = []
    undistort(
        dataset, PHOTOS, scene(), False, lambda n, of, what="": steps.append((n, of)), threads
    )
    assert steps == [(n, 6) for n in range(7)]
    assert torch.get_num_threads() == before
    once = [(dataset / "images" / name).read_bytes() for name in NAMES]
    (dataset / "sparse" / "1").mkdir()
    (dataset / "sparse" / "0" / "images.txt").write_text("old")
    undistort(dataset, PHOTOS, scene(), False, silent, 2)
    assert {path.name for path in dataset.glob("sparse/**/*")} >= {
        "0",
        "cameras.bin",
        "points3D.ply",
    }
    assert not [*dataset.glob("sparse/1"), *dataset.glob("sparse/0/*.txt")]
    assert once == [(dataset / "images" / name).read_bytes() for name in NAMES]


def test_an_interruption_leaves_no_model_and_no_threads(dataset):
    def stop(done: int, total: int, what: str = "") -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        undistort(dataset, PHOTOS, scene(), False, stop, 1)
    assert not (dataset / "sparse").exists()
    assert not list(dataset.rglob("*.tmp"))
    assert not [t for t in threading.enumerate() if t.name.startswith("snowsplat-photos")]


def test_missing_and_changed_photos_are_named(dataset):
    path = dataset / "input" / NAMES[1]
    good = path.read_bytes()
    path.unlink()
    with pytest.raises(UserError, match="one.jpg: missing"):
        undistort(dataset, PHOTOS, scene(), False, silent)
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(UserError, match="one.jpg: cannot be read"):
        undistort(dataset, PHOTOS, scene(), False, silent)
    path.write_bytes(b"not an image")
    with pytest.raises(UserError, match="one.jpg: cannot be read"):
        undistort(dataset, PHOTOS, scene(), False, silent)
    Image.new("RGB", (100, 50)).save(path)
    with pytest.raises(UserError, match="one.jpg: size is 100x50"):
        undistort(dataset, PHOTOS, scene(), False, silent)


def test_a_partly_valid_calibration_is_cropped_with_a_warning(tmp_path, model_of, caplog):
    dataset = make_dataset_folder(tmp_path, model_of, [lens(-0.6)])
    made = undistort(dataset, PHOTOS, scene(), False, silent)
    assert "OPENCV 260, 258, 164, 119, -0.6, " in caplog.text
    assert "images are cropped" in caplog.text
    assert made.sizes[0][1] < HEIGHT


def test_an_absurd_calibration_is_rejected(tmp_path, model_of):
    dataset = make_dataset_folder(tmp_path, model_of, [lens()])
    sparse = dataset / "distorted" / "sparse" / "0"
    model = pycolmap.Reconstruction(sparse)
    for camera in model.cameras.values():
        camera.params = [260.0, 258.0, 164.0, 119.0, -40.0, 0.0, 0.0, 0.0]
    model.write(sparse)
    with pytest.raises(UserError, match="lens distortion: implausible estimate .*OPENCV"):
        undistort(dataset, PHOTOS, scene(), False, silent)
    assert not (dataset / "images").exists()
