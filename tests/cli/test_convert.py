"""`convert`, and `info` about its output: all pairs of formats, edits, invalid input."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.formats import FORMATS, read_gaussians, write_gaussians
from snowsplat.pipeline.convert import transform_of
from snowsplat.pipeline.options.scene import Edits, file_size
from snowsplat.scene import edit
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.simplify import simplify

READ_BACK = [f for f in FORMATS if f.write and f.read]


def scene(n: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    rest = 0.1 * normal(n, SH_REST_COUNTS[degree], 3)
    return Gaussians(
        normal(n, 3), normal(n, 3) - 3, normal(n, 4), normal(n), 0.5 * normal(n, 1, 3), rest
    )


@pytest.fixture
def ply(tmp_path) -> Path:
    write_gaussians(tmp_path / "a.ply", scene(400, 2))
    return tmp_path / "a.ply"


@pytest.mark.parametrize("format", READ_BACK, ids=lambda format: format.name)
def test_every_format_is_written_read_and_described(run, ply, tmp_path, format):
    """Each into each other: tests/formats/test_what_is_lost.py."""
    once = tmp_path / f"once{format.suffixes[0]}"
    result = run("convert", ply, once)
    assert result.code == 0, result.err
    assert "lost in this format" in result.out
    assert run("convert", once, tmp_path / "back.ply").code == 0
    read, means = read_gaussians(tmp_path / "back.ply"), read_gaussians(ply).means
    assert read.sh_degree == (0 if format.name == "splat" else 2)
    torch.testing.assert_close(read.means.sort(0).values, means.sort(0).values, rtol=0, atol=0.01)
    assert run("info", once).code == 0
    facts = json.loads(run("info", once, "--json").out)
    assert (facts["kind"], facts["gaussians"]) == ("scene", 400)
    assert facts["format"].startswith(format.name)
    assert facts["lost_in_it"] == str(format.loses)
    assert facts["bytes"] == format.size(once) >= once.stat().st_size
    bounds = np.array(facts["bounds"])
    np.testing.assert_allclose(bounds, [means.amin(0), means.amax(0)], atol=0.01)


def test_without_edits_the_file_is_the_same(run, ply, tmp_path):
    assert run("convert", ply, tmp_path / "b.ply").code == 0
    assert (tmp_path / "b.ply").read_bytes() == ply.read_bytes()


def test_edits_and_their_order(run, ply, tmp_path):
    flags = ("--crop", -1, -1, -1, 1, 0.5, 1, "--rotate", 0, 0, 90, "--scale", 2)
    flags += ("--translate", 10, 0, -1, "--sh-degree", 1, "--decimate", "50%")
    result = run("convert", ply, tmp_path / "b.ply", *flags)
    assert result.code == 0, result.err
    before, after = read_gaussians(ply), read_gaussians(tmp_path / "b.ply")
    inside = edit.crop(before, torch.tensor([[-1, -1, -1], [1, 0.5, 1]]))
    assert len(after) == round(len(inside) / 2) > 20
    assert after.sh_degree == 1
    # A quarter turn about z takes x to y, and y to -x.
    smaller = simplify(edit.with_sh_degree(inside, 1), len(after))
    x, y, z = smaller.means.T
    expected = 2 * torch.stack([-y, x, z], 1) + torch.tensor([10, 0, -1])
    torch.testing.assert_close(after.means, expected)
    turn = transform_of(Edits(rotate=(0, 0, 90), scale=2, translate=(10, 0, -1)))
    torch.testing.assert_close(after.sh_rest, edit.transform(smaller, turn).sh_rest)


def test_the_size_of_the_file(run, refused, ply, tmp_path):
    for name, size in (("b.ply", "20KB"), ("b.spz", "4 kb"), ("b.sog", "0.024MB")):
        result = run("convert", ply, tmp_path / name, "--decimate", size)
        assert result.code == 0, result.err
        limit = file_size(size)
        assert 0.8 * limit < (tmp_path / name).stat().st_size <= limit
    assert "no scene fits into 1.0 kB" in refused(
        "convert", ply, tmp_path / "c.ply", "--decimate", "1KB"
    )
    assert sorted(path.name for path in tmp_path.iterdir() if path != ply) == [
        "b.ply",
        "b.sog",
        "b.spz",
    ]


def test_rotations_are_about_x_then_y_then_z(run, tmp_path):
    one = scene(1, 0)
    one.means[:] = torch.tensor([[0.0, 1.0, 0.0]])
    write_gaussians(tmp_path / "a.ply", one)
    assert run("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--rotate", 90, 90, 0).code == 0
    # y to z, then z to x.
    means = read_gaussians(tmp_path / "b.ply").means
    torch.testing.assert_close(means, torch.tensor([[1.0, 0.0, 0.0]]), rtol=0, atol=1e-6)


def test_antialiased_scenes_are_marked(run, ply, tmp_path):
    mip = scene(30, 2, seed=1)
    mip.antialiased = True
    write_gaussians(tmp_path / "b.spz", mip)
    edits = ("--rotate", 0, 0, 90, "--sh-degree", 1, "--decimate", "50%")
    assert run("convert", tmp_path / "b.spz", tmp_path / "c.sog", *edits).code == 0
    assert read_gaussians(tmp_path / "c.sog").antialiased
    lost = run("convert", tmp_path / "b.spz", tmp_path / "c.splat")
    assert lost.code == 0
    assert "splat files cannot say so" in lost.err
    mixed = run("convert", ply, tmp_path / "b.spz", tmp_path / "d.ply")
    assert mixed.code == 0
    assert "only some of the scenes are antialiased" in mixed.err
    assert not read_gaussians(tmp_path / "d.ply").antialiased


def test_an_existing_file(run, refused, ply, tmp_path):
    target = tmp_path / "b.spz"
    target.write_bytes(b"mine")
    assert "--overwrite" in refused("convert", ply, target)
    assert target.read_bytes() == b"mine"
    assert run("convert", ply, target, "--overwrite").code == 0
    assert run("convert", ply, ply, "--overwrite", "--decimate", 9).code == 0  # in place
    assert len(read_gaussians(ply)) == 9


def test_invalid_input(refused, ply, tmp_path):
    out = tmp_path / "b.ply"
    assert "name of a file" in refused("convert", ply)
    assert "use snowsplat mesh" in refused("convert", ply, tmp_path / "b.obj")
    assert "selects no scene format" in refused("convert", ply, tmp_path / "b.ksplat")
    assert "no such file" in refused("convert", tmp_path / "absent.ply", out)
    assert "is a folder" in refused("convert", ply, tmp_path)
    assert "0 to 3" in refused("convert", ply, out, "--sh-degree", 4)
    assert "above 0" in refused("convert", ply, out, "--scale", 0)
    assert "above 0" in refused("convert", ply, out, "--scale", "nan")
    assert "finite" in refused("convert", ply, out, "--translate", "inf", 0, 0)
    assert "lower corner first" in refused("convert", ply, out, "--crop", 0, 0, 0, 1, -1, 1)
    assert "no Gaussian is in" in refused("convert", ply, out, "--crop", 9, 9, 9, 10, 10, 10)
    for wrong in ("some", "-3", "101%", "1.5", "%"):
        assert "--decimate" in refused("convert", ply, out, f"--decimate={wrong}")
    assert not out.exists()


def test_info_reports_versions_and_rejects_pages(run, refused, ply, tmp_path):
    assert run("convert", ply, tmp_path / "b.spz").code == 0
    assert json.loads(run("info", tmp_path / "b.spz", "--json").out)["format"] == "SPZ 3"
    assert run("convert", ply, tmp_path / "b.sog").code == 0
    assert json.loads(run("info", tmp_path / "b.sog", "--json").out)["format"] == "SOG 2"
    assert run("convert", ply, tmp_path / "b.html").code == 0
    assert "use the scene file that the page was made from" in refused("info", tmp_path / "b.html")


def test_the_page_of_a_training_run_starts_at_the_view_of_a_photo(run, ply, tmp_path):
    folder = tmp_path / "out/point_cloud/iteration_7"
    folder.mkdir(parents=True)
    shutil.copy(ply, folder / "point_cloud.ply")
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, look_at(*torch.eye(3).double()))
    write_cameras(tmp_path / "out/cameras.json", [("a.jpg", camera)])
    assert run("convert", tmp_path / "out", tmp_path / "with.html").code == 0
    assert run("convert", ply, tmp_path / "without.html").code == 0
    with_cameras, without = (
        re.search(r'id="sse-bootstrap">\s*(.*?)\s*</script>', page.read_text(), re.DOTALL)
        for page in (tmp_path / "with.html", tmp_path / "without.html")
    )
    assert json.loads(with_cameras[1])["settings"] != json.loads(without[1])["settings"]
