"""`viewed_scene`: which scenes are shown in levels of detail."""

import json
import math
import re
from pathlib import Path

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.formats.lod import INDEX, read_index
from snowsplat.pipeline import publish
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.publish import viewed_scene
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.initial_view import overview
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message
from snowsplat.viewer.http.static import FileOnDisk


@pytest.fixture
def scene(tmp_path) -> Path:
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(box, 500, torch.Generator().manual_seed(0), 1)
    write_gaussians(tmp_path / "box.ply", gaussians)
    return tmp_path / "box.ply"


class Notes(Observer):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, line: Message) -> None:
        self.lines.append(str(line))


def test_a_small_scene_is_one_file(scene):
    with viewed_scene(scene) as viewed:
        assert (viewed.file, viewed.gaussians) == (scene, 500)
        assert "scene.compressed.ply" in viewed.files
        assert INDEX not in viewed.files


def test_a_large_scene_is_shown_in_levels_until_the_end(scene, monkeypatch):
    monkeypatch.setattr(publish, "_LARGE_HERE", 499)
    notes = Notes()
    with viewed_scene(scene, observer=notes) as viewed:
        assert viewed.gaussians == 500
        index = viewed.files[INDEX]
        assert isinstance(index, FileOnDisk)
        assert len(read_gaussians(index.path)) == 500
        assert viewed.files["levels/0_0/means_l.webp"].type == "image/webp"
        assert INDEX.encode() in viewed.files[""].content
    assert not index.path.parent.exists()
    (line,) = notes.lines
    assert f"convert {scene} FOLDER/{INDEX}" in line


def test_levels_are_not_turned(tmp_path):
    """The page must not assume another frame than that of the files, as for a tilted floor."""
    x, z = torch.rand(2, 500, generator=torch.Generator().manual_seed(0)) * 4 - 2
    floor = Gaussians(
        torch.stack([x + 5, 0.5 * x, z], 1),
        torch.tensor([-3.0, -7.0, -3.0]).expand(500, 3).clone(),
        torch.tensor([0.973, 0.0, 0.0, 0.230]).expand(500, 4).clone(),
        torch.full((500,), 3.0),
        torch.zeros(500, 1, 3),
        torch.zeros(500, 0, 3),
    )
    write_gaussians(tmp_path / INDEX, floor)
    with viewed_scene(tmp_path) as viewed:
        (found,) = re.findall(rb'"initial": {"position": (\[.*?\])', viewed.files[""].content)
    x, y, z = overview(floor).position
    assert json.loads(found) == pytest.approx([-x, -y, z], abs=0.05)


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_page_scales_levels_of_an_unusual_unit(scene, tmp_path, scale):
    """The viewer moves at a fixed speed, and limits distances. The files stay as they are."""
    box = read_gaussians(scene)
    change = Similarity(scale, torch.eye(3), torch.zeros(3))
    write_gaussians(tmp_path / "levels" / INDEX, transform(box, change))
    with viewed_scene(tmp_path / "levels") as viewed:
        script = viewed.files["index.js"].content
        (factor,) = re.findall(rb"0, 180\); entity.setLocalScale\((.*?),", script)
        (found,) = re.findall(rb'"initial": ({.*?})', viewed.files[""].content)
    start = json.loads(found)
    assert math.dist(start["position"], start["target"]) == pytest.approx(3.0, rel=1e-3)
    view = overview(box)
    usual = scale * math.dist(view.position, view.target)
    assert float(factor) * usual == pytest.approx(3.0, rel=1e-3)


def test_a_folder_with_levels_is_served_as_it_is(scene, tmp_path):
    index = tmp_path / "my levels" / INDEX
    write_gaussians(index, read_gaussians(scene))
    for path in (index.parent, index):
        with viewed_scene(path) as viewed:
            assert (viewed.file, viewed.gaussians) == (index, read_index(index).counts()[0])
            served = {file.path for file in viewed.files.values() if isinstance(file, FileOnDisk)}
            assert served == {file for file in index.parent.rglob("*") if file.is_file()}
    assert read_index(index).counts() == [500]
    with pytest.raises(UserError, match="leave it out"), viewed_scene(index, 30):
        pass
