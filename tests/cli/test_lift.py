"""`lift`: the files, the subcommands that read them, focal lengths, refinement, invalid input."""

import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from snowsplat.cli.main import main
from snowsplat.data import load_dataset
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.synthetic import toy_dataset

WIDTH, HEIGHT = 48, 36


@pytest.fixture(scope="session")
def photo(tmp_path_factory) -> Path:
    """A photo of 48×36 pixels with a 35 mm equivalent focal length; beside it, its depth."""
    folder = tmp_path_factory.mktemp("lift")
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = 9 - np.hypot(x - 20, y - 18)
    disc, share = inside > 0, (0.5 + inside / 2).clip(0, 1)[..., None]  # with a soft edge
    behind = np.stack([4 * x, 5 * y, 90 + 0 * x], -1)
    pixels = behind + share * (np.array([200, 90, 40]) - behind)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    path = folder / "room.png"
    Image.fromarray(pixels.astype(np.uint8)).save(path, exif=exif)
    np.save(folder / "room.npy", np.where(disc, 1.5, 4.0))
    return path


@pytest.fixture(scope="session")
def lifted(photo, tmp_path_factory) -> Path:
    """The output folder of a lift; read-only for the tests."""
    out = tmp_path_factory.mktemp("lift") / "out"
    depth = photo.with_suffix(".npy")
    assert main(["lift", str(photo), "--depth", str(depth), "-o", str(out), "--swing"]) == 0
    return out


