"""`benchmarks/viewers.py`: cameras of other viewers, their packages, and one of them for real."""

import json
import re
import sys
from pathlib import Path

import pytest
import torch

from snowsplat.formats import read_gaussians
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def viewers(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import viewers

    yield viewers
    sys.modules.pop("viewers", None)


@pytest.fixture
def camera() -> Camera:
    up = torch.tensor([0.0, -1.0, 0.0])
    pose = look_at(torch.tensor([0.5, -1.0, -5.0]), torch.zeros(3), up)
    return Camera(160, 120, 150.0, 150.0, 80.0, 60.0, pose)


def scene(n: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    sh = 0.3 * normal(n, 1, 3)
    return Gaussians(normal(n, 3), normal(n, 3) - 3, normal(n, 4), normal(n), sh, sh[:, :0])


@pytest.mark.parametrize("suffix", [".ply", ".v2.spz"])
def test_cameras_are_in_the_frame_of_the_file(viewers, camera, tmp_path, suffix):
    viewers.write(tmp_path / f"a{suffix}", scene(5))
    matrix = torch.tensor(viewers.world_from_camera(camera, suffix), dtype=torch.float64)
    world_from_camera = matrix.reshape(4, 4).T
    # A point of the file in front of a camera of OpenGL axes is at the same place of the image.
    means = read_gaussians(tmp_path / f"a{suffix}").means.double()
    signs = torch.tensor([1.0, -1.0, -1.0]).double()
    in_file = means * signs if suffix.endswith(".spz") else means
    ones = torch.ones(5, 1, dtype=torch.float64)
    seen = torch.cat([in_file, ones], 1) @ torch.linalg.inv(world_from_camera).T
    expected = means @ camera.cam_from_world[:, :3].double().T + camera.cam_from_world[:, 3]
    torch.testing.assert_close(seen[:, :3] * signs, expected, rtol=0, atol=1e-6)


def test_packages_have_exact_versions_and_an_address_in_the_page(viewers):
    packages = json.loads((viewers.FOLDER / "package.json").read_text())["dependencies"]
    page = (viewers.FOLDER / "index.html").read_text()
    for name, version in packages.items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version), name
        assert f'"{name}' in page
    for viewer in viewers.VIEWERS:
        assert viewer.package in packages
        assert (viewers.FOLDER / f"{viewer.script}.js").is_file()


def test_rows_below_the_limits_are_counted(viewers, camera, tmp_path, monkeypatch, capsys):
    (tmp_path / "package.json").write_text((viewers.FOLDER / "package.json").read_text())
    monkeypatch.setattr(viewers, "FOLDER", tmp_path)

    class Fixed(viewers.Comparison):
        def psnr(self, viewer, suffix, options):
            if (viewer.name, suffix) == ("Spark", ".sog"):
                raise viewers.BrowserError("no picture")
            low = (viewer.name, suffix) == ("gsplat.js", ".ply")
            return viewer.formats[suffix] - (0.01 if low and options else 0.0)

    comparison = Fixed(scene(5), [camera], None, "", tmp_path, None)
    for viewer in viewers.VIEWERS:
        (tmp_path / "node_modules" / viewer.package).mkdir(parents=True)
    assert viewers.rows(comparison, list(viewers.VIEWERS), []) == 2
    printed = capsys.readouterr()
    assert printed.out.count("| Spark 2.2.0 |") == 6
    assert "Spark, .sog: no picture" in printed.err
    assert viewers.rows(comparison, list(viewers.VIEWERS), [".splat"]) == 0
