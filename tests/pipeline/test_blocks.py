"""`blocks`: cells, the datasets of blocks, training in any order, merging."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat import load_dataset, read_gaussians, recipe
from snowsplat.cli import main as cli
from snowsplat.formats.ply import read_ply
from snowsplat.pipeline.blocks.content import Cell, block_content, cut, ground_axes
from snowsplat.pipeline.blocks.plan import Plan, plan_blocks
from snowsplat.pipeline.blocks.train import merge_blocks, train_blocks
from snowsplat.pipeline.options.benchmark import PlanOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.render import evaluate
from snowsplat.pipeline.train import train
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message
from snowsplat.util.run_lock import InUse, one_run

SETTINGS = {"iterations": 20, "max_gaussians": 600, "init": "points"}
OPTIONS = PlanOptions(blocks=3, settings=SETTINGS, hold_out=8)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("blocks") / "toy", n_views=18, n_points=900)


@pytest.fixture(scope="module")
def planned(dataset) -> Path:
    folder = dataset.parent / "planned"
    plan_blocks(dataset, folder, OPTIONS)
    return folder


@pytest.fixture(scope="module")
def trained(planned) -> Path:
    folder = planned.parent / "trained"
    shutil.copytree(planned, folder, symlinks=True)
    train_blocks(folder)
    merge_blocks(folder)
    return folder


@pytest.mark.parametrize("count", [1, 2, 3, 6, 7])
def test_cells_are_disjoint_cover_the_plane_and_have_equal_content(count):
    random = torch.Generator().manual_seed(count)
    cameras = torch.rand(140, 2, generator=random, dtype=torch.float64) * torch.tensor([10.0, 4.0])
    points = torch.randn(3000, 2, generator=random, dtype=torch.float64) * 2 + 3
    cells = cut(cameras, points, count)
    assert len(cells) == count
    everywhere = torch.cat([100 * torch.randn(500, 2, generator=random), cameras, points])
    on_borders = [[x, y] for cell in cells for x in cell.low for y in cell.low if x and y]
    everywhere = torch.cat([everywhere, torch.tensor(on_borders).reshape(-1, 2)])
    inside = torch.stack([cell.contains(everywhere) for cell in cells])
    assert (inside.sum(0) == 1).all()
    content = [
        float(cell.contains(cameras).double().mean() + cell.contains(points).double().mean()) / 2
        for cell in cells
    ]
    assert content == pytest.approx([1 / count] * count, abs=0.01)


def test_a_margin_expands_a_cell_only_where_it_ends():
    cell = Cell((None, 1.0), (5.0, 2.0))
    ground = torch.tensor([[-9.0, 1.5], [5.4, 1.5], [4.0, 0.7], [4.0, 2.8]])
    assert cell.contains(ground).tolist() == [True, False, False, False]
    assert cell.contains(ground, (0.5, 0.4)).tolist() == [True, True, True, False]


def test_the_ground_plane_is_where_the_cameras_are():
    random = torch.Generator().manual_seed(0)
    positions = torch.randn(50, 3, generator=random) * torch.tensor([9.0, 0.2, 4.0])
    axes = ground_axes(positions)
    assert axes @ axes.T == pytest.approx(torch.eye(2), abs=1e-9)
    assert axes.abs()[:, [0, 2]] == pytest.approx(torch.eye(2), abs=0.2)


def test_the_photos_of_a_block_are_near_it_or_show_it(dataset):
    whole = load_dataset(dataset)
    axes, blocks = block_content(whole, 3, 0.2)
    ground = torch.tensor(axes, dtype=torch.float64)
    names = set()
    for block in blocks:
        inside = {
            view.name
            for view in whole.train
            if block.cell.contains(view.camera.position[None].double() @ ground.T)
        }
        assert inside <= {view.name for view in block.views}
        names |= inside
        within = block.cell.contains(whole.points.xyz.double() @ ground.T)
        own = block.cell.contains(block.points.xyz.double() @ ground.T)
        assert int(own.sum()) == int(within.sum())  # all of its points …
        assert int((~own).sum()) > 0  # … and some from outside
        assert block.share == len(block.points) / len(whole.points)
    assert names == {view.name for view in whole.train}


def test_a_block_is_an_ordinary_dataset_without_copies(dataset, planned):
    plan = Plan.read(planned)
    whole = {view.name: view for view in load_dataset(dataset, hold_out=8).train}
    assert [block.name for block in plan.blocks] == ["block_01", "block_02", "block_03"]
    assert (recipe().exposure, plan.settings["exposure"]) == ("auto", "off")
    for block in plan.blocks:
        own = load_dataset(planned / block.name / "dataset", hold_out=None)
        assert len(own.train) == block.views
        assert len(own.points) == block.points
        for view in own.train:
            same = whole[view.name]  # so no photo is held out
            assert view.image.path.is_symlink()
            assert not os.path.isabs(os.readlink(view.image.path))
            assert view.image.path.resolve() == same.image.path.resolve()
            assert torch.allclose(view.camera.cam_from_world, same.camera.cam_from_world)
            assert view.camera.fx == same.camera.fx
    limit = SETTINGS["max_gaussians"]
    assert all(0.3 * limit < block.max_gaussians < limit for block in plan.blocks)


def test_masks_depth_maps_smaller_copies_and_names_without_suffix(tmp_path):
    folder = write_toy_dataset(tmp_path / "toy", "blender", n_views=10)
    (folder / "depths").mkdir()
    for photo in (folder / "train").iterdir():
        np.save(folder / "depths" / f"{photo.stem}.npy", np.ones((6, 8), np.float32))
    plan_blocks(folder, tmp_path / "blocks", replace(OPTIONS, blocks=2))
    own = load_dataset(tmp_path / "blocks" / "block_01" / "dataset", hold_out=None)
    assert own.points is None
    assert all(view.name.startswith("train/") for view in own.train)
    for view in own.train:
        assert view.depth.resolve() == folder / "depths" / f"{Path(view.name).stem}.npy"

    colmap = write_toy_dataset(tmp_path / "colmap", n_views=10)
    (colmap / "images_2").mkdir()
    (colmap / "masks").mkdir()
    for photo in (colmap / "images").iterdir():
        with Image.open(photo) as image:
            image.resize((32, 24)).save(colmap / "images_2" / photo.name)
            Image.new("L", image.size, 255).save(colmap / "masks" / f"{photo.name}.png")
    plan_blocks(colmap, tmp_path / "half", replace(OPTIONS, blocks=2, resolution=2))
    own = load_dataset(tmp_path / "half" / "block_02" / "dataset", resolution=2, hold_out=None)
    for view in own.train:
        assert view.image.path.parent.name == "images_2"
        assert (view.camera.width, view.image.width) == (32, 32)
        assert view.mask is not None


@pytest.mark.slow
def test_the_merged_scene_has_the_gaussians_that_reach_a_cell(trained):
    plan = Plan.read(trained)
    merged = read_gaussians(trained / "point_cloud" / "iteration_20" / "point_cloud.ply")
    start = 0
    for block in plan.blocks:
        scene = trained / block.name / "scene" / "point_cloud" / "iteration_20" / "point_cloud.ply"
        own = read_gaussians(scene)
        rotation, scale = rotation_from_quat(own.quats), own.log_scales.exp()
        covariance = rotation @ torch.diag_embed(scale**2) @ rotation.transpose(1, 2)
        axes = torch.tensor(plan.axes)
        variance = torch.einsum("ai,nij,aj->na", axes, covariance, axes)
        inside = block.cell.contains(plan.ground(own.means))
        kept = block.cell.contains(plan.ground(own.means), 2 * variance.sqrt())
        assert 0 < int(inside.sum()) < int(kept.sum()) < len(own)
        part = merged.means[start : start + int(kept.sum())]
        assert torch.equal(part, own.means[kept])
        start += len(part)
    assert start == len(merged)


@pytest.mark.slow
def test_evaluate_uses_the_held_out_photos_of_the_whole(dataset, trained):
    evaluation = evaluate(load_trained(trained))
    held_out = [view.name for view in load_dataset(dataset, hold_out=8).test]
    assert [view.name for view in evaluation.views] == held_out
    cameras = json.loads((trained / "cameras.json").read_text(encoding="utf-8"))
    assert len(cameras) == 18


@pytest.mark.nightly
def test_the_merged_scene_has_no_gaps(dataset, tmp_path):
    settings = SETTINGS | {"iterations": 200}
    train(dataset, tmp_path / "whole", TrainOptions(settings=settings, hold_out=8))
    plan_blocks(dataset, tmp_path / "blocks", replace(OPTIONS, settings=settings))
    train_blocks(tmp_path / "blocks")
    merge_blocks(tmp_path / "blocks")
    whole, merged = (evaluate(load_trained(tmp_path / name)) for name in ("whole", "blocks"))
    assert whole.psnr > 25
    # The scene is cut through its middle, and its Gaussians are as large as the cells. Without the
    # photos and points from outside of a cell, it is 16 dB.
    assert merged.psnr > 20


@pytest.mark.slow
def test_any_order_elsewhere_and_interrupted_gives_the_same_scene(planned, trained, tmp_path):
    """Blocks may be trained by `train`, on copies of their datasets, and by several processes."""
    folder = planned.parent / "again"  # beside the dataset, because links are relative
    shutil.copytree(planned, folder, symlinks=True)
    plan = Plan.read(folder)
    lines: list[Message] = []
    with one_run(folder / "block_02"):
        results = train_blocks(folder, [3, 2], on_block=lines.append)
        with pytest.raises(InUse, match=rf"block_02: in use by process {os.getpid()} on "):
            train_blocks(folder, [2])
    assert len(results) == 1
    assert "block_02: in use by" in str(lines[0])
    assert str(lines[1]).startswith("block_03: ")
    with pytest.raises(UserError, match=r"block_01: not trained; run .* `block` 1"):
        merge_blocks(folder)

    # The first 10 steps of block 2, as if its process had been killed after a checkpoint.
    block = plan.blocks[1]
    options = TrainOptions(
        settings=plan.settings | {"max_gaussians": block.max_gaussians, "checkpoint_every": 10},
        resolution=-1,
    )
    train(folder / "block_02" / "dataset", folder / "block_02" / "scene", options)
    out = folder / "block_02" / "scene"
    shutil.rmtree(out / "point_cloud")
    for file in (out / "checkpoints").iterdir():
        if "step_000020" in file.name:
            file.unlink()
    # A copy of block 1 without links, trained by the ordinary function.
    copy = tmp_path / "copy"
    shutil.copytree(folder / "block_01" / "dataset", copy)
    limit = {"max_gaussians": plan.blocks[0].max_gaussians}
    options = replace(options, settings=plan.settings | limit)
    train(copy, folder / "block_01" / "scene", options)

    lines.clear()
    train_blocks(folder, on_block=lines.append)
    assert str(lines[0]) == "block_01: finished"
    assert str(lines[1]).startswith("block_02: ")
    assert str(lines[2]) == "block_03: finished"
    merge_blocks(folder, tmp_path / "scene.ply")
    expected = trained / "point_cloud" / "iteration_20" / "point_cloud.ply"
    assert (tmp_path / "scene.ply").read_bytes() == expected.read_bytes()
    assert len(read_ply(tmp_path / "scene.ply").means) == len(read_ply(expected).means)


def test_unusable_folders_plans_and_flags(dataset, planned, tmp_path, capsys):
    def error(*arguments: object) -> str:
        assert cli.main([str(argument) for argument in ("blocks", *arguments)]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        return lines[0]

    assert "plan, train or merge" in error()
    assert "needs a dataset" in error("plan")
    assert "-o OUT" in error("plan", dataset)
    assert "already contains a plan" in error("plan", dataset, "-o", planned)
    (tmp_path / "other").write_text("x", encoding="utf-8")
    assert "other files" in error("plan", dataset, "-o", tmp_path)
    assert "18 training photos" in error("plan", dataset, "-o", tmp_path / "a", "--blocks", 19)
    assert "--blocks: 0" in error("plan", dataset, "-o", tmp_path / "a", "--blocks", 0)
    assert "--margin" in error("plan", dataset, "-o", tmp_path / "a", "--margin", -1)
    assert not (tmp_path / "a").exists()
    assert "no plan.json" in error("train", dataset)
    assert "--blocks belongs to blocks plan" in error("train", planned, "--blocks", 3)
    assert "--block: 4 does not exist; use 1 to 3" in error("train", planned, "--block", 4)
    assert "not trained" in error("merge", planned)
    assert "snowsplat convert" in error("merge", planned, "-o", tmp_path / "scene.spz")
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for text in ("{", "[]", '{"snowsplat": "1", "blocks": 3}'):
        (damaged / "plan.json").write_text(text, encoding="utf-8")
        assert "damaged" in error("merge", damaged)


def test_gains_of_photos_are_rejected_because_blocks_would_not_agree(dataset, tmp_path):
    options = replace(OPTIONS, settings=SETTINGS | {"exposure": "on"})
    with pytest.raises(UserError, match="exposure"):
        plan_blocks(dataset, tmp_path / "blocks", options)
    assert not (tmp_path / "blocks").exists()


def test_an_unfinished_plan_is_replaced(dataset, planned, tmp_path):
    plan = Plan.read(planned)
    replace(plan, blocks=[]).write(tmp_path)
    with pytest.raises(UserError, match="unfinished"):
        train_blocks(tmp_path)
    assert plan_blocks(dataset, tmp_path, OPTIONS) == replace(
        plan, dataset=replace(plan.dataset, path=str(dataset))
    )
