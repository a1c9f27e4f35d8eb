"""The notebooks run from top to bottom, show pictures, and print what their text says."""

import importlib.util
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


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


def test_every_notebook_has_a_check_and_is_listed():
    assert [path.stem for path in NOTEBOOKS] == list(CHECKS)
    page = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((\w+)\.ipynb\)", page) == list(CHECKS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_without_outputs_and_with_the_installation_first(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert "".join(cells[0]["source"]) == (
        'import sys\n\nif "google.colab" in sys.modules:\n    %pip install -q snowsplat'
    )
    for cell in cells:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
    assert notebook["metadata"].keys() == {"kernelspec", "language_info"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_linked_files_exist(path):
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "markdown":
            for link in re.findall(r"\]\(([^):#]+)[#)]", "".join(cell["source"])):
                assert (path.parent / link).exists(), link


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("nbclient") is None or importlib.util.find_spec("ipykernel") is None,
    reason="needs nbclient and ipykernel (make dev installs them)",
)
@pytest.mark.parametrize(
    "path",
    # The longer ones run at night.
    [NOTEBOOKS[0], *(pytest.param(path, marks=pytest.mark.nightly) for path in NOTEBOOKS[1:])],
    ids=lambda path: path.stem,
)
def test_runs_from_top_to_bottom(path, tmp_path):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    folder = {"metadata": {"path": str(tmp_path)}}
    client = NotebookClient(notebook, timeout=600, kernel_name="python3", resources=folder)
    # The notebooks see this checkout, and leave the settings of the user alone.
    settings = {name: str(tmp_path) for name in ("IPYTHONDIR", "TMPDIR")}
    client.execute(env=os.environ | settings | {"PYTHONPATH": str(ROOT / "src")})
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output["data"] for output in outputs if "data" in output]
    assert sum("image/png" in data or "text/html" in data for data in shown) >= 4
    CHECKS[path.stem](
        "".join(output["text"] for output in outputs if output.get("name") == "stdout")
    )
