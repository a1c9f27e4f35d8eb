"""`snowsplat make`, from photos to files: its output, repeated stages."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.formats import read_gaussians
from snowsplat.pipeline import all_photos, make_plan
from snowsplat.pipeline import make as make_module
from snowsplat.pipeline.make import STAGES
from snowsplat.pipeline.options.make import PRESETS
from snowsplat.pipeline.output.scene_source import load_trained, load_viewable
from snowsplat.pipeline.render import evaluate
from snowsplat.project.project import MAKE_RECORD as RECORD
from snowsplat.project.project import Project
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.sfm import cost
from snowsplat.sfm.ingest.search import sources
from snowsplat.util.stages import Stages

from ..sfm.colmap import scenes

#: With few passes, there are up to 75% more steps.
QUICK = replace(PRESETS["draft"], iterations=120)


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """9 photos, 320×240; read-only for the tests. The name has spaces and an umlaut."""
    return scenes.write_photos(tmp_path_factory.mktemp("make") / "Häuser am See", 9)


def files(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def state(out: Path) -> dict[str, int]:
    """Modification time of each file except the records of finished stages."""
    made = (name for name in files(out) if Path(name).name not in ("make.json", "sfm.json"))
    return {name: (out / name).stat().st_mtime_ns for name in made}


@pytest.mark.sfm
def test_from_photos_to_files_and_repeated_stages(run, refused, photos, tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "draft", replace(QUICK, iterations=60))
    monkeypatch.chdir(tmp_path)
    command = ("make", photos, "--quality", "draft", "--threads", 1)
    result = run(*command)
    assert result.code == 0, result.err
    out = tmp_path / "Häuser am See_scene"
    scene = out / "Häuser am See.ply"
    original = out / "scene/point_cloud/iteration_105/point_cloud.ply"
    assert scene.read_bytes() == original.read_bytes()
    metrics = json.loads((out / "scene/metrics.json").read_text())
    assert metrics["psnr"] > 12
    assert list(metrics["views"]) == [sorted(path.name for path in photos.iterdir())[4]]
    made = files(out / "scene/test/ours_105")
    assert made == {f"{kind}/{i:05d}.png" for kind in ("renders", "gt") for i in range(1)}
    assert (out / "dataset/dataset_report.html").is_file()
    assert not (out / "scene/checkpoints").exists()
    summary = result.out[result.out.index("\nThe scene") :]
    for part in (scene.name, "dataset_report.html", "renders", f"PSNR {metrics['psnr']:.2f} dB"):
        assert part in summary

    facts = json.loads(run("info", out, "--json").out)
    assert facts["kind"] == "output folder"
    assert facts["scenes"] == [105]
    assert facts["last_scene"]["file"] == str(scene)

    # The same command again: all stages are skipped.
    before = state(out)
    again = run(*command)
    assert again.code == 0, again.err
    assert again.out.count("done before") == 7
    assert state(out) == before
    assert f"PSNR {metrics['psnr']:.2f} dB" in again.out

    # A file is missing: that stage and the later ones are repeated.
    shutil.rmtree(out / "scene/test")
    again = run(*command)
    assert "pictures: repeated (its files are missing)" in again.out
    assert state(out).keys() == before.keys()
    assert original.stat().st_mtime_ns == before["scene/point_cloud/iteration_105/point_cloud.ply"]

    # Another training setting: the cameras are kept.
    monkeypatch.setitem(PRESETS, "draft", replace(QUICK, iterations=20))
    again = run(*command)
    assert again.code == 0, again.err
    assert "scene: repeated (changed: iterations)" in again.out
    assert again.out.count("done before") == 4
    assert (out / "scene/test/ours_35").is_dir()
    assert not (out / "scene/test/ours_105").exists()

    # Other photos: the existing output is not replaced.
    fewer = tmp_path / "fewer"
    fewer.mkdir()
    for photo in sorted(photos.iterdir())[:7]:
        shutil.copy(photo, fewer)
    before = state(out)
    assert "--overwrite" in refused("make", fewer, "-o", out, "--quality", "draft")
    assert state(out) == before


def test_the_last_part_uses_all_photos_and_the_figures_are_those_before(
    run, refused, dataset, tmp_path, monkeypatch
):
    monkeypatch.setitem(PRESETS, "draft", replace(QUICK, iterations=40))
    out = tmp_path / "out"
    command = ("make", dataset, "-o", out, "--quality", "draft", "--threads", 1)
    monkeypatch.setattr(all_photos, "SHARE", 0.01)  # fewer than two steps for each photo
    assert "no last part with the held-out photos: it would use each" in run(*command).out
    before = (out / f"{dataset.name}.ply").read_bytes()
    evaluated = TrainingFolder(out / "scene").scene_path(70)
    assert before == evaluated.read_bytes()

    monkeypatch.setattr(all_photos, "SHARE", 1.0)
    (out / f"{dataset.name}.ply").unlink()  # both stages that write it are repeated
    result = run(*command, "--title", "A <title>")
    assert result.code == 0, result.err
    views = len(list((dataset / "images").iterdir()))
    assert f"70 more steps with all {views} photos" in result.out
    assert f"before the last part, which has used all {views} photos" in result.out
    metrics = json.loads((out / "scene/metrics.json").read_text())
    assert f"PSNR {metrics['psnr']:.2f} dB" in result.out
    scene = Project.open(out).scene_file()
    assert scene == out / f"{dataset.name}.ply"
    assert evaluated.read_bytes() == before != scene.read_bytes()
    assert load_viewable(out).file == scene
    assert len(load_viewable(scene).cameras) == views
    # The scene before is judged by photos that it has not seen; the other one reproduces them.
    held_out = load_trained(out)
    assert evaluate(held_out).psnr == pytest.approx(metrics["psnr"], abs=1e-4)
    ours = evaluate_views(read_gaussians(scene), held_out.dataset.test, background=[0.0, 0.0, 0.0])
    assert ours.psnr > metrics["psnr"] + 0.1
    assert Project.open(out).name == Project.open(out / "scene").name == "A <title>"
    assert "<h1>A &lt;title&gt;</h1>" in (out / "scene/report.html").read_text("utf-8")
    assert run(*command).out.count("done before") == 3


def test_no_photos_are_held_out_on_request(run, refused, dataset, tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "draft", replace(QUICK, iterations=10))
    out = tmp_path / "out"
    command = ("make", dataset, "-o", out, "--quality", "draft", "--threads", 1, "--hold-out")
    for wrong in ("1", "some"):
        assert "--hold-out" in refused(*command, wrong)
    result = run(*command, "none")
    assert result.code == 0, result.err
    assert "PSNR" not in result.out
    assert (out / f"{dataset.name}.ply").is_file()
    assert "0 held out" in (out / "scene/report.html").read_text("utf-8")
    assert run(*command, "none").out.count("done before") == 1


def test_a_dataset_is_trained_with_its_poses(run, refused, dataset, tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "draft", replace(QUICK, iterations=10))
    root, out = shutil.copytree(dataset, tmp_path / "scan"), tmp_path / "out"
    command = ("make", root, "-o", out, "--quality", "draft", "--threads", 1)
    result = run(*command)
    assert result.code == 0, result.err
    assert "its camera poses are used" in result.out
    assert f"those of {root}" in result.out
    assert not (out / "dataset").exists()
    assert (out / "scan.ply").is_file()
    assert files(root) == files(dataset)

    again = run(*command)
    assert again.code == 0, again.err
    assert again.out.count("done before") == 3

    assert "--overwrite" in refused("make", dataset / "images", "-o", out)
    points = root / "sparse/0/points3D.bin"
    points.unlink()
    again = run(*command)
    assert again.code == 0, again.err
    assert "scene: repeated" in again.out


@pytest.mark.sfm
@pytest.mark.nightly  # it takes a minute; tests/pipeline/test_make_plan.py tests the plan
def test_a_short_time_for_many_photos_uses_fewer(run, tmp_path, monkeypatch):
    """On a slow machine; the same command again repeats nothing and keeps the plan."""
    monkeypatch.setattr(make_module, "_MIN_SECONDS", 1.0)
    monkeypatch.setattr(make_plan, "_FEWEST", 6)
    monkeypatch.setattr(make_module, "measure_speed", lambda threads: cost.Speed(50.0, 1.0))
    photos = scenes.write_photos(tmp_path / "many", 12)
    command = ("make", photos, "-o", tmp_path / "out", "--minutes", 0.1, "--threads", 2)
    result = run(*command)
    assert result.code == 0, result.err
    assert "6.0 s: 6 of 12 photos, 256 pixels, draft effort" in result.out
    assert len(list((tmp_path / "out/dataset/input").iterdir())) == 6
    assert (tmp_path / "out/many.ply").is_file()
    again = run(*command)
    assert again.code == 0, again.err
    assert again.out.count("done before") == 7
    assert "of 12 photos" not in again.out


def test_ctrl_c_names_the_command_that_resumes(run, photos, monkeypatch):
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt("stopped after step 5")

    monkeypatch.setattr(make_module, "make", stopped)
    result = run("make", photos, "--quality", "draft", "--overwrite")
    assert result.code == 130
    command = f"snowsplat make '{photos}' --quality draft"
    assert result.out.splitlines() == ["stopped after step 5", f"resume with: {command}"]


# Errors


def test_output_folders_with_other_files(refused, dataset, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    assert "contains other files" in refused("make", dataset / "images", "-o", out)
    assert "is a file" in refused("make", dataset / "images", "-o", out / "thesis.txt")
    assert files(out) == {"thesis.txt"}


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], "needs photos"),
        (["absent"], "absent"),
        (["PHOTOS", "--minutes", 0], "--minutes: 0.0 is too small"),
        (["PHOTOS", "--threads", 0], "--threads: 0 is too small"),
    ],
)
def test_errors_write_nothing(refused, dataset, tmp_path, flags, expected):
    arguments = [dataset / "images" if flag == "PHOTOS" else flag for flag in flags]
    assert expected in refused("make", *arguments, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("minutes", [[], ["--minutes", "5"]])
def test_the_inputs_are_searched_once(refused, dataset, tmp_path, monkeypatch, minutes):
    """In the plan, the check of the folder, the estimate of the time, and the copies of photos."""
    few = tmp_path / "few"
    few.mkdir()
    for name in ("view_00.png", "view_01.png"):
        shutil.copyfile(dataset / "images" / name, few / name)
    searched = []
    search = sources._search
    monkeypatch.setattr(sources, "_search", lambda root: searched.append(root) or search(root))
    assert "2 usable images" in refused("make", few, "-o", tmp_path / "out", *minutes)
    assert searched == [few]


def test_an_error_before_the_cameras_keeps_the_record(refused, dataset, tmp_path):
    """The user has removed the dataset, so that the cameras are estimated again."""
    out, two = tmp_path / "out", tmp_path / "two"
    (out / "scene").mkdir(parents=True)
    Stages(out / RECORD, STAGES).save()
    two.mkdir()
    for name in ("view_00.png", "view_01.png"):
        shutil.copy(dataset / "images" / name, two)
    for _ in range(2):  # the second run fails at the same point
        assert "only 2 usable images" in refused("make", two, "-o", out)
        assert files(out) == {RECORD}
