"""The subcommands that use a trained scene: `render`, `evaluate`, `info`."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image

from snowsplat.cli.main import main
from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.training.core import checkpoint


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> Path:
    """An output folder with two scenes; the tests replace its renderings and metrics."""
    out = tmp_path_factory.mktemp("trained") / "out"
    flags = ["--iterations", "60", "--save-iterations", "30", "--eval", "--quiet"]
    assert main(["train", str(dataset), "-o", str(out), *flags]) == 0
    return out


def image(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(np.float64)


def test_render_writes_images_and_photos(run, trained, dataset):
    result = run("render", trained)
    assert result.code == 0, result.err
    for split, names in (("test", [0, 8]), ("train", [1, 2, 3, 4, 5, 6, 7])):
        folder = trained / split / "ours_60"
        expected = [f"{i:05d}.png" for i in range(len(names))]
        for kind in ("renders", "gt"):
            assert sorted(p.name for p in (folder / kind).iterdir()) == expected
        for i, name in enumerate(names):
            photo = image(dataset / f"images/view_{name:02d}.png")
            np.testing.assert_array_equal(image(folder / f"gt/{i:05d}.png"), photo)
    # The PSNR of the written images equals the measured one, except for rounding to 8 bits.
    metrics = json.loads((trained / "metrics.json").read_text())
    render, photo = (image(trained / f"test/ours_60/{k}/00001.png") for k in ("renders", "gt"))
    psnr = -10 * np.log10(np.mean(((render - photo) / 255) ** 2))
    assert psnr == pytest.approx(metrics["views"]["view_08.png"]["psnr"], abs=0.02)


def test_render_antialiased(run, trained, tmp_path):
    """As the file is marked, unless the flag says something else."""
    renders = trained / "test/ours_60/renders/00000.png"
    images = {}
    for flags in ((), ("--antialias", "on"), ("--antialias", "off")):
        assert run("render", trained, "--split", "test", "-r", 2, *flags).code == 0
        images[flags] = image(renders)
    assert np.array_equal(images[()], images["--antialias", "on"])
    assert np.abs(images[()] - images["--antialias", "off"]).max() > 10

    unmarked = tmp_path / "unmarked"
    shutil.copytree(trained, unmarked)
    scene = unmarked / "point_cloud/iteration_60/point_cloud.ply"
    gaussians = read_gaussians(scene)
    assert gaussians.antialiased
    gaussians.antialiased = False
    write_gaussians(scene, gaussians)
    assert run("render", unmarked, "--split", "test", "-r", 2).code == 0
    again = image(unmarked / "test/ours_60/renders/00000.png")
    assert np.array_equal(again, images["--antialias", "off"])
    assert not json.loads(run("info", scene, "--json").out)["antialiased"]


def test_render_depth(run, trained):
    flags = ("--split", "test", "--iteration", 30)
    assert run("render", trained, *flags, "--depth", "16bit").code == 0
    folder = trained / "test/ours_30/depth"
    steps = json.loads((folder / "world_units_per_step.json").read_text())
    depth = Image.open(folder / "00000.png")
    assert depth.mode.startswith("I")
    units = np.asarray(depth).astype(np.float64) * steps["00000.png"]
    # The cameras are 3 units from the centre; the background is at most 9 units away.
    assert 1.5 < np.median(units[units > 0]) < 9.5
    assert run("render", "-m", trained, *flags, "--skip_train", "--depth", "color").code == 0
    assert Image.open(folder / "00000.png").mode == "RGB"
    assert not (trained / "train/ours_30").exists()


def test_evaluate_reproduces_the_metrics_of_the_training(run, trained):
    before = json.loads((trained / "metrics.json").read_text())
    result = run("evaluate", trained)
    assert result.code == 0, result.err
    assert json.loads((trained / "metrics.json").read_text()) == before
    assert f"{before['psnr']:6.3f}" in result.out
    assert "LPIPS was not measured" in result.out
    assert run("evaluate", "-m", trained, "--split", "train", "--iteration", 30).code == 0
    other = json.loads((trained / "metrics.json").read_text())
    assert (other["iteration"], other["split"], len(other["views"])) == (30, "train", 7)
    assert run("evaluate", trained).code == 0


def test_evaluate_with_lpips(run, refused, trained, tmp_path):
    torch.manual_seed(0)
    shapes = [(64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3)]
    state = {}
    for k, (index, (o, i, s)) in enumerate(zip((0, 3, 6, 8, 10), shapes, strict=True)):
        state[f"features.{index}.weight"] = torch.randn(o, i, s, s) / (i * s * s) ** 0.5
        state[f"features.{index}.bias"] = torch.zeros(o)
        state[f"lin{k}.model.1.weight"] = torch.rand(1, o, 1, 1)
    safetensors.torch.save_file(state, tmp_path / "alex.safetensors")
    result = run("evaluate", trained, "--lpips", tmp_path / "alex.safetensors")
    assert result.code == 0, result.err
    assert "LPIPS (alex)" in result.out
    assert json.loads((trained / "metrics.json").read_text())["lpips"] > 0
    assert "cannot be read" in refused("evaluate", trained, "--lpips", tmp_path / "absent")
    assert run("evaluate", trained).code == 0


def test_a_folder_of_the_reference_implementation(run, trained, dataset, tmp_path):
    """Such a folder has cfg_args but no config.json. The content of cfg_args is not executed."""
    theirs = tmp_path / "theirs"
    shutil.copytree(trained / "point_cloud", theirs / "point_cloud")
    (theirs / "cfg_args").write_text(
        f"Namespace(sh_degree=3, source_path='{dataset}', model_path='x', images='images', "
        "resolution=-1, white_background=False, data_device='cuda', eval=True)"
    )
    result = run("evaluate", "-m", trained, theirs, "--iteration", -1)
    assert result.code == 0
    assert [f"{out}/metrics.json" in result.out for out in (trained, theirs)] == [True, True]
    ours = json.loads((trained / "metrics.json").read_text())
    assert json.loads((theirs / "metrics.json").read_text()) == ours
    (theirs / "cfg_args").write_text("__import__('os').system('echo executed')")
    result = run("evaluate", theirs)
    assert result.code == 2
    assert "executed" not in result.out


def test_a_dataset_that_has_moved(run, refused, trained, dataset, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(trained, moved)
    config = json.loads((moved / "config.json").read_text())
    config["dataset"]["path"] = "/nowhere"
    (moved / "config.json").write_text(json.dumps(config))
    assert "/nowhere" in refused("evaluate", moved)
    assert run("evaluate", moved, "-s", dataset).code == 0


def test_a_scene_file_on_the_photos_of_a_dataset(run, refused, trained, dataset, tmp_path):
    """The result folder of gsplat is such a file, too."""
    (tmp_path / "ply").mkdir()
    for name in ("scene.ply", "ply/point_cloud_99.ply", "ply/point_cloud_100.ply"):
        shutil.copy(trained / "point_cloud/iteration_60/point_cloud.ply", tmp_path / name)
    assert "set --dataset" in refused("evaluate", tmp_path / "scene.ply")
    assert "is a file" in refused("watch", tmp_path / "scene.ply")
    assert run("evaluate", tmp_path / "scene.ply", "--dataset", dataset).code == 0
    assert run("render", tmp_path, "--dataset", dataset, "--split", "test").code == 0
    ours = json.loads((trained / "metrics.json").read_text())
    theirs = json.loads((tmp_path / "scene_views/metrics.json").read_text())
    assert theirs["views"] == ours["views"]
    assert any((tmp_path / "ply/point_cloud_100_views/test/ours_0/renders").iterdir())
    assert "point_cloud_100.ply" in run("info", tmp_path).out


def test_errors(refused, trained, tmp_path):
    assert "no such folder" in refused("render", tmp_path / "absent")
    assert "not the output folder" in refused("evaluate", tmp_path)
    assert "there are 30, 60" in refused("render", trained, "--iteration", 7)
    assert "one output folder" in refused("render", trained, "-m", trained)
    assert "no views" in refused("render", trained, "--skip-train", "--skip-test")
    damaged = tmp_path / "damaged"
    shutil.copytree(trained, damaged)
    scene = damaged / "point_cloud/iteration_60/point_cloud.ply"
    scene.write_bytes(scene.read_bytes()[:-1])
    assert "ends before its last row" in refused("evaluate", damaged)
    for content in ("{", "[]", '{"dataset": 1}', '{"dataset": {"path": 1, "x": 2}}'):
        (damaged / "config.json").write_text(content)
        assert "config.json: damaged" in refused("evaluate", damaged)
    shutil.rmtree(damaged / "point_cloud")
    shutil.copy(trained / "config.json", damaged)
    assert "contains no scene" in refused("evaluate", damaged)


def test_info(run, refused, trained, dataset, tmp_path):
    def facts(path: Path) -> dict:
        assert run("info", path).code == 0  # as text
        result = run("info", path, "--json")
        assert result.code == 0, result.err
        return json.loads(result.out)

    scene = facts(trained / "point_cloud/iteration_60/point_cloud.ply")
    gaussians = read_gaussians(trained / "point_cloud/iteration_60/point_cloud.ply")
    assert (scene["kind"], scene["sh_degree"]) == ("scene", 3)
    assert scene["gaussians"] == len(gaussians)
    assert scene["opacity"]["p50"] == pytest.approx(float(gaussians.opacities.median()), rel=0.05)
    assert facts(trained / "input.ply")["points"] == 300
    out = facts(trained)
    assert out["scenes"] == [30, 60]
    assert out["dataset"] == str(dataset)
    assert out["metrics"]["psnr"] > 10
    assert out["last_scene"]["gaussians"] == len(gaussians)
    photos = facts(dataset)
    assert (photos["photos"], photos["held_out_with_eval"], photos["points"]) == (9, 2, 300)
    assert photos["sizes"] == {"48x36": 9}
    gaussians.means[3, 1] = float("nan")
    write_gaussians(tmp_path / "nan.ply", gaussians)
    assert facts(tmp_path / "nan.ply")["not_finite"] == 1
    write_gaussians(tmp_path / "none.ply", gaussians.select(torch.zeros(0, dtype=torch.int64)))
    assert facts(tmp_path / "none.ply")["gaussians"] == 0
    assert "no such file" in refused("info", tmp_path / "absent.ply")
    assert "no camera poses" in refused("info", tmp_path)


def test_info_says_which_photos_were_left_out_and_why(run, trained, dataset, tmp_path):
    """By the poses, in the record of the dataset; by the training, in its metrics."""
    metrics = trained / "metrics.json"
    before = metrics.read_text()
    metrics.write_text(json.dumps(json.loads(before) | {"left_out": ["view_07.png"]}))
    out = run("info", trained).out
    (left_out,) = json.loads(run("info", trained, "--json").out)["left_out"]
    metrics.write_text(before)
    assert "view_07.png: the scene does not explain it\n" in out
    assert (left_out["photo"], left_out["stage"]) == ("view_07.png", "training")
    folder = shutil.copytree(dataset, tmp_path / "dataset")
    result = {"unregistered": {"a\x1b_b.jpg": "it matches no other photo"}}
    record = {"stages": {"poses": {"result": result}}}
    DatasetFolder(folder).record.write_text(json.dumps(record))
    assert "  a\ufffd_b.jpg: it matches no other photo\n" in run("info", folder).out


def test_info_prints_no_control_characters(run, refused, tmp_path):
    meta = {"a\x1b[2J": "\ud800 \x1b]0;title\x07", "b": {"\x9b2J": [1]}}
    path = checkpoint.save(tmp_path, 5, {"a": torch.zeros(3)}, meta)
    result = run("info", path)
    assert result.code == 0
    assert result.out.replace("\n", "").isprintable()
    head = "ply\nformat ascii 1.0\nelement vertex 0\n" + 2 * "property float \x1b[2J\n"
    (tmp_path / "a.ply").write_text(f"{head}end_header\n")
    assert refused("info", tmp_path / "a.ply").strip().isprintable()


def test_info_of_a_checkpoint(run, dataset, tmp_path):
    flags = ("--iterations", 4, "--checkpoint-every", 4, "--init", "points", "-q")
    assert run("train", dataset, "-o", tmp_path / "out", *flags).code == 0
    result = run("info", tmp_path / "out/checkpoints/step_000004.safetensors", "--json")
    values = json.loads(result.out)
    assert (values["kind"], values["step"]) == ("checkpoint", 4)
    assert values["tensors"]["gaussians.means"] == [300, 3]
    assert run("info", tmp_path / "out").code == 0
