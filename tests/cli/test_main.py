"""The top level of the command line: help, invalid flags, exit codes, imported modules."""

import json
import logging
import os
import subprocess
import sys
import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat._version import __version__
from snowsplat.cli import main as module
from snowsplat.data.points_ply import write_points
from snowsplat.formats import write_gaussians
from snowsplat.training.core import checkpoint

from ..fork_server import ENVIRONMENT

#: Subcommands that do not have their own file in `cli`.
OTHERS = ("demo", "lift", "image", "globe", "anamorph")
UNIT_BOX = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])


@pytest.fixture
def replace_run(monkeypatch):
    """``replace_run(function)``: what `snowsplat info` runs instead."""
    return lambda function: monkeypatch.setattr(module.load_subcommand("info"), "run", function)


def test_the_overview_lists_the_subcommands_and_fits_a_small_terminal(run):
    result = run()
    assert (result.code, result.err) == (0, "")
    assert run("--help") == run("-h") == run("help") == result
    lines = result.out.splitlines()
    assert len(lines) < 24  # and the prompt
    assert max(map(len, lines)) <= 80
    for name in module.SUBCOMMANDS:
        assert f"  snowsplat {name} " in result.out


def test_alone_on_a_screen_it_opens_the_studio(run, monkeypatch):
    studio = module.load_subcommand("studio")
    monkeypatch.setattr(studio, "run", lambda self: print("opened", self.folder) or 0)
    monkeypatch.setattr(module.sys.stdout.__class__, "isatty", lambda _: True, raising=False)
    monkeypatch.setattr(module, "has_screen", lambda: False)
    assert "snowsplat studio" in run().out
    monkeypatch.setattr(module, "has_screen", lambda: True)
    assert run().out == "opened None\n"
    assert "snowsplat studio" in run("--help").out


