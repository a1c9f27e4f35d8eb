"""The notebooks run from top to bottom, show pictures, and print what their text says.

With each change, all of them run in this process, the lessons at a small scale. At night, the
lessons run in a kernel of Jupyter at their full scale.
"""

import ast
import importlib.util
import json
import os
import platform
import re
import subprocess
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from snowsplat.pipeline.options.make import PRESETS
from snowsplat.synthetic import photographer
from snowsplat.synthetic.toy_dataset import write_toy_dataset

from .scenes.coarse import coarse_still_life

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXERCISES = sorted((ROOT / "notebooks" / "exercises").glob("*.ipynb"))
SOLUTIONS = ROOT / "notebooks" / "exercises" / "solutions"
NAME = pytest.mark.parametrize("path", [*NOTEBOOKS, *EXERCISES], ids=lambda path: path.stem)


def numbers(pattern: str, text: str) -> list[float]:
    """The groups of the only match of a pattern in the printed text, as numbers."""
    (found,) = re.finditer(pattern, text)
    return [float(group.replace(",", "")) for group in found.groups()]


def check_render(printed: str) -> None:
    by_hand, rasterizer = re.findall(r"(?:by hand|rasterizer): +(\[.*\])", printed)
    assert json.loads(by_hand) == pytest.approx(json.loads(rasterizer), abs=2e-3)
    assert numbers(r"(\d+) splats", printed)[0] > 10


def check_train(printed: str) -> None:
    count, psnr = numbers(r"([\d,]+) Gaussians; PSNR of the held-out photos: ([\d.]+) dB", printed)
    assert count > 10_000
    assert psnr > 20.5


def check_picture(printed: str) -> None:
    results = re.findall(r"(\d+) Gaussians: ([\d.]+) dB", printed)
    psnrs = [float(psnr) for _, psnr in results]
    assert [int(count) for count, _ in results] == [30, 100, 300, 1000]
    assert psnrs == sorted(psnrs)
    assert psnrs[-1] > 28


def check_loss(printed: str) -> None:
    (reference,) = numbers(r"^PSNR ([\d.]+) dB", printed)
    squared, robust = numbers(r"squared error: PSNR ([\d.]+) dB, robust loss: ([\d.]+)", printed)
    assert squared < reference - 4
    assert robust > reference - 1
    results = re.findall(r"(\w+) *: +([\d,]+) Gaussians, PSNR ([\d.]+) dB", printed)
    psnr = {name: float(value) for name, _, value in results}
    assert psnr["none"] < psnr["ours"] < psnr["paper"]


def check_poses(printed: str) -> None:
    before, after = re.findall(r"error: ([\d.]+)°, ([\d.]+) m", printed)
    assert float(before[0]) > 5
    assert float(after[0]) < 0.3
    assert float(after[1]) < 0.01


CHECKS: dict[str, Callable[[str], None]] = {
    "01_render": check_render,
    "02_train": check_train,
    "03_fit_a_picture": check_picture,
    "04_your_own_loss": check_loss,
    "05_camera_poses": check_poses,
}
# What makes a lesson quick: texts of its cells, and what takes their place.
SMALL: dict[str, dict[str, str]] = {
    "01_render": {"count=1500": "count=60"},
    "02_train": {"192, 144": "64, 48", "iterations=700": "iterations=20", "frames=48": "frames=3"},
    "03_fit_a_picture": {
        "steps=200": "steps=11",
        "steps=300": "steps=101",
        "stages[300]": "stages[101]",
        "gaussians=1000": "gaussians=100",
    },
    "04_your_own_loss": {"steps=300": "steps=3", "iterations=400": "iterations=90"},
    "05_camera_poses": {"160, 120": "64, 48", "iterations=400": "iterations=20", ", 60)": ", 3)"},
    "06_your_own_photos": {'"normal"': '"draft"'},
}


def cells(path: Path, kind: str = "code") -> list[dict[str, Any]]:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    found = [cell for cell in notebook["cells"] if cell["cell_type"] == kind]
    return [cell | {"source": "".join(cell["source"])} for cell in found]


