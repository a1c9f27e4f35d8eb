"""The frame of the command line: help, mistakes, exit codes, and how soon it answers."""

import logging
import os
import subprocess
import sys
import warnings

import pytest

from snowsplat.cli import main as module

from .conftest import ENVIRONMENT


def test_help_of_the_command_and_of_each_verb_teaches(run):
    result = run()
    assert result.code == 0
    for verb in module.VERBS:
        assert f"snowsplat {verb}" in result.out
        own = run(verb, "--help")
        assert own.code == 0
        assert f"  snowsplat {verb} " in own.out  # an example, on its own line
        assert "Examples:" in own.out
        assert "None" not in own.out  # how tyro shows what it was not told


def test_help_and_mistakes_need_no_torch():
    code = (
        "import sys\nfrom snowsplat.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "assert not {'torch', 'numpy', 'PIL'} & set(sys.modules), 'heavy imports'\n"
    )
    for arguments in (["train", "--help"], ["train", "--iterations", "many"], ["train"], ["info"]):
        command = [sys.executable, "-c", code, *arguments]
        result = subprocess.run(
            command, env={"PYTHONPATH": ":".join(sys.path)}, capture_output=True, text=True
        )
        assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    "arguments",
    [["trian"], ["train", "--iteratoins", "3"], ["train", "x", "-o", "y", "--recipe", "none"]],
)
def test_mistakes_in_the_flags(run, arguments):
    result = run(*arguments)
    assert result.code == 2
    assert result.out == ""
    assert "Traceback" not in result.err


def test_completion_is_printed(run):
    result = run("--tyro-print-completion", "bash")
    assert result.code == 0
    assert "--max-gaussians" in result.out


def test_errors_of_the_system_and_warnings_are_one_line(monkeypatch, refused, run):
    def full_disk(self):
        warnings.warn("something\nodd", stacklevel=1)
        logging.getLogger("snowsplat.data").info("took the\nlarger one")
        raise OSError(28, "No space left on device", "out/scene.ply")

    monkeypatch.setattr(module.VERBS["info"], "run", full_disk)
    result = run("info", "x")
    assert result.code == 2
    assert result.err.splitlines() == [
        "snowsplat: warning: something odd",
        "snowsplat: took the larger one",
        "snowsplat: out/scene.ply: No space left on device",
    ]

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(module.VERBS["info"], "run", interrupted)
    assert run("info", "x").code == 130

    def defect(self):
        raise AssertionError("a defect keeps its traceback")

    monkeypatch.setattr(module.VERBS["info"], "run", defect)
    with pytest.raises(AssertionError, match="traceback"):
        run("info", "x")


def test_no_memory_is_one_line_that_says_what_helps(monkeypatch, refused):
    import torch

    def torch_allocates(self):
        torch.empty(2**60, dtype=torch.uint8)

    def a_gpu_is_full(self):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    def python_allocates(self):
        raise MemoryError

    for fails in (torch_allocates, a_gpu_is_full, python_allocates):
        monkeypatch.setattr(module.VERBS["info"], "run", fails)
        assert "out of memory; train with --memory" in refused("info", "x")

    def another(self):
        raise RuntimeError("a defect")

    monkeypatch.setattr(module.VERBS["info"], "run", another)
    with pytest.raises(RuntimeError, match="a defect"):
        module.main(["info", "x"])


def test_a_training_whose_reader_has_gone_is_not_done(dataset, tmp_path):
    """As of `| head -1`: silent, but no success."""
    read, write = os.pipe()
    os.close(read)
    words = ["train", dataset, "-o", tmp_path / "out", "--iterations", 9, "--device", "cpu"]
    done = subprocess.run(
        [sys.executable, "-m", "snowsplat", *map(str, words)],
        env=ENVIRONMENT,
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")
    assert not (tmp_path / "out/point_cloud").exists()


def test_python_m(start):
    process = start("info", "/nonexistent")
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err == "snowsplat: /nonexistent: no such file or folder\n"
