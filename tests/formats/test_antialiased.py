"""The mark of an antialiased scene in the files of each format."""

import json
import logging
import zipfile

import pytest

from snowsplat.formats import FORMATS, read_arrays, read_gaussians, write_gaussians
from snowsplat.formats.ply import is_antialiased
from snowsplat.scene.gaussians import Gaussians

READ_BACK = [format for format in FORMATS if format.read and format.write]
MARKED = (".ply", ".compressed.ply", ".spz", ".sog", "/lod-meta.json")


@pytest.fixture
def antialiased(make_scene) -> Gaussians:
    scene = make_scene(50, 1)
    scene.antialiased = True
    return scene


@pytest.mark.parametrize("format", READ_BACK, ids=lambda format: format.name)
def test_the_mark_is_read_back_or_its_loss_is_told(tmp_path, caplog, antialiased, format):
    path = tmp_path / f"a{format.suffixes[0]}"
    with caplog.at_level(logging.WARNING):
        write_gaussians(path, antialiased)
    assert read_gaussians(path).antialiased == format.marks_antialiased
    assert format.marks_antialiased == (format.suffixes[0] in MARKED)
    assert ("files cannot say so" in caplog.text) != format.marks_antialiased


@pytest.mark.parametrize("format", READ_BACK, ids=lambda format: format.name)
def test_other_scenes_have_no_mark(tmp_path, caplog, make_scene, format):
    path = tmp_path / f"a{format.suffixes[0]}"
    with caplog.at_level(logging.WARNING):
        write_gaussians(path, make_scene(50, 1))
    assert not read_arrays(path).antialiased
    assert not caplog.text


def test_the_comment_of_a_ply_is_the_usual_one(tmp_path, antialiased):
    for name in ("a.ply", "a.compressed.ply"):
        write_gaussians(tmp_path / name, antialiased)
        head = (tmp_path / name).read_bytes().split(b"element", 1)[0]
        assert head == b"ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\n"


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        ((), False),
        (("Exported from Brush", "SplatRenderMode: mip"), True),
        (("splatrendermode: MIP", "SH degree: 3"), True),
        (("SplatRenderMode: mip", "SplatRenderMode: default"), False),
        (("antialiased 1",), True),
        (("antialiased 0",), False),
        (("postshot.anti_aliasing=1",), True),
        (("not antialiased 1", "mip", "SplatRenderMode: 2dgs"), False),
    ],
)
def test_comments_of_other_programs(tmp_path, make_scene, comments, expected):
    path = tmp_path / "a.ply"
    write_gaussians(path, make_scene(3, 0))
    lines = "".join(f"comment  {comment} \r\n" for comment in comments).encode()
    path.write_bytes(path.read_bytes().replace(b"element", lines + b"element", 1))
    assert read_gaussians(path).antialiased == expected
    assert is_antialiased(comments) == expected


@pytest.mark.parametrize("mark", [True, False])
def test_a_sog_may_have_the_older_mark(tmp_path, make_scene, mark):
    write_gaussians(tmp_path / "a.sog", make_scene(3, 0))
    with zipfile.ZipFile(tmp_path / "a.sog") as packed:
        packed.extractall(tmp_path)
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps(meta | {"antialias": mark}))
    assert read_gaussians(tmp_path / "meta.json").antialiased == mark
