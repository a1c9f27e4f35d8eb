"""Levels of detail: what they contain, their files, damaged and foreign ones, and the converter."""

import json
import math
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

from snowsplat.formats import format_for_reading, lod_writer, read_gaussians, write_gaussians
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.lod import INDEX, LodIndex, Run, lod_bytes, lod_files, read_index, read_lod
from snowsplat.formats.lod_writer import LodSizes, write_lod
from snowsplat.formats.sog import read_sog
from snowsplat.ops import get_num_threads, set_num_threads
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render
from snowsplat.util.errors import UserError

SMALL = LodSizes(leaf=100, file=400, coarsest=50)
COUNT = 700


def surface(count: int) -> Gaussians:
    """A wavy floor of flat, opaque Gaussians, whose colour changes slowly; −y is up."""
    random = torch.Generator().manual_seed(0)
    x, z = torch.rand(2, count, generator=random) * 4 - 2
    color = torch.stack([x.sin(), (x * z).cos(), z.cos()], 1) / 2
    size = math.log(4 / math.sqrt(count))
    return Gaussians(
        torch.stack([x, 0.2 * (3 * x).sin(), z], 1),
        torch.tensor([size, -6.0, size]).expand(count, 3).clone(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).clone(),
        torch.full((count,), 1.5),
        color[:, None],
        torch.zeros(count, 3, 3),
    )


def write(path: Path, scene: Gaussians, sizes: LodSizes = SMALL) -> LodIndex:
    write_lod(path, GaussianArrays.from_gaussians(scene), sizes=sizes)
    return read_index(path)


def picture(scene: Gaussians, factor: int) -> torch.Tensor:
    """The floor from above, in 1/factor of the resolution."""
    eye, up = torch.tensor([0.3, -4.0, -2.5]), torch.tensor([0.0, -1.0, 0.0])
    size, focal = 256 // factor, 230.0 / factor
    camera = Camera(size, size, focal, focal, size / 2, size / 2, look_at(eye, 0 * eye, up))
    return render(scene, camera).image


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(float(((a - b) ** 2).mean()))


@pytest.fixture(scope="module")
def floor(tmp_path_factory) -> Path:
    """The index of a floor of 6,000 Gaussians."""
    path = tmp_path_factory.mktemp("floor") / INDEX
    write(path, surface(6000), LodSizes(leaf=500, file=1500, coarsest=400))
    return path


@pytest.mark.parametrize("degree", [0, 3])
def test_level_0_is_the_scene(tmp_path, make_scene, degree):
    scene = make_scene(COUNT, degree)
    path = tmp_path / "levels" / INDEX
    index = write(path, scene)
    assert index.counts()[0] == COUNT
    assert format_for_reading(path).name == "streamed SOG"
    read = read_gaussians(path)
    nearest = torch.cdist(read.means, scene.means).argmin(1)
    assert len(nearest.unique()) == COUNT
    same = scene.select(nearest)
    torch.testing.assert_close(read.means, same.means, rtol=0, atol=1e-3)
    torch.testing.assert_close(read.log_scales, same.log_scales, rtol=0, atol=0.1)
    torch.testing.assert_close(read.opacities, same.opacities, rtol=0, atol=3e-3)
    torch.testing.assert_close(read.sh_dc, same.sh_dc, rtol=0, atol=0.1)
    assert ((read.rotations * same.rotations).sum(1).abs() > 0.999).all()
    assert read.sh_degree == degree
    # A palette has an entry for four Gaussians, whose colours are independent here.
    assert not degree or np.corrcoef(read.sh_rest.flatten(), same.sh_rest.flatten())[0, 1] > 0.4


def test_each_level_has_a_quarter_in_every_leaf(floor):
    index = read_index(floor)
    assert index.levels == 3
    assert all(list(leaf) == [0, 1, 2] for leaf in index.leaves)
    for leaf in index.leaves:
        counts = [leaf[level].count for level in range(3)]
        assert counts[0] <= 500
        assert counts[1:] == [math.ceil(counts[0] / 4), math.ceil(counts[0] / 16)]
    coarse, whole = (read_lod(floor, level).to_gaussians() for level in (2, 0))
    assert len(coarse) == index.counts()[2]
    assert coarse.log_scales.mean() > whole.log_scales.mean() + 0.5


def test_from_a_distance_a_coarse_level_is_better_than_the_scene(floor):
    """Each Gaussian is drawn at least a pixel wide: those of the scene cover too much."""
    truth = avg_pool2d(picture(read_gaussians(floor), 1).permute(2, 0, 1), 4).permute(1, 2, 0)
    levels = [psnr(truth, picture(read_lod(floor, k).to_gaussians(), 4)) for k in (0, 1)]
    assert levels[1] > levels[0] + 1
    assert levels[1] > 28


