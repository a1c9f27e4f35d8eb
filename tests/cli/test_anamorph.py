"""`snowsplat anamorph`: its lines, in English and Chinese, and its errors."""

import pytest
from PIL import Image

SMALL = ("--cells", 8, "--size", 32, "--steps", 1)


@pytest.fixture
def pictures(tmp_path):
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path, color in zip(paths, ("red", "blue"), strict=True):
        Image.new("RGB", (40, 50), color).save(path)
    return paths


def test_what_it_made_is_named(run, pictures, tmp_path, monkeypatch):
    out = tmp_path / "out"
    result = run("anamorph", *pictures, "-o", out, *SMALL)
    assert result.code == 0, result.err
    assert "128 Gaussians; PSNR of the pictures" in result.out
    assert f"open {out / 'anamorph.html'}" in result.out
    monkeypatch.setenv("LANG", "zh_CN.UTF-8")
    result = run("anamorph", *pictures, "-o", out, *SMALL, "--shape", "solid", "--overwrite")
    assert result.code == 0, result.err
    assert "个高斯" in result.out
    assert f"snowsplat mesh {out} -o {out / 'mesh.ply'} --gaussians-only" in result.out


def test_errors(refused, pictures, tmp_path):
    assert "two or three pictures, not 1" in refused("anamorph", pictures[0], "-o", tmp_path / "o")
    assert "needs pictures and an output folder" in refused("anamorph", *pictures)
    small = ("anamorph", *pictures, "-o", tmp_path / "o", "--cells", 4)
    assert "--cells: 4 is too small" in refused(*small)
