"""`snowsplat render --path`: videos of a training run and of a scene file."""

import shutil
from pathlib import Path

import av
import numpy as np
import pytest

from snowsplat.cli.main import main

SHORT = ("--seconds", 1, "--fps", 10)


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> Path:
    """An output folder; the tests only add videos to it."""
    out = tmp_path_factory.mktemp("videos") / "out"
    flags = ["--iterations", "60", "--eval", "--quiet", "--background", "white"]
    assert main(["train", str(dataset), "-o", str(out), *flags]) == 0
    return out


def frames(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("path", ["training", "ellipse"])
def test_video_of_a_training_run(run, trained, path):
    result = run("render", trained, "--path", path, *SHORT)
    assert result.code == 0, result.err
    assert f"{trained}/videos/{path}.mp4: 10 frames 48x36" in result.out
    images = frames(trained / "videos" / f"{path}.mp4")
    assert [image.shape for image in images] == [(36, 48, 3)] * 10
    # The images show the scene, and the camera moves.
    assert all(20 < image.mean() < 250 and image.std() > 5 for image in images)
    assert abs(images[0].astype(int) - images[5]).mean() > 3


def test_depth_side_by_side_or_in_a_separate_video(run, trained, tmp_path):
    common = ("render", trained, "--path", "ellipse", *SHORT)
    assert run(*common, "--depth", "color", "-o", tmp_path / "a.mp4").code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "a_depth.mp4"]
    assert run(*common, "--side-by-side", "--size", "64x32").code == 0
    both = frames(trained / "videos/ellipse_side_by_side.mp4")[3]
    assert both.shape == (32, 128, 3)
    depth = frames(tmp_path / "a_depth.mp4")[3]
    # Colours range from violet (far) to yellow (near), so green varies.
    assert depth[:, :, 1].std() > 10
    assert both[:, 64:, 1].std() > 10


def test_video_along_saved_cameras(run, trained, tmp_path):
    shutil.copy(trained / "cameras.json", tmp_path / "my keys.json")
    flags = ("--path", tmp_path / "my keys.json", *SHORT, "--size", 64)
    result = run("render", trained, *flags)
    assert result.code == 0, result.err
    assert frames(trained / "videos/my keys.mp4")[0].shape == (48, 64, 3)
    # --film is the former name of --video.
    assert run("render", trained, *flags, "--film", tmp_path / "a.mp4").code == 0
    assert (tmp_path / "a.mp4").exists()


def test_video_of_a_file(run, refused, trained, tmp_path):
    scene = tmp_path / "scene.ply"
    shutil.copy(trained / "point_cloud/iteration_60/point_cloud.ply", scene)
    assert run("render", scene, "--path", "ellipse", *SHORT, "--size", "64x48").code == 0
    orbit = frames(tmp_path / "scene_ellipse.mp4")
    assert len(orbit) == 10
    assert orbit[0].shape == (48, 64, 3)
    assert orbit[0].std() > 5
    assert run("render", scene, "--path", trained / "cameras.json", *SHORT).code == 0
    assert (tmp_path / "scene_cameras.mp4").exists()
    # A scene within the output folder of its training uses the cameras there.
    inside = trained / "point_cloud/iteration_60/point_cloud.ply"
    target = tmp_path / "inside.mp4"
    assert run("render", inside, "--path", "training", *SHORT, "--video", target).code == 0
    assert target.exists()
    for path in ("training", "spiral"):
        assert "needs the cameras of a training run" in refused("render", scene, "--path", path)


def test_errors(refused, trained, tmp_path):
    video = ("render", trained, "--path", "ellipse")
    assert "use training, ellipse, spiral or a file" in refused(
        "render", trained, "--path", "helix"
    )
    assert "no such file" in refused("render", trained, "--path", tmp_path / "absent.json")
    assert "use an ellipse" in refused("render", trained, "--path", "spiral")
    assert "must end in .mp4" in refused(*video, "--video", tmp_path / "a.gif")
    assert "use e.g. 1280x720" in refused(*video, "--size", "large")
    assert "16 to 8192" in refused(*video, "--size", "64x9000")
    assert "a video takes --depth color" in refused(*video, "--depth", "16bit")
    assert "above 0" in refused(*video, "--seconds", 0)
    assert "make the video shorter" in refused(*video, "--seconds", 1e9)
    assert "add a camera path with --path" in refused("render", trained, "--size", "64x48")
    assert "no such folder" in refused("render", tmp_path / "absent", "--path", "ellipse")
    assert "--threads: 0 is too small" in refused(*video, "--threads", 0)