def test_there_are_no_holes_between_leaves_of_different_levels(floor):
    index = read_index(floor)
    files = [read_sog(file) for file in index.files]
    parts = []
    for number, leaf in enumerate(index.leaves):
        run = leaf[number % index.levels]
        parts.append(files[run.file].select(np.arange(run.offset, run.offset + run.count)))
    mixed = Gaussians.cat([part.to_gaussians() for part in parts])
    truth = picture(read_gaussians(floor), 4)
    worst = psnr(truth, picture(read_lod(floor, 2).to_gaussians(), 4))
    assert psnr(truth, picture(mixed, 4)) > worst


def test_bounds_contain_all_levels_of_a_leaf(floor):
    index, tree = read_index(floor), json.loads(floor.read_text())["tree"]
    files = [read_sog(file) for file in index.files]
    nodes, leaves = [tree], []
    while nodes:
        node = nodes.pop()
        low, high = (np.array(node["bound"][name]) for name in ("min", "max"))
        for child in node.get("children", []):
            assert (np.array(child["bound"]["min"]) >= low).all()
            assert (np.array(child["bound"]["max"]) <= high).all()
            nodes.append(child)
        if "lods" in node:
            leaves.append(node)
            for run in node["lods"].values():
                means = files[run["file"]].means[run["offset"] : run["offset"] + run["count"]]
                assert (means > low).all()
                assert (means < high).all()
    assert len(leaves) == len(index.leaves) > 8


def test_runs_fill_the_files(floor):
    index = read_index(floor)
    runs: dict[int, list[Run]] = {}
    for leaf in index.leaves:
        for level, run in leaf.items():
            assert index.files[run.file].parent.name.startswith(f"{level}_")
            runs.setdefault(run.file, []).append(run)
    assert len(runs) == len(index.files)
    for file, own in runs.items():
        assert own[0].offset == 0
        assert all(a.offset + a.count == b.offset for a, b in pairwise(own))
        assert own[-1].offset + own[-1].count == len(read_sog(index.files[file]).means)


def test_the_files_do_not_depend_on_the_number_of_threads(tmp_path, make_scene):
    threads = get_num_threads()
    try:
        for count in (1, 3):
            set_num_threads(count)
            write(tmp_path / str(count) / INDEX, make_scene(COUNT))
    finally:
        set_num_threads(threads)
    ones, threes = (
        {
            file.relative_to(tmp_path / n): file.read_bytes()
            for file in lod_files(tmp_path / n / INDEX)
        }
        for n in "13"
    )
    assert ones == threes


def test_levels_are_replaced_and_other_files_stay(tmp_path, make_scene, monkeypatch):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "levels_9").mkdir()
    (tmp_path / "levels_9/mine.txt").touch()
    path = tmp_path / INDEX
    write(path, make_scene(COUNT, 0))
    before = {file: file.read_bytes() for file in lod_files(path)}
    with monkeypatch.context() as patch:
        patch.setattr(lod_writer, "encode_sog", _full_disk())
        with pytest.raises(OSError, match="no space"):
            write(path, make_scene(300, 0))
    assert {file: file.read_bytes() for file in lod_files(path)} == before
    assert write(path, make_scene(300, 0)).counts()[0] == 300
    others = {"notes.txt", "levels_9"}
    assert {file.name for file in tmp_path.iterdir()} == {INDEX, "levels_2", *others}
    # The process was killed before it wrote the index.
    shutil.copytree(tmp_path / "levels_2", tmp_path / "levels")
    write(path, make_scene(200, 0))
    assert {file.name for file in tmp_path.iterdir()} == {INDEX, "levels_3", *others}


def _full_disk():
    calls = []

    def encode(arrays):
        calls.append(arrays)
        if len(calls) == 2:
            raise OSError(28, "no space")
        return {"meta.json": b"{}"}

    return encode


def test_the_name_is_that_which_viewers_know(tmp_path, make_scene):
    with pytest.raises(UserError, match="write FOLDER/lod-meta.json"):
        write_lod(tmp_path / "levels.json", GaussianArrays.from_gaussians(make_scene(3)))


def test_sizes_and_files(tmp_path, make_scene):
    path = tmp_path / "a" / INDEX
    index = write(path, make_scene(COUNT, 1))
    files = lod_files(path)
    assert len(files) == len(set(files)) == 1 + 8 * len(index.files)
    assert set(files) == {file for file in path.parent.rglob("*") if file.is_file()}
    assert lod_bytes(path) == sum(file.stat().st_size for file in files)


def test_gaussians_that_are_not_finite_do_not_shift_the_others(tmp_path, make_scene):
    path = tmp_path / INDEX
    index = write(path, make_scene(COUNT, 0))
    whole = read_lod(path)
    meta = json.loads(index.files[0].read_text())
    meta["scales"]["codebook"][100] = None
    index.files[0].write_text(json.dumps(meta))
    rest = read_lod(path)
    lost = COUNT - len(rest.means)
    assert 0 < lost < 60
    kept = (whole.means[:, None] == rest.means[None]).all(2).any(1)
    assert (~kept).sum() == lost


