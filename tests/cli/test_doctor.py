"""`snowsplat doctor`: all that is there, and each kind of what is missing or broken."""

import json
import sys

import pytest
import torch

from snowsplat._version import __version__
from snowsplat.pipeline import doctor

GPU = {
    "name": "A card",
    "compute_capability": "7.0",
    "memory_bytes": 16_000_000_000,
    "free_bytes": 15_000_000_000,
    "why_unused": None,
}
TORCH = {
    "torch": "2.7.1",
    "torch_cuda": "12.6",
    "devices": [GPU],
    "why_unused": None,
    "has_gpu": True,
    "driver": "570.86",
    "driver_cuda": "12.8",
    "kernels_for": ["7.0", "8.0"],
    "nvrtc": None,
}


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """``broken(name, code)``: a module that is imported instead of the installed one."""
    monkeypatch.syspath_prepend(str(tmp_path))
    return lambda name, code: (tmp_path / f"{name}.py").write_text(code)


def lines(out: str) -> dict[str, str]:
    return {line[:22].strip(): line[24:] for line in out.splitlines() if line[22:24] == "  "}


@pytest.mark.slow
def test_the_facts_of_this_installation(run, monkeypatch, tmp_path):
    monkeypatch.delenv("SNOWSPLAT_GPU_ARCHITECTURES", raising=False)
    monkeypatch.setenv("SNOWSPLAT_THREADS", "3")
    monkeypatch.chdir(tmp_path)
    result = run("doctor", "--json")
    facts = json.loads(result.out)
    assert (result.code, facts["problems"], result.err) == (0, [], "")
    assert facts["snowsplat"]["version"] == __version__
    assert facts["system"]["executable"] == sys.executable
    assert facts["PyTorch"] == {"version": torch.__version__, "cuda": torch.version.cuda}
    assert facts["processor"]["threads"] == 3
    assert facts["processor"]["instruction_set"] in facts["processor"]["available"]
    assert facts["disk"]["folder"] == str(tmp_path)
    assert facts["disk"]["free_bytes"] > 0
    assert facts["environment"] == {"SNOWSPLAT_THREADS": "3"}
    assert facts["pycolmap"]["version"][0].isdecimal()


def test_missing_and_broken_packages(run, broken, monkeypatch):
    """The command itself needs none of them. Each fake is found before the installed package."""
    broken("torch", "raise OSError('libtorch.so: cannot open shared object file')")
    broken("numpy", "raise ImportError('needs a newer processor')")
    broken("pycolmap", "import os, signal; os.kill(os.getpid(), signal.SIGILL)")
    broken("uvicorn", "raise ModuleNotFoundError(\"No module named 'uvicorn'\")")
    broken("av", "print('hello')\nffmpeg_version_info = '9.9'")
    kept = [p for p in doctor._PACKAGES if p.module in ("numpy", "pycolmap", "uvicorn", "av")]
    monkeypatch.setattr(doctor, "_PACKAGES", kept)
    result = run("doctor")
    assert (result.code, result.err) == (1, "")
    found = lines(result.out)
    assert "CANNOT be used: needs a newer processor" in found["processor"]
    assert found["PyTorch"].startswith("BROKEN (libtorch.so: cannot open shared object file; pip")
    assert found["GPU"] == "not known without PyTorch"
    assert found["pycolmap"].startswith("BROKEN (ends the process (SIGILL); pip install --force")
    assert found["uvicorn"].startswith("MISSING (No module named 'uvicorn'; pip install 'uvicorn")
    assert "watch" in found["uvicorn"]
    assert found["av"].endswith("FFmpeg 9.9")
    assert result.out.splitlines()[-1] == "see above: processor, PyTorch, numpy, pycolmap, uvicorn"


@pytest.mark.parametrize(
    ("version", "fits"), [("4.2.1", True), ("3.13", False), ("5.0rc1", False), (None, True)]
)
def test_versions_that_do_not_fit(version, fits, monkeypatch):
    needed = ["pycolmap<5,>=4.2; sys_platform == 'linux'", 'pycolmap==1; extra == "dev"', "a>=9"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: needed)
    assert doctor._specifier("pycolmap") == "<5,>=4.2"
    assert (doctor._unsuitable("pycolmap", version) == "") == fits
    assert doctor._unsuitable("b", version) == ""


def gpu_lines(**changes) -> dict[str, tuple[str, bool]]:
    found = doctor._torch_and_gpus({**TORCH, **changes}, "")
    return {finding.name: (finding.text, finding.problem) for finding in found}


def test_gpus():
    assert gpu_lines() == {
        "PyTorch": ("2.7.1, for CUDA 12.6", False),
        "GPU cuda:0": (
            "A card, compute capability 7.0, 16.0 GB (15.0 GB free), driver 570.86 for CUDA 12.8",
            False,
        ),
        "GPU kernels": ("for compute capability 7.0, 8.0; no NVRTC for others", False),
    }
    why = "the package cuda-bindings is missing: pip install cuda-bindings"
    text, problem = gpu_lines(devices=[{**GPU, "why_unused": why}])["GPU cuda:0"]
    assert problem
    assert text.endswith(f"; NOT used: {why}")
    none = {"devices": [], "why_unused": "it is too old"}
    text, problem = gpu_lines(**none)["GPU"]
    assert problem
    assert text.startswith("NOT used: it is too old; all commands use the CPU (driver 570.86")
    text, problem = gpu_lines(**none, has_gpu=False, driver=None, driver_cuda=None)["GPU"]
    assert (text, problem) == ("none: it is too old; all commands use the CPU", False)
    assert gpu_lines(kernels_for=[])["GPU kernels"][1]
    assert not gpu_lines(kernels_for=[], nvrtc="12.9")["GPU kernels"][1]


def test_a_folder_that_is_gone_or_not_writable(tmp_path, monkeypatch):
    def gone() -> str:
        raise FileNotFoundError("no such folder")

    assert doctor._disk("disk", gone).problem
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    found = doctor._disk("disk", lambda: str(tmp_path))
    assert found.problem
    assert "NOT writable" in found.text
