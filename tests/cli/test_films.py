"""`snowsplat render --path`: films of a training and of a scene's file."""

import shutil
from pathlib import Path

import av
import numpy as np
import pytest

from snowsplat.cli.main import main

SHORT = ("--seconds", 1, "--fps", 10)


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> Path:
    """An output folder whose dataset is not needed any more; not to be changed but for films."""
    out = tmp_path_factory.mktemp("films") / "out"
    flags = ["--iterations", "60", "--eval", "--quiet", "--background", "white"]
    assert main(["train", str(dataset), "-o", str(out), *flags]) == 0
    return out


def frames(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("way", ["training", "ellipse"])
def test_film_of_a_training(run, trained, way):
    result = run("render", trained, "--path", way, *SHORT)
    assert result.code == 0, result.err
    assert f"{trained}/videos/{way}.mp4: 10 frames 48x36" in result.out
    pictures = frames(trained / "videos" / f"{way}.mp4")
    assert [picture.shape for picture in pictures] == [(36, 48, 3)] * 10
    # The scene is in them, and it moves.
    assert all(20 < picture.mean() < 250 and picture.std() > 5 for picture in pictures)
    assert abs(pictures[0].astype(int) - pictures[5]).mean() > 3


def test_depth_beside_or_in_a_film_of_its_own(run, trained, tmp_path):
    common = ("render", trained, "--path", "ellipse", *SHORT)
    assert run(*common, "--depth", "color", "-o", tmp_path / "a.mp4").code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "a_depth.mp4"]
    assert run(*common, "--side-by-side", "--size", "64x32").code == 0
    both = frames(trained / "videos/ellipse_side_by_side.mp4")[3]
    assert both.shape == (32, 128, 3)
    depth = frames(tmp_path / "a_depth.mp4")[3]
    # From far (violet) to near (yellow): green is what tells.
    assert depth[:, :, 1].std() > 10
    assert both[:, 64:, 1].std() > 10


def test_film_through_saved_cameras(run, trained, tmp_path):
    shutil.copy(trained / "cameras.json", tmp_path / "my keys.json")
    flags = ("--path", tmp_path / "my keys.json", *SHORT, "--size", 64)
    result = run("render", trained, *flags)
    assert result.code == 0, result.err
    assert frames(trained / "videos/my keys.mp4")[0].shape == (48, 64, 3)
    assert run("render", trained, *flags, "--film", tmp_path / "a.mp4").code == 0
    assert (tmp_path / "a.mp4").exists()


def test_film_of_a_file(run, refused, trained, tmp_path):
    scene = tmp_path / "scene.ply"
    shutil.copy(trained / "point_cloud/iteration_60/point_cloud.ply", scene)
    assert run("render", scene, "--path", "ellipse", *SHORT, "--size", "64x48").code == 0
    around = frames(tmp_path / "scene_ellipse.mp4")
    assert len(around) == 10
    assert around[0].shape == (48, 64, 3)
    assert around[0].std() > 5
    assert run("render", scene, "--path", trained / "cameras.json", *SHORT).code == 0
    assert (tmp_path / "scene_cameras.mp4").exists()
    # Within the output folder of its training it has the cameras there.
    inside = trained / "point_cloud/iteration_60/point_cloud.ply"
    target = tmp_path / "inside.mp4"
    assert run("render", inside, "--path", "training", *SHORT, "--film", target).code == 0
    assert target.exists()
    for way in ("training", "spiral"):
        assert "needs the cameras of a training" in refused("render", scene, "--path", way)


def test_refused(refused, trained, tmp_path):
    film = ("render", trained, "--path", "ellipse")
    assert "use training, ellipse, spiral or a file" in refused(
        "render", trained, "--path", "helix"
    )
    assert "no such file" in refused("render", trained, "--path", tmp_path / "absent.json")
    assert "use an ellipse" in refused("render", trained, "--path", "spiral")
    assert "must end in .mp4" in refused(*film, "--film", tmp_path / "a.gif")
    assert "use e.g. 1280x720" in refused(*film, "--size", "large")
    assert "16 to 8192" in refused(*film, "--size", "64x9000")
    assert "a video takes --depth color" in refused(*film, "--depth", "16bit")
    assert "above 0" in refused(*film, "--seconds", 0)
    assert "make the video shorter" in refused(*film, "--seconds", 1e9)
    assert "name a camera path with --path" in refused("render", trained, "--size", "64x48")
    assert "no such folder" in refused("render", tmp_path / "absent", "--path", "ellipse")
    assert "--threads: 0 is too small" in refused(*film, "--threads", 0)