def run_here(path: Path, change: Callable[[dict[str, Any]], str]) -> list[Any]:
    """Run the cells in this process; ``change`` returns the text of each. Returns what they show.

    As in Jupyter, a cell shows the value of its last line, if this is an expression.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    shown = []
    for number, cell in enumerate(cells(path)):
        tree = ast.parse(change(cell))
        last = ast.Expression(tree.body.pop().value) if is_value(tree) else None
        exec(compile(tree, f"{path.stem}, code cell {number}", "exec"), names)
        if last is not None:
            shown.append(eval(compile(last, f"{path.stem}, code cell {number}", "eval"), names))
    return [value for value in shown if value is not None]


def is_value(tree: ast.Module) -> bool:
    return bool(tree.body) and isinstance(tree.body[-1], ast.Expr)


@pytest.fixture
def here(tmp_path, monkeypatch) -> Iterator[None]:
    """A folder for what a notebook writes; afterwards, PyTorch has its former settings."""
    monkeypatch.chdir(tmp_path)
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    yield
    torch.set_num_threads(threads)
    torch.set_default_dtype(dtype)


def test_every_notebook_is_tested_and_listed():
    assert [path.stem for path in NOTEBOOKS] == list(SMALL)
    assert list(SMALL)[:-1] == list(CHECKS)
    page = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
    names = [path.stem for path in NOTEBOOKS] + [f"exercises/{path.stem}" for path in EXERCISES]
    assert re.findall(r"\]\(([\w/]+)\.ipynb\)", page) == names
    assert [path.stem for path in EXERCISES] == sorted(p.stem for p in SOLUTIONS.glob("*.py"))


@NAME
def test_stored_without_outputs_and_with_the_installation_first(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    own = cells(path)
    assert own[0]["source"] == cells(NOTEBOOKS[0])[0]["source"]
    for cell in own:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
    assert notebook["metadata"].keys() == {"kernelspec", "language_info"}


class Installed(Exception):
    """Instead of an installation."""


@pytest.fixture
def first_cell(tmp_path, monkeypatch) -> Callable[[str], str]:
    """Runs the first cell in a folder without snowsplat; returns what pip would install."""

    def install(command, **_):
        assert command[:5] == [sys.executable, "-m", "pip", "install", "-q"]
        raise Installed(command[5])

    def run(source: str = "") -> str:
        text = cells(NOTEBOOKS[0])[0]["source"].replace('SOURCE = ""', f"SOURCE = {source!r}")
        with pytest.raises(Installed) as raised:
            exec(text, {})
        return str(raised.value)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(subprocess, "run", install)
    return run


def test_the_first_cell_installs_a_wheel_or_the_checkout(first_cell, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="set SOURCE to its wheel, or to its address"):
        first_cell()
    assert first_cell("git+https://example.org/repository") == "git+https://example.org/repository"
    (tmp_path / "src" / "snowsplat").mkdir(parents=True)
    (tmp_path / "src" / "snowsplat" / "__init__.py").touch()
    (tmp_path / "notebooks" / "exercises").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "notebooks" / "exercises")
    assert first_cell() == str(tmp_path)
    (tmp_path / "dist").mkdir()
    (tmp_path / "dist" / "snowsplat-0.1.0-py3-none-manylinux_2_28_riscv.whl").touch()
    assert first_cell() == str(tmp_path)  # the wheel is for another processor
    fitting = tmp_path / "dist" / f"snowsplat-0.1.0-py3-none-any_{platform.machine().lower()}.whl"
    fitting.touch()
    assert first_cell() == str(fitting)


def solution(path: Path) -> str:
    return (SOLUTIONS / f"{path.stem}.py").read_text(encoding="utf-8")


def run_exercise(path: Path, answer: str | None) -> None:
    def change(cell: Mapping[str, Any]) -> str:
        is_answer = "answer" in cell["metadata"].get("tags", ())
        return answer if is_answer and answer is not None else cell["source"]

    run_here(path, change)


@pytest.mark.parametrize("path", EXERCISES, ids=lambda path: path.stem)
def test_a_solution_passes_the_checks_and_an_empty_answer_fails(path, here, capsys):
    run_exercise(path, solution(path))
    printed = capsys.readouterr().out
    assert "right" in printed or "agree" in printed or "reference" in printed
    with pytest.raises(AssertionError, match=r": nothing is returned yet\. Replace `return None`"):
        run_exercise(path, None)


@pytest.mark.parametrize(
    ("name", "right", "wrong", "hint"),
    [
        ("01_gaussian", "covariance[:2, :2]", "covariance.inverse()[:2, :2]", "deletes the row"),
        ("01_gaussian", "2 * torch.pi / c", "2 * torch.pi * c", "the height is √"),
        ("02_covariance", "quats / quats.norm(dim=1, keepdim=True)", "quats", "divided by its"),
        ("02_covariance", "[:, None, :]", "[:, :, None]", "column i of R is the axis i"),
        ("02_covariance", "2 * (2 * log", "(2 * log", "Differentiate by ℓᵢ"),
        ("03_camera", "@ pose[:, :3].T +", "@ pose[:, :3] +", "points @ W.T"),
        ("03_camera", "-pose[:, :3].T @ pose[:, 3]", "-pose[:, 3]", "solve W p"),
        ("04_projection", "-fx * x", "fx * x", "towards the principal point"),
        ("04_projection", "W @ mean + t", "W @ mean", "not at μ"),
        ("04_projection", " + 0.3 * torch.eye(2)", "", "Add 0.3 I"),
        ("05_spherical_harmonics", "(-first * y", "(first * y", "the sign"),
        ("05_spherical_harmonics", ".clamp(min=0)", "", "replace negative"),
        ("05_spherical_harmonics", "(g * (colors(directions, coefficients) > 0))", "g", "clamped"),
        ("06_blending", ".clamp(max=0.99)", "", "at most 0.99"),
        ("06_blending", "alpha < 1 / 255", "alpha < 0", "Skip a splat"),
        ("06_blending", "break", "continue", "After the stop"),
        ("06_blending", "torch.where(after < 1e-4, 0.0, alphas)", "alphas", "Masks in place"),
        ("07_gradients", "colors[i] - behind)", "colors[i] - background)", "what is behind"),
        ("08_rasterizer", "+ TILE - 1", "+ TILE", "16 i \\+ 15.5"),
        ("08_rasterizer", "depths.argsort(stable=True)", "depths.argsort().flip(0)", "nearest"),
        ("08_rasterizer", "+ x, j + y]", "+ y, j + x]", "at the right place"),
        ("09_optimisation", "[:, 1:4]", "[:, :3]", "not its own neighbour"),
        ("09_optimisation", "betas[1] ** step", "betas[1]", "v̂ = v"),
        ("10_density_control", "nanmean(dim=0)", "nansum(dim=0)", "then the mean"),
        ("10_density_control", "alive & ~split", "alive", "does not stay"),
        ("10_density_control", "1.6", "2.0", "Divide scales by 1.6"),
        ("11_structure_from_motion", "R @ pose_a[:, 3]", "pose_a[:, 3]", "relative to a"),
        ("11_structure_from_motion", "- poses[:, :2]", "+ poses[:, :2]", "is perpendicular to"),
        ("11_structure_from_motion", ".min())", ".max())", "largest angle of all pairs"),
        ("12_surfaces", "alphas[:-1]", "alphas[1:]", "of those in front of it"),
        ("12_surfaces", "(depths - z)", "(z - depths)", "too far behind|Positive in front"),
        ("12_surfaces", "(z > 0) & ", "", "6 behind the camera"),
        (
            "12_surfaces",
            "torch.where(weights > 0, distances * weights, 0.0)",
            "(distances * weights)",
            "NaN is NaN",
        ),
    ],
)
def test_a_wrong_answer_fails_with_a_hint(name, right, wrong, hint, here):
    (path,) = (path for path in EXERCISES if path.stem == name)
    answer = solution(path)
    assert right in answer
    with pytest.raises(AssertionError, match=hint):
        run_exercise(path, answer.replace(right, wrong))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs_at_a_small_scale(path, here, monkeypatch):
    display = pytest.importorskip("IPython.display", reason="needs ipykernel")
    shown_later = types.SimpleNamespace(update=lambda image: None)
    monkeypatch.setattr(display, "display", lambda **_: shown_later)
    coarse_still_life(monkeypatch)
    monkeypatch.setattr(photographer, "RAYS", 1)
    monkeypatch.setitem(PRESETS, "draft", replace(PRESETS["draft"], iterations=30))
    if path.stem == "06_your_own_photos":  # with poses: other tests are about finding them
        write_toy_dataset(Path("photos"), n_views=12, width=112, height=84, n_points=600)
    text = "".join(cell["source"] for cell in cells(path))
    assert all(old in text for old in SMALL[path.stem])

    def change(cell: Mapping[str, Any]) -> str:
        source = cell["source"]
        for old, new in SMALL[path.stem].items():
            source = source.replace(old, new)
        return source

    shown = run_here(path, change)
    pictures = [value for value in shown if hasattr(value, "_repr_png_")]
    pages = [value for value in shown if hasattr(value, "_repr_html_")]
    if path.stem == "06_your_own_photos":
        assert Path(pages[-1].src).stat().st_size > 100_000
        assert len(pictures) == 1
    else:
        assert len({*map(id, pictures), *map(id, pages)}) >= 4


@pytest.mark.nightly
@pytest.mark.skipif(
    importlib.util.find_spec("nbclient") is None or importlib.util.find_spec("ipykernel") is None,
    reason="needs nbclient and ipykernel (make dev installs them)",
)
@pytest.mark.parametrize("path", NOTEBOOKS[:-1], ids=lambda path: path.stem)
def test_runs_from_top_to_bottom(path, tmp_path):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    folder = {"metadata": {"path": str(tmp_path)}}
    client = NotebookClient(notebook, timeout=600, startup_timeout=600, resources=folder)
    # The notebooks see this checkout, and leave the settings of the user alone.
    settings = {name: str(tmp_path) for name in ("IPYTHONDIR", "TMPDIR")}
    client.execute(env=os.environ | settings | {"PYTHONPATH": str(ROOT / "src")})
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output["data"] for output in outputs if "data" in output]
    assert sum("image/png" in data or "text/html" in data for data in shown) >= 4
    CHECKS[path.stem](
        "".join(output["text"] for output in outputs if output.get("name") == "stdout")
    )
