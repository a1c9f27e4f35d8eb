"""notebooks/exercises/nano.py, the course in one file: it learns, and its scenes can be read."""

import importlib.util
import re
from functools import reduce
from pathlib import Path

import pytest
import torch

from snowsplat import Gaussians, ops
from snowsplat.formats import read_gaussians
from snowsplat.ops import reference
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import render
from snowsplat.synthetic.toy_dataset import write_toy_dataset

FILE = Path(__file__).resolve().parents[2] / "notebooks" / "exercises" / "nano.py"
PAGES = FILE.parents[2] / "docs" / "learn"


@pytest.fixture(scope="module")
def nano():
    spec = importlib.util.spec_from_file_location("nano", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def trained(nano, tmp_path_factory):
    """The photos of a toy dataset, the Gaussians after a short training, and the losses."""
    folder = write_toy_dataset(tmp_path_factory.mktemp("toy"), n_views=4, n_points=300)
    torch.manual_seed(0)
    views, points, colors = nano.read_dataset(folder, width=40)
    gaussians, losses = nano.train(views, nano.first_gaussians(points, colors), 24, limit=400)
    return views, gaussians, losses


def test_it_reads_photos_and_their_cameras(trained):
    views, _, _ = trained
    assert [view.photo.shape for view in views] == [(3, 30, 40)] * 4  # 64×48 before
    assert views[0].f.tolist() == pytest.approx([0.9 * 40, 0.9 * 40])
    assert views[0].c.tolist() == pytest.approx([20, 15])


def test_the_loss_falls_and_gaussians_are_added(trained):
    _, gaussians, losses = trained
    assert sum(losses[-4:]) < 0.6 * sum(losses[:4])
    assert 300 < len(gaussians) <= 400


def test_snowsplat_draws_its_file_as_it_does(nano, trained, tmp_path):
    views, gaussians, _ = trained
    nano.write_ply(tmp_path / "nano.ply", gaussians)
    scene = read_gaussians(tmp_path / "nano.ply")
    assert scene.sh_rest.shape[1] == 15
    for view in views:
        image = nano.render(gaussians, view)[0].permute(1, 2, 0)
        camera = Camera(40, 30, *view.f.tolist(), *view.c.tolist(), view.pose.double())
        assert torch.allclose(render(scene, camera).image, image, atol=2e-3)


def test_gradients_are_those_of_the_reference(nano, trained):
    views, gaussians, _ = trained
    view, height, width = views[0], 30, 40
    leaf = gaussians.double().requires_grad_()
    mean, sh_dc, sh_rest, logit, log_scales, quats = leaf.split(nano.COLUMNS, dim=1)
    h = torch.cat([sh_dc[:, :, None], sh_rest.reshape(-1, 3, 15)], dim=2).mT
    scene = Gaussians(mean, log_scales, quats, logit[:, 0], h[:, :1], h[:, 1:9])
    ops_view = ops.View(
        view.pose.double(), width, height, *view.f.tolist(), *view.c.tolist(), sh_degree=2
    )
    splats = reference.project(scene, ops_view)
    photo = view.photo.permute(1, 2, 0).double()
    loss = reference.photometric_loss(reference.rasterize(splats, width, height)[0], photo)
    (expected,) = torch.autograd.grad(loss, leaf)

    ours = gaussians.clone().requires_grad_()
    own_loss = nano.loss_of(nano.render(ours, view)[0], view.photo)
    (found,) = torch.autograd.grad(own_loss, ours)
    assert own_loss.item() == pytest.approx(loss.item(), rel=1e-4)
    for column, size in zip(
        found.split(nano.COLUMNS, 1), expected.split(nano.COLUMNS, 1), strict=True
    ):
        assert torch.allclose(column.double(), size, atol=0.02 * float(size.abs().max()))


def test_each_part_is_named_on_the_page_that_explains_it(nano):
    """The pages name parts that exist; the docstrings, pages that exist; at most 300 lines."""
    text = FILE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 300
    for page in re.findall(r"([\w-]+)\.md", text):
        assert (PAGES / f"{page}.md").exists(), page
    named = set()
    for page in PAGES.glob("*.md"):
        for line in page.read_text(encoding="utf-8").splitlines():
            if "nano.py)" in line:
                named |= set(re.findall(r"`([\w.]+)`", line.partition("nano.py)")[2]))
    for name in named:
        assert reduce(getattr, name.split("."), nano)
    parts = set(re.findall(r"^(?:def|class) (\w+)", text, re.MULTILINE))
    assert parts <= {name.partition(".")[0] for name in named}
