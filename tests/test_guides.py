"""The commands and examples in the README and in the guides of `docs/` work."""

import re
import runpy
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from snowsplat import extras
from snowsplat.cli import main as cli
from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.pipeline.convert import convert
from snowsplat.pipeline.options.make import PRESETS
from snowsplat.pipeline.options.scene import Edits
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset

extras.register()
ROOT = Path(__file__).resolve().parents[1]
GUIDES = sorted((ROOT / "docs" / "guides").glob("*.md"))
START = [ROOT / "docs" / name for name in ("index.md", "installation.md", "quick-start.md")]
PAGES = [ROOT / "README.md", *START, *GUIDES, ROOT / "docs" / "environment-variables.md"]
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}
# Programs besides snowsplat that the pages use.
TOOLS = {
    ".",
    "apt",
    "cp",
    "docker",
    "make",
    "mkdir",
    "npm",
    "pip",
    "python",
    "python3",
    "ssh",
    "torchrun",
    "uv",
}


def examples(page: str) -> list[str]:
    """The Python examples of a page."""
    return re.findall(r"```python\n(.*?)```", TEXTS[page], re.DOTALL)


PYTHON = examples("docs/guides/python.md")
GSPLAT = examples("docs/guides/gsplat.md")
ROTATIONS = re.findall(
    r"\| ([+−][xyz]) \| `(--rotate [-\d ]+)`", TEXTS["docs/guides/scene-files.md"]
)


def test_every_python_example_is_executed_here():
    (readme,) = examples("README.md")
    assert PYTHON[0].startswith(readme)
    others = [page for page in TEXTS if page != "docs/guides/research.md"]  # has its own test
    assert sum(len(examples(page)) for page in others) == 1 + len(PYTHON) + len(GSPLAT)


@pytest.mark.slow
def test_photos_to_scene_from_python(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "draft", replace(PRESETS["draft"], iterations=60))
    # With poses: other tests are about finding them.
    write_toy_dataset(tmp_path / "photos", n_views=9, width=112, height=84, n_points=600)
    example, changes = re.subn("seconds=5", "seconds=0.1", PYTHON[0])
    assert changes == 1
    run(example)
    psnr, scene = capsys.readouterr().out.split()
    assert float(psnr) > 12
    assert scene == "garden_scene/photos.ply"
    assert len(read_gaussians(tmp_path / "garden.spz")) == round(len(read_gaussians(scene)) / 2)
    assert (tmp_path / "garden.mp4").stat().st_size > 1000


def test_training_step_by_step_from_python(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_toy_dataset(tmp_path / "garden", n_views=9, width=48, height=36, n_points=300)
    quick, changes = re.subn("iterations=[0-9]+", "iterations=40", PYTHON[1])
    assert changes == 1
    run(quick)
    psnr, count = capsys.readouterr().out.split()
    assert float(psnr) > 15
    assert len(read_gaussians(tmp_path / "garden.ply")) == int(count)


def test_a_checkpoint_of_gsplat_becomes_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = random_scene()
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    splats = dict(zip(names, scene.parameters().values(), strict=True))
    torch.save({"step": 29_999, "splats": splats}, "ckpt_29999_rank0.pt")
    run(GSPLAT[0])
    read = read_gaussians("garden.ply")
    for name, parameter in scene.parameters().items():
        assert torch.equal(read.parameters()[name], parameter), name


def test_the_call_of_gsplat(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_gaussians("garden.ply", random_scene())
    run(GSPLAT[1])
    assert capsys.readouterr().out.split("\n")[0] == "(1, 240, 320, 4) (1, 240, 320, 1)"


def random_scene() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    shapes = ((20, 3), (20, 3), (20, 4), (20,), (20, 1, 3), (20, 15, 3))
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def run(example: str) -> None:
    Path("example.py").write_text(example)
    runpy.run_path("example.py")


@pytest.mark.parametrize(("up", "flag"), ROTATIONS)
def test_a_rotation_turns_a_scene_upright(tmp_path, up, flag):
    scene = random_scene()
    scene.means[0] = torch.tensor([up.endswith(axis) for axis in "xyz"]) * (-1 if "−" in up else 1)
    write_gaussians(tmp_path / "other.ply", scene)
    _, *angles = flag.split()
    edits = Edits(rotate=tuple(map(float, angles)))
    convert(tmp_path / "other.ply", tmp_path / "upright.ply", edits)
    read = read_gaussians(tmp_path / "upright.ply")
    assert torch.allclose(read.means[0], torch.tensor([0.0, -1.0, 0.0]), atol=1e-6)


def commands() -> list[str]:
    lines = []
    for text in TEXTS.values():
        for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL):
            lines += block.splitlines()
        lines += re.findall(r"`(snowsplat (?:sfm|make|train|render|evaluate) [^`…]+)`", text)
    return list(dict.fromkeys(lines))


@pytest.mark.parametrize("command", commands())
def test_command_is_valid(command, tmp_path, monkeypatch):
    program, *arguments = shlex.split(command)
    if "--import" in arguments:  # a file of one's own
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("SNOWSPLAT_IMPORT", "")
        Path(arguments[arguments.index("--import") + 1]).with_suffix(".py").touch()
        arguments = [f"{each}.py" if each == "FILE" else each for each in arguments]
    if program == "make":
        assert f"\n{arguments[0]}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
    elif program == "snowsplat" and arguments != ["--help"]:
        assert type(cli.parse(arguments)) is cli.load_subcommand(arguments[0])
    else:
        assert program in {"snowsplat", *TOOLS}


def test_environment_variables_are_used():
    source = "".join(file.read_text() for file in (ROOT / "src" / "snowsplat").rglob("*.py"))
    names = re.findall(r"`(SNOWSPLAT_\w+)=", TEXTS["docs/environment-variables.md"])
    assert names
    for name in names:
        assert name in source
