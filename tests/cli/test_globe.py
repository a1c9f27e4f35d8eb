"""`snowsplat globe`: the page and the video of a scene, and its errors."""

import av
import numpy as np
import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.extras.globe import globe_video as module
from snowsplat.formats import write_gaussians


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A file without cameras: a dense box of small Gaussians in random colours."""
    path = tmp_path_factory.mktemp("globe") / "box.ply"
    box = torch.tensor([[-0.3, -0.6, -0.3], [0.3, 0.0, 0.3]])
    write_gaussians(path, gaussians_in_box(box, 1500, torch.Generator(), 1, 0.9))
    return path


def test_page_and_video(run, scene, tmp_path, monkeypatch):
    # The same video, with shorter parts.
    monkeypatch.setattr(module, "SHAKE_AT", 0.2)
    monkeypatch.setattr(module, "REMEMBER_AT", 1.6)
    page, video = tmp_path / "a.html", tmp_path / "a.mp4"
    flags = ("--size", 96, "--fps", 4, "--name", "A <box>", "-n", 1000)
    result = run("globe", scene, "-o", page, "--video", video, *flags)
    assert result.code == 0, result.err
    assert f"{page}: 1,000 Gaussians" in result.out
    assert f"{video}: {round(module.SECONDS * 4)} frames 96x96" in result.out
    assert "<title>A &lt;box&gt; - snow globe</title>" in page.read_text(encoding="utf-8")
    with av.open(str(video)) as container:
        images = [f.to_ndarray(format="rgb24").astype(int) for f in container.decode(video=0)]
    assert images[0].shape == (96, 96, 3)

    def difference(i: int) -> float:
        # In the dome of the glass, above the floor. The scene turns, so the first frames differ.
        return float(np.abs(images[i] - images[0])[15:55, 25:70].mean())

    assert difference(6) > 8  # 1.5 s: snow
    assert difference(-1) < 0.5 * difference(6)  # it stands again


def test_default_page_and_name(run, scene):
    assert run("globe", scene).code == 0
    page = scene.with_name("box_globe.html")
    assert "<title>box - snow globe</title>" in page.read_text(encoding="utf-8")


def test_errors(refused, scene, tmp_path):
    assert "needs a scene" in refused("globe")
    assert "no such file" in refused("globe", tmp_path / "absent.ply")
    assert "must end in .html" in refused("globe", scene, "-o", tmp_path / "a.htm")
    assert "must end in .mp4" in refused("globe", scene, "--video", tmp_path / "a.avi")
    assert "--gaussians: 0 is too small; use 1 to" in refused("globe", scene, "-n", 0)
    assert "add --video" in refused("globe", scene, "--size", "64")
    video = ("globe", scene, "--video", tmp_path / "a.mp4")
    assert "use e.g. 1280x720" in refused(*video, "--size", "large")
    assert "--fps: 0.0 is too small; use 1 to 120" in refused(*video, "--fps", 0)
    assert "use at most 60" in refused("globe", scene, "--name", 61 * "a")
    assert "--threads: 0 is too small" in refused("globe", scene, "--threads", 0)
    assert "`iteration`" not in refused("globe", scene, "--iteration", 3)
    empty = tmp_path / "empty.ply"
    box = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    nothing = gaussians_in_box(box, 1, torch.Generator()).select(torch.zeros(0).long())
    write_gaussians(empty, nothing)
    assert "no visible Gaussians" in refused("globe", empty)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.ply"]