def test_each_subcommand_has_help_of_the_width_of_the_terminal(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert run("help", "info") == run("info", "--help")
    for name in module.SUBCOMMANDS:
        own = run(name, "--help")
        assert own.code == 0
        assert f"  snowsplat {name} " in own.out  # an example, on its own line
        assert "Examples:" in own.out
        assert "None" not in own.out  # tyro's text for a missing default
        lines = own.out.splitlines()[1:]  # without the usage, which tyro wraps
        assert max(map(len, lines)) <= 80, name
    own = run("train", "--help").out
    paragraph = own[own.index("--recipe") : own.index("--minutes")]
    lines = [line.strip("│ ") for line in paragraph.splitlines()[1:-1]]
    assert all(len(line) > 40 for line in lines[:-2]), lines  # no line breaks of the docstring


_IMPORTED = """
import json, os, sys
from snowsplat.cli.main import main
for arguments in json.loads(sys.argv[1]):
    if os.fork() == 0:
        try:
            main(arguments)
        except SystemExit:
            pass
        print(*sys.modules, file=sys.stderr, flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
    print("end", file=sys.stderr, flush=True)
"""


def imported_by(*commands: list[object]) -> list[set[str]]:
    """The names of the heavy modules and of the subcommands that each command imports.

    Each runs in a fork of a process that has imported only the top level of the command line.
    """
    texts = [[str(argument) for argument in arguments] for arguments in commands]
    done = subprocess.run(
        [sys.executable, "-c", _IMPORTED, json.dumps(texts)],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stderr.splitlines()
    subcommands = {f"snowsplat.cli.{name}" for name in module.SUBCOMMANDS}
    relevant = {"torch", "numpy", "PIL"} | subcommands
    found = [set(before.split()) & relevant for before, line in pairwise(lines) if line == "end"]
    assert len(found) == len(commands)
    return found


@pytest.mark.slow
def test_help_and_invalid_flags_import_neither_torch_nor_other_subcommands():
    no_subcommand, unknown, info, *train = imported_by(
        ["--help"],
        ["trian"],
        ["info"],
        ["train", "--help"],
        ["train", "--iterations", "many"],
        ["train"],
    )
    assert no_subcommand == set()
    assert unknown == set()
    assert info == {"snowsplat.cli.info"}
    for imported in train:
        assert not {"torch", "numpy", "PIL"} & imported


@pytest.mark.slow
def test_the_help_of_no_subcommand_imports_torch():
    names = list(module.SUBCOMMANDS)
    for name, imported in zip(names, imported_by(*([n, "--help"] for n in names)), strict=True):
        file = "mesh" if name == "points" else name
        assert imported == {f"snowsplat.cli.{file}"} or name in OTHERS
        assert not {"torch", "numpy", "PIL"} & imported, name


def test_info_describes_each_kind_of_file_and_folder_without_torch(tmp_path):
    scenes = [
        tmp_path / f"scene{suffix}"
        for suffix in (".compressed.ply", ".ply", ".spz", ".sog", ".glb", ".splat")
    ]
    for path in scenes:
        write_gaussians(path, gaussians_in_box(UNIT_BOX, 20, torch.Generator(), sh_degree=1))
    write_points(tmp_path / "points.ply", np.zeros((3, 3)), np.zeros((3, 3)))
    saved = checkpoint.save(tmp_path, 5, {"a": torch.zeros(3)}, {})
    trained = tmp_path / "out/point_cloud/iteration_7/point_cloud.ply"
    trained.parent.mkdir(parents=True)
    write_gaussians(trained, gaussians_in_box(UNIT_BOX, 20, torch.Generator()))
    (tmp_path / "out/cfg_args").write_text("Namespace(source_path='garden')")
    described = [*scenes, tmp_path / "points.ply", saved, tmp_path / "out"]
    found = imported_by(*(["info", path] for path in described))
    for path, imported in zip(described, found, strict=True):
        assert "torch" not in imported, path


def test_the_version_is_one_line(run):
    result = run("--version")
    assert run("version") == result
    assert (result.code, result.out, result.err) == (0, f"snowsplat {__version__}\n", "")


def test_an_unknown_subcommand_is_one_line_with_a_suggestion(refused):
    assert "trian: unknown subcommand; did you mean train?" in refused("trian")
    assert "use studio (by hand), or convert" in refused("edit")
    assert "choose from studio, demo, make, sfm, train" in refused("xyz")


def test_a_path_in_place_of_a_subcommand_is_answered_with_what_suits_it(refused, tmp_path):
    assert f"snowsplat make {tmp_path}" in refused(tmp_path)
    scene = tmp_path / "a.splat"
    scene.write_bytes(bytes(32))
    assert f"snowsplat view {scene}" in refused(scene)


def test_a_misplaced_flag_is_found_in_its_subcommand(refused):
    assert "snowsplat train … --iterations" in refused("--iterations", "3")
    assert "--none: unknown flag" in refused("--none", "3")


def test_lists_of_a_fixed_length(refused):
    """Values that are missing, and commas between them."""
    for values in (["-1", "-1", "-1", "1", "1"], ["-1,-1,-1,1,1,1"]):
        error = refused("convert", "a.ply", "b.ply", "--crop", *values)
        assert f"{len(values)} given; use 6 values, each a number, separated by spaces" in error


@pytest.mark.parametrize(
    "arguments",
    [["train", "--iteratoins", "3"], ["train", "x", "-o", "y", "--recipe", "none"]],
)
def test_invalid_flags(run, arguments):
    result = run(*arguments)
    assert result.code == 2
    assert result.out == ""
    assert "Traceback" not in result.err


def test_completion_is_printed(run):
    result = run("--tyro-print-completion", "bash")
    assert result.code == 0
    assert "--max-gaussians" in result.out


def test_errors_of_the_system_and_warnings_are_one_line(replace_run, run):
    def full_disk(self):
        warnings.warn("something\nodd", stacklevel=1)
        logging.getLogger("snowsplat.data").info("took the\nlarger one")
        raise OSError(28, "No space left on device", "out/scene.ply")

    replace_run(full_disk)
    result = run("info", "x")
    assert result.code == 2
    assert result.err.splitlines() == [
        "snowsplat: warning: something odd",
        "snowsplat: took the larger one",
        "snowsplat: out/scene.ply: No space left on device; "
        "free some space, or write the result to another disk",
    ]

    def interrupted(self):
        raise KeyboardInterrupt

    replace_run(interrupted)
    assert run("info", "x").code == 130

    def defect(self):
        raise AssertionError("a defect keeps its traceback")

    replace_run(defect)
    with pytest.raises(AssertionError, match="traceback"):
        run("info", "x")


def test_out_of_memory_is_a_one_line_error_with_advice(replace_run, refused):
    def torch_allocates(self):
        torch.empty(2**60, dtype=torch.uint8)

    def gpu_allocates(self):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    def python_allocates(self):
        raise MemoryError

    for fails in (torch_allocates, gpu_allocates, python_allocates):
        replace_run(fails)
        assert "out of memory; train with --memory" in refused("info", "x")

    def another(self):
        raise RuntimeError("a defect")

    replace_run(another)
    with pytest.raises(RuntimeError, match="a defect"):
        module.main(["info", "x"])


@pytest.mark.slow
def test_a_training_run_whose_standard_output_is_closed_fails(start, dataset, tmp_path):
    """As with `| head -1`. There is no message, but the exit code is not zero."""
    read, write = os.pipe()
    os.close(read)
    arguments = ["train", dataset, "-o", tmp_path / "out", "--iterations", 9, "--device", "cpu"]
    process = start(*arguments, stdout=write)
    os.close(write)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (141, "")
    assert not (tmp_path / "out/point_cloud").exists()


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"]])
def test_help_in_an_encoding_without_its_characters(arguments):
    command = [sys.executable, "-m", "snowsplat", *arguments]
    environment = ENVIRONMENT | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(command, env=environment, capture_output=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii()


def test_python_m_names_a_file_unmistakably():
    command = [sys.executable, "-m", "snowsplat", "info", "Größe.ply"]
    environment = ENVIRONMENT | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(command, env=environment, capture_output=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr == rb"snowsplat: Gr\xf6\xdfe.ply: no such file or folder" + b"\n"
