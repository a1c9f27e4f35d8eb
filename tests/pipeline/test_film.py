"""`film`: the keys of a page are in the world of the scene, and the preview is what is rendered."""

from dataclasses import replace

import av
import pytest
import torch

from snowsplat.pipeline.edit import film, film_preview, write_keys
from snowsplat.pipeline.options.video import VideoOptions, VideoSize
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.pipeline.videos import cameras_along
from snowsplat.project import page_film
from snowsplat.project.page_film import PageFilm
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.geometry import Similarity
from snowsplat.util.errors import UserError
from snowsplat.viewer.web.scene import viewing_frame

from ..trajectory.rigs import camera_at
from .test_edit import write_scene

KEYS = [
    [0.0, 1.0, -9.0, 0.0, 0.0, 0.0, 40.0, 1.5],
    [3.0, 2.0, -8.0, 0.0, 0.5, 0.0, 40.0, 1.5],
    [6.0, 1.0, -5.0, 0.0, 0.0, 0.0, 60.0, 1.5],
]


@pytest.mark.parametrize("with_cameras", [False, True])
def test_a_film_passes_the_views_of_the_page(tmp_path, with_cameras, monkeypatch):
    scene = write_scene(tmp_path, with_cameras)
    path = torch.tensor(film_preview(scene, PageFilm(KEYS, seconds=20.0)), dtype=torch.float64)
    assert path.shape == (200, 10)
    ends = torch.tensor([KEYS[0], KEYS[-1]], dtype=torch.float64)
    assert torch.allclose(path[[0, -1], :3], ends[:, :3])
    ahead = path[[0, -1], 3:6] - path[[0, -1], :3]
    to = ends[:, 3:6] - ends[:, :3]
    assert torch.allclose(ahead, to / to.norm(dim=1, keepdim=True))
    assert (path[[0, -1], 7] > 0.8).all()  # up is up in the page
    # The longer side of a rectangle of 3:2 has 40°; a film of 16:9 shows its whole height.
    tangent = torch.tan(torch.deg2rad(torch.tensor(20.0, dtype=torch.float64))) / 1.5
    assert float(path[0, 9]) == pytest.approx(float(torch.rad2deg(2 * torch.atan(tangent))))
    nearest = (path[:, :3] - torch.tensor(KEYS[1][:3])).norm(dim=1).min()
    assert float(nearest) < 0.1

    monkeypatch.setattr(page_film, "SIZES", ("64x36",))
    plan = PageFilm(KEYS, seconds=0.2, size="64x36", ease=True, loop=True)
    file = film(scene, plan, tmp_path / "keys.json", tmp_path / "film.mp4")
    with av.open(str(file)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert (len(frames), frames[0].shape) == (6, (36, 64, 3))
    assert frames[0].max() > 20
    source = load_viewable(scene)
    change = viewing_frame(source.gaussians, source.cameras)[0] or Similarity.identity()
    _, keys = read_cameras(tmp_path / "keys.json")
    positions = [change.apply(key.position) * torch.tensor([-1.0, -1.0, 1.0]) for key in keys]
    expected = torch.tensor([key[:3] for key in (*KEYS, KEYS[0])], dtype=torch.float64)
    assert torch.allclose(torch.stack(positions), expected)


def test_films_that_are_not_possible(tmp_path):
    for wrong in (
        {"keys": KEYS[:1]},
        {"keys": KEYS[:2], "loop": True},
        {"keys": [KEYS[0], KEYS[0][:7]]},
        {"keys": [KEYS[0], [float("nan")] * 8]},
        {"keys": KEYS * 100},
        {"keys": KEYS, "seconds": 0.0},
        {"keys": KEYS, "seconds": 1e9},
        {"keys": KEYS, "size": "8000x8000"},
        {"keys": KEYS, "speeds": (1.0,)},
        {"keys": KEYS, "speeds": (1.0, 0.0, 1.0)},
        {"keys": KEYS, "speeds": (1.0, float("nan"), 1.0)},
    ):
        with pytest.raises(ValueError, match="key|seconds|sizes|speed"):
            PageFilm(**wrong)
    scene = write_scene(tmp_path, with_cameras=False)
    with pytest.raises(UserError, match="needs two that differ"):
        film_preview(scene, PageFilm([KEYS[0], KEYS[0]]))


def test_the_speeds_are_those_of_the_command_line(tmp_path):
    """In the preview, and in the file of keys, which `render` follows."""
    scene = write_scene(tmp_path, with_cameras=False)
    plan = PageFilm(KEYS, seconds=5.0, size="1080x1080", loop=True, speeds=(1.0, 0.2, 1.0))
    write_keys(scene, plan, tmp_path / "keys.json")
    gaussians = load_viewable(scene).gaussians
    size = VideoSize.parse(plan.size)
    path = cameras_along(str(tmp_path / "keys.json"), gaussians, None, 50, size)
    shown = torch.tensor(film_preview(scene, plan), dtype=torch.float64)[:, :3]
    change = viewing_frame(gaussians, [])[0] or Similarity.identity()
    rendered = torch.stack([change.apply(camera.position) for camera in path])
    rendered *= torch.tensor([-1.0, -1.0, 1.0])
    assert torch.allclose(rendered, shown, atol=1e-4)
    even = replace(plan, speeds=())
    near = [
        int(
            (
                (torch.tensor(film_preview(scene, each))[:, :3] - torch.tensor(KEYS[1][:3])).norm(
                    dim=1
                )
                < 2
            ).sum()
        )
        for each in (plan, even)
    ]
    assert near[0] > 1.5 * near[1]


def test_sizes_are_even():
    camera = camera_at((0.0, 0.0, -3.0))  # 64×48
    assert VideoSize.parse(None).for_camera(camera) == (64, 48)
    assert VideoSize.parse("127").for_camera(camera) == (126, 94)
    assert VideoSize.parse("33x21").for_camera(camera) == (32, 20)
    large = camera.scaled(4000, 3000)
    assert VideoSize.parse(None).for_camera(large) == (1920, 1440)
    assert VideoSize.parse("8192").for_camera(camera.scaled(1, 100_000)) == (8192, 8192)


def test_number_of_frames():
    assert VideoOptions(seconds=2.0, fps=12.5).frames == 25
    assert VideoOptions(seconds=0.001, fps=1.0).frames == 1
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(UserError, match="above 0"):
            VideoOptions(seconds=wrong)
