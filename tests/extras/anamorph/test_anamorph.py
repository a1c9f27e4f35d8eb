"""An anamorph: each side shows its own picture; a solid is a closed pile that hides nothing."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.anamorph import arrangement
from snowsplat.extras.anamorph.make_anamorph import make_anamorph
from snowsplat.extras.anamorph.options import AnamorphOptions
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.mesh import surface_of
from snowsplat.pipeline.options.scene import MeshOptions
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.scene.mesh import filled_holes
from snowsplat.scene.render import render, to_8bit
from snowsplat.util.errors import UserError

from ..image.photos import photo

SMALL = AnamorphOptions(cells=24, size=48, steps=60)
TINY = AnamorphOptions(cells=8, size=32, steps=0)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> list[Path]:
    """Three photos of different shapes."""
    folder, pixels = tmp_path_factory.mktemp("pictures"), photo(90, 60)
    paths = [folder / f"{name}.png" for name in "abc"]
    turned = pixels.flip(0, 1), pixels.transpose(0, 1).flip(2), 1 - pixels
    for path, image in zip(paths, turned, strict=True):
        Image.fromarray(to_8bit(image)).save(path)
    return paths


def sides(scene: Path, count: int) -> list[Tensor]:
    gaussians = read_gaussians(scene)
    assert gaussians.sh_degree == 0
    return [render(gaussians, arrangement.camera_of(i, 55)).image for i in range(count)]


@pytest.mark.parametrize("count", [2, 3])
def test_each_side_shows_its_own_picture(count, pictures, tmp_path):
    result = make_anamorph(pictures[:count], tmp_path / "out", SMALL, threads=1)
    assert min(result.psnr) > 24
    shown = sides(result.scene, count)
    photos = sorted((tmp_path / "out" / "pictures" / "images").iterdir())
    assert [file.stem for file in photos] == ["front", "right", "top"][:count]
    for i, image in enumerate(shown):
        saved = torch.tensor(np.array(Image.open(photos[i]))) / 255
        assert psnr(image, saved) == pytest.approx(result.psnr[i], abs=0.1)
        assert all(psnr(image, other) < 18 for other in shown[:i] + shown[i + 1 :])
    between = arrangement.camera_around((1.0, 0.0, -1.0), 55)  # one sees neither picture
    assert psnr(render(read_gaussians(result.scene), between).image, shown[0]) < 18
    assert "<title>out" in result.page.read_text(encoding="utf-8")


def test_each_line_of_sight_meets_the_pile_once():
    """The cells of all sides are the faces of one pile: compare with walks through it."""
    m = 32 // arrangement._BLOCK
    front, right, above = arrangement._pile(32)[:, :: arrangement._BLOCK, :: arrangement._BLOCK]
    place = (torch.arange(m) + 0.5) / m - 0.5
    x, y, z = torch.meshgrid(place, place, place, indexing="ij")
    solid = z > front.T[:, :, None]  # from the front: rows are y
    wall = arrangement._WALL
    assert solid[:wall].all()
    assert solid[:, -wall:].all()
    assert solid[:, :, -wall:].all()
    assert not solid.all()
    # From the right: columns are z, and the depth is −x. From above: columns are x, rows are −z.
    assert torch.equal(solid, -x > right[None])
    assert torch.equal(solid, y > above.flip(0).T[:, None, :])
    # No face hides another one: going away from the corner, one leaves the pile only once.
    for axis, direction in ((0, 1), (1, -1), (2, -1)):
        steps = solid.int().diff(dim=axis) * direction
        assert (steps <= 0).all()


def test_a_solid_of_two_pictures_has_a_plain_top_and_becomes_a_closed_mesh(pictures, tmp_path):
    options = AnamorphOptions(shape="solid", cells=32, size=96, steps=20)
    result = make_anamorph(pictures[:2], tmp_path, options, threads=1)
    assert result.gaussians == 6 * 32 * 32
    assert len(result.psnr) == 3
    mesh = surface_of(load_trained(tmp_path), MeshOptions(gaussians_only=True)).mesh
    assert torch.tensor(mesh.vertices).abs().amax(0) == pytest.approx([0.5] * 3, abs=0.06)
    corners = torch.tensor(mesh.vertices)[torch.tensor(mesh.faces).long()].double()
    assert len(filled_holes(mesh.vertices, mesh.faces)[0]) == len(mesh.vertices)  # no holes
    volume = torch.linalg.det(corners).sum() / 6
    assert float(volume) == pytest.approx(0.5 - float(arrangement._pile(32)[0].mean()), rel=0.03)


@pytest.mark.parametrize("count", [0, 1, 4])
def test_the_number_of_pictures_is_two_or_three(count, pictures, tmp_path):
    with pytest.raises(UserError, match=f"two or three pictures, not {count}"):
        make_anamorph([*pictures, pictures[0]][:count], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_there_is_kept(pictures, tmp_path):
    make_anamorph(pictures[:2], tmp_path, TINY)
    with pytest.raises(UserError, match="overwrite"):
        make_anamorph(pictures[:2], tmp_path)
    with pytest.raises(UserError, match=r"no\.jpg"):
        make_anamorph([*pictures[:1], tmp_path / "no.jpg"], tmp_path, overwrite=True)
    make_anamorph(pictures[:2], tmp_path, TINY, overwrite=True)