def test_a_leaf_without_the_level_has_the_next_one(tmp_path, make_scene):
    path = tmp_path / INDEX
    index = write(path, make_scene(COUNT, 0))
    meta = json.loads(path.read_text())
    node = meta["tree"]
    while "children" in node:
        node = node["children"][0]
    del node["lods"]["0"]
    path.write_text(json.dumps(meta))
    first = index.leaves[0]
    assert len(read_lod(path).means) == COUNT - first[0].count + first[1].count
    del node["lods"]["1"], node["lods"]["2"]
    path.write_text(json.dumps(meta))
    assert len(read_lod(path).means) == COUNT - first[0].count + first[3].count if 3 in first else 1


def test_the_environment_is_part_of_every_level(tmp_path, make_scene):
    path = tmp_path / INDEX
    index = write(path, make_scene(COUNT, 0))
    write_gaussians(tmp_path / "sky.sog", make_scene(20, 2))
    meta = json.loads(path.read_text()) | {"environment": "sky.sog"}
    path.write_text(json.dumps(meta))
    assert len(read_lod(path).means) == COUNT + 20
    coarsest = read_lod(path, 2)
    assert len(coarsest.means) == index.counts()[2] + 20
    assert coarsest.sh_rest.shape == (len(coarsest.means), 8, 3)
    assert tmp_path / "sky.sog" in lod_files(path)


def test_damaged_indices(tmp_path, make_scene, one_line):
    path = tmp_path / INDEX
    write(path, make_scene(COUNT, 0))
    meta = json.loads(path.read_text())

    def refused(**changes: object) -> str:
        path.write_text(json.dumps(meta | changes))
        return one_line(path)

    assert "supported is 1" in refused(version=2)
    assert "does not describe" in refused(lodLevels=0)
    assert "does not describe" in refused(lodLevels=2**31)
    assert "does not describe" in refused(filenames=["0/" * 200, *meta["filenames"][1:]])
    assert "does not describe" in refused(tree={})
    assert "does not describe" in refused(tree={"lods": {"0": {"file": 99, "count": 3}}})
    assert "does not describe" in refused(tree={"lods": {"0": {"file": 0, "count": -3}}})
    assert "outside of its folder" in refused(filenames=["../x.json", *meta["filenames"][1:]])
    assert "outside of its folder" in refused(filenames=["/etc/passwd", *meta["filenames"][1:]])
    run = {"file": 0, "offset": 5, "count": 10**6}
    path.write_text(json.dumps(meta | {"tree": {"lods": {"0": run}}}))
    with pytest.raises(UserError, match="too few Gaussians for its lod-meta.json"):
        read_lod(path)
    both = {"lods": {"0": {"file": 0, "offset": 0, "count": 300}}}
    path.write_text(json.dumps(meta | {"tree": {"children": [both, both]}}))
    with pytest.raises(UserError, match="used twice by its lod-meta.json"):
        read_lod(path)
    path.write_text(json.dumps(meta))
    read_index(path).files[0].unlink()
    with pytest.raises(UserError, match="missing or not a file"):
        read_lod(path)


@pytest.mark.slow
def test_splat_transform_reads_our_levels(tmp_path, make_scene, splat_transform):
    path = tmp_path / INDEX
    index = write(path, make_scene(COUNT, 1))
    for level in range(index.levels):
        splat_transform(path, tmp_path / "back.ply", "-L", str(level))
        back, ours = read_gaussians(tmp_path / "back.ply"), read_lod(path, level).to_gaussians()
        assert len(back) == len(ours) == index.counts()[level]
        torch.testing.assert_close(back.means, ours.means, rtol=0, atol=1e-5)
        torch.testing.assert_close(back.sh_rest, ours.sh_rest, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_we_read_levels_of_splat_transform(tmp_path, make_scene, splat_transform):
    for level, count in enumerate((3000, 500)):
        write_gaussians(tmp_path / f"{level}.ply", make_scene(count, 1, seed=level))
    path = tmp_path / "levels" / INDEX
    splat_transform(
        *(tmp_path / "0.ply", path, "-l", "0", tmp_path / "1.ply", "-l", "1"),
        *("--lod-chunk-count", "1", "--gpu", "cpu", "--max-workers", "0"),
    )
    index = read_index(path)
    assert index.counts() == [3000, 500]
    assert len(index.files) > 2
    for level, count in enumerate((3000, 500)):
        splat_transform(path, tmp_path / "back.ply", "-L", str(level))
        back, read = read_gaussians(tmp_path / "back.ply"), read_lod(path, level).to_gaussians()
        assert len(read) == count
        torch.testing.assert_close(read.means, back.means, rtol=0, atol=1e-5)
        torch.testing.assert_close(read.sh_dc, back.sh_dc, rtol=0, atol=1e-5)
        torch.testing.assert_close(read.sh_rest, back.sh_rest, rtol=0, atol=1e-5)