def test_the_files_of_a_lift(lifted, photo):
    metrics = json.loads((lifted / "metrics.json").read_text())
    rendered = np.asarray(Image.open(lifted / "rendered.png")).astype(float)
    error = np.square(rendered - np.asarray(Image.open(photo))).mean()
    psnr = 10 * np.log10(255**2 / error)
    assert psnr > 35
    assert metrics["psnr"] == pytest.approx(psnr, abs=0.3)
    depth = np.asarray(Image.open(lifted / "depth.png")).reshape(-1, 3)
    assert len(np.unique(depth, axis=0)) == 2
    with av.open(str(lifted / "swing.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 96
    assert frames[0].shape == (HEIGHT, WIDTH, 3)
    assert np.abs(frames[0].astype(float) - frames[48]).mean() > 3


def test_the_scene_has_the_depths_of_the_map(lifted):
    scene = load_viewable(lifted)
    depths = scene.gaussians.means[:, 2]
    assert len(scene.gaussians) == WIDTH * HEIGHT
    assert sorted(set(depths.mul(10).round().tolist())) == [15, 40]
    (camera,) = scene.cameras
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert camera.fx == pytest.approx(28 / 43.2666 * 60)


def test_other_subcommands_read_the_folder(lifted, run, tmp_path):
    described = run("info", lifted)
    assert described.code == 0
    assert "output folder" in described.out
    assert run("convert", lifted, tmp_path / "room.spz").code == 0
    rendered = run("render", lifted, "--split", "train", "--device", "cpu")
    assert rendered.code == 0, rendered.err
    images = lifted / "train" / "ours_0"
    shown, given = (
        np.asarray(Image.open(images / name / "00000.png")).astype(int)
        for name in ("renders", "gt")
    )
    assert np.abs(shown - given).mean() < 3


def test_what_is_printed(photo, run, tmp_path):
    wide = tmp_path / "wide.png"
    Image.open(photo).convert("RGB").resize((96, 72)).save(wide, exif=b"")
    depth = photo.with_suffix(".npy")
    result = run("lift", wide, "--depth", depth, "-o", tmp_path / "a", "--size", 48)
    assert "focal length: 39 pixels, assumed; set it with --focal" in result.out
    assert "depth (z): 1.5 to 4" in result.out
    result = run("lift", wide, "--depth", depth, "-o", tmp_path / "b", "--size", 48, "--focal", 100)
    assert "focal length: 50 pixels, set\n" in result.out
    assert "1,728 Gaussians, PSNR" in result.out


def test_fewer_gaussians_and_a_range_of_disparities(photo, run, tmp_path):
    grey = tmp_path / "grey.png"
    depth = np.load(photo.with_suffix(".npy"))
    Image.fromarray(np.where(depth < 2, 255, 0).astype(np.uint8)).save(grey)
    result = run(
        *("lift", photo, "--depth", grey, "-o", tmp_path / "out", "--max-gaussians", 800),
        *("--depth-is", "disparity", "--near", 2, "--far", 6),
    )
    assert result.code == 0, result.err
    assert "depth (disparity): 2 to 6" in result.out
    scene = read_gaussians(tmp_path / "out/point_cloud/iteration_0/point_cloud.ply")
    assert 300 < len(scene) <= 800


def test_a_rotated_photo_is_lifted_upright(photo, run, tmp_path):
    sideways = tmp_path / "sideways.png"
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate by 90° clockwise to display
    Image.open(photo).convert("RGB").transpose(Image.Transpose.ROTATE_90).save(sideways, exif=exif)
    result = run("lift", sideways, "--depth", photo.with_suffix(".npy"), "-o", tmp_path / "out")
    assert result.code == 0, result.err
    image = np.asarray(Image.open(tmp_path / "out/rendered.png")).astype(int)
    assert np.abs(image - np.asarray(Image.open(photo).convert("RGB"))).mean() < 3


def test_invalid_input_is_one_line(photo, lifted, refused, tmp_path):
    depth, new = photo.with_suffix(".npy"), tmp_path / "new"
    np.save(tmp_path / "square.npy", np.ones((9, 9)))
    assert "lift PHOTO --depth MAP -o OUT" in refused("lift", photo)
    assert "--depth and --model" in refused("lift", photo, "-o", new)
    assert "no such photo" in refused("lift", "none.png", "--depth", depth, "-o", new)
    assert "cannot be decoded" in refused("lift", depth, "--depth", depth, "-o", new)
    assert "no such depth map" in refused("lift", photo, "--depth", "none.npy", "-o", new)
    assert "9x9 pixels" in refused("lift", photo, "--depth", tmp_path / "square.npy", "-o", new)
    assert "--overwrite" in refused("lift", photo, "--depth", depth, "-o", lifted)
    for flag, value in {"--size": 8, "--focal": 0, "--edge": -1, "--max-gaussians": 0}.items():
        assert flag in refused("lift", photo, "--depth", depth, "-o", new, flag, value)
    assert "--near and --far" in refused("lift", photo, "--depth", depth, "-o", new, "--near", 1)
    assert "does not download" in refused("lift", photo, "--model", "depth.onnx", "-o", new)
    rest = ("--depth", depth, "-o", new)
    assert "set --refine" in refused("lift", photo, *rest, "--eval")
    assert "set --refine" in refused("lift", photo, *rest, "--iterations", 9)
    assert "leave them out" in refused("lift", photo, *rest, "--refine", new, "--size", 99)
    assert not new.exists()


# Refinement. The depth of the toy dataset is known in closed form.


def write_depth(dataset: Path, name: str, target: Path) -> None:
    """The disparity of a photo, as of a network: with another unit and a shift."""
    view = next(v for v in load_dataset(dataset, hold_out=None).train if v.name == name)
    camera = view.camera
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    scene = toy_dataset._Scene(0, surroundings=True)
    origin, directions = toy_dataset._rays(camera, pixels)
    distance, _ = scene.hit(origin, directions)
    z = distance * (directions @ camera.cam_from_world[2, :3].numpy())
    np.save(target, (5.0 / z + 0.3).reshape(camera.height, camera.width))


def test_refinement_with_the_photos_of_a_dataset(dataset, run, tmp_path):
    depth = tmp_path / "disparity.npy"
    write_depth(dataset, "view_01.png", depth)
    found = {}
    for iterations in (1, 60):
        result = run(
            *("lift", dataset / "images/view_01.png", "--depth", depth, "-o", tmp_path / "out"),
            *("--depth-is", "disparity", "--refine", dataset, "--eval", "--overwrite", "-q"),
            *("--iterations", iterations),
        )
        assert result.code == 0, result.err
        assert "depth aligned to" in result.out
        error = float(result.out.partition("median error ")[2].partition("%")[0])
        assert error < 2
        found[iterations] = float(result.out.partition(": PSNR ")[2].split()[0])
    assert found[60] > found[1] + 2
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert (metrics["iteration"], metrics["split"]) == (60, "test")
    assert run("evaluate", tmp_path / "out", "--device", "cpu").code == 0


def test_refinement_needs_a_training_photo_of_a_dataset_with_points(
    dataset, photo, refused, tmp_path
):
    depth = photo.with_suffix(".npy")
    rest = ("--depth", depth, "-o", tmp_path / "out", "--refine", dataset)
    assert "not a photo of the dataset" in refused("lift", photo, *rest)
    assert "held out for testing" in refused("lift", "view_00.png", *rest, "--eval")
    blender = toy_dataset.write_toy_dataset(tmp_path / "blender", "blender", 9, 48, 36)
    assert "has no points" in refused("lift", "r_1.png", *rest[:-1], blender)
    assert not (tmp_path / "out").exists()
