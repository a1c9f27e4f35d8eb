"""Exchange of `.spz` files with Niantic's implementation, in both directions."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch

from snowsplat.formats import read_gaussians
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.spz import write_spz
from snowsplat.scene.gaussians import Gaussians

from .conftest import NodeProgram


@pytest.fixture(scope="module")
def reference() -> Iterator[NodeProgram]:
    """The answers are scenes as `from_json` expects them."""
    with NodeProgram("spz.mjs", "@adobe/spz") as program:
        yield program


def from_json(scene: dict[str, Any]) -> Gaussians:
    n = scene["numPoints"]
    columns = {
        name: torch.tensor(scene[name], dtype=torch.float32)
        for name in ("positions", "scales", "rotations", "alphas", "colors", "sh")
    }
    return Gaussians(
        columns["positions"].view(n, 3),
        columns["scales"].view(n, 3),
        columns["rotations"].view(n, 4).roll(1, 1),  # xyzw there
        columns["alphas"],
        columns["colors"].view(n, 1, 3),
        columns["sh"].view(n, (scene["shDegree"] + 1) ** 2 - 1, 3),
    )


def to_json(scene: Gaussians) -> dict[str, Any]:
    return {
        "numPoints": len(scene),
        "shDegree": scene.sh_degree,
        "positions": scene.means.flatten().tolist(),
        "scales": scene.log_scales.flatten().tolist(),
        "rotations": scene.rotations.roll(-1, 1).flatten().tolist(),
        "alphas": scene.opacity_logits.tolist(),
        "colors": scene.sh_dc.flatten().tolist(),
        "sh": scene.sh_rest.flatten().tolist(),
    }


def assert_same(a: Gaussians, b: Gaussians) -> None:
    assert a.sh_degree == b.sh_degree
    for name in ("means", "log_scales", "sh_dc", "sh_rest"):
        x, y = getattr(a, name), getattr(b, name)
        torch.testing.assert_close(x, y, rtol=0, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    torch.testing.assert_close(a.opacities, b.opacities, rtol=0, atol=1.1e-3)  # 0 and 255
    assert ((a.rotations * b.rotations).sum(1).abs() > 1 - 1e-6).all()


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_niantics_reader_agrees_with_ours_on_our_files(
    tmp_path, make_scene, reference, version, degree
):
    write_spz(tmp_path / "a.spz", GaussianArrays.from_gaussians(make_scene(300, degree)), version)
    ours = read_gaussians(tmp_path / "a.spz")
    assert_same(from_json(reference.ask({"path": str(tmp_path / "a.spz")})), ours)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 3])
def test_our_reader_agrees_with_niantics_on_its_files(
    tmp_path, make_scene, reference, version, degree
):
    scene = make_scene(300, degree)
    path = tmp_path / "a.spz"
    theirs = reference.ask({"path": str(path), "version": version, "scene": to_json(scene)})
    ours = read_gaussians(path)
    assert_same(from_json(theirs), ours)
    torch.testing.assert_close(ours.means, scene.means, rtol=0, atol=0.51 / 4096)
