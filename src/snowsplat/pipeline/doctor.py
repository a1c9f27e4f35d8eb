"""`examine`: what snowsplat uses of this computer and its packages, and what is missing.

This is asked when something is wrong. Therefore it needs only the standard library, and it imports
each package in a process of its own: a broken package may end its process.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from snowsplat._version import __version__
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.machine import available_memory_bytes, memory_bytes, processor_name, system_name

#: Seconds for importing a package; a slow disk needs most of a minute for PyTorch.
_TIMEOUT = 180.0


@dataclass(frozen=True)
class Finding:
    """A line of the result."""

    name: str  # what it is about
    text: str  # for people; if something is missing, what this means, and what to do
    values: dict[str, Any]  # for programs: values of JSON
    problem: bool = False  # whether something is missing or broken
    essential: bool = False  # whether nothing works without it


@dataclass(frozen=True)
class _Package:
    module: str
    name: str  # for pip
    without: str  # what is not possible without it
    more: str = "''"  # a Python expression: what else is shown
    essential: bool = False


_PACKAGES = (
    _Package("numpy", "numpy", "nothing works", essential=True),
    _Package("PIL.Image", "pillow", "photos cannot be read", essential=True),
    _Package("cv2", "opencv-python-headless", "cameras are neither estimated nor checked"),
    _Package(
        "pycolmap",
        "pycolmap",
        "sfm and make cannot estimate camera poses; datasets with poses can be trained",
    ),
    _Package(
        "av", "av", "videos are neither read nor written", "'FFmpeg ' + module.ffmpeg_version_info"
    ),
    _Package("pillow_heif", "pillow-heif", "HEIC photos cannot be read"),
    _Package("uvicorn", "uvicorn", "train, make, watch, view and studio do not work"),
    _Package("starlette", "starlette", "train, make, watch, view and studio do not work"),
    _Package("zstandard", "zstandard", ".spz files of version 4 cannot be read or written"),
    _Package("safetensors", "safetensors", "evaluate cannot measure LPIPS"),
)

_TORCH = "from snowsplat.ops.cuda.availability import inventory; result = inventory()"
_WEBGPU = "from snowsplat.ops.webgpu.adapter import inventory; result = inventory()"
_NATIVE = (
    "from snowsplat.util import native_library as n; isa = n.library()[0]; "
    "result = [isa, n.available_isas(), n.default_threads()]"
)


def examine() -> Iterator[Finding]:
    """Everything that is known, in the order in which it is shown. Takes a few seconds."""
    with ThreadPoolExecutor() as pool:
        torch = pool.submit(_in_new_process, _TORCH)
        webgpu = pool.submit(_in_new_process, _WEBGPU)
        native = pool.submit(_in_new_process, _NATIVE)
        packages = [pool.submit(_package, package) for package in _PACKAGES]
        values: dict[str, Any] = {"version": __version__, "folder": str(_home())}
        yield Finding("snowsplat", f"{__version__} in {_home()}", values)
        values = {"name": system_name(), "python": sys.version, "executable": sys.executable}
        yield Finding("system", f"{system_name()} ({sys.executable})", values)
        yield _memory()
        yield _disk("disk", os.getcwd)
        yield _disk("temporary files", tempfile.gettempdir)
        yield from _environment()
        yield _processor(*native.result())
        yield from _torch_and_gpus(*torch.result())
        yield _webgpu(*webgpu.result())
        for package in packages:
            yield package.result()


def _home() -> Path:
    return Path(__file__).resolve().parents[1]


def _in_new_process(code: str) -> tuple[Any, str]:
    """The variable ``result`` of Python code that runs in a new process, and what is wrong."""
    code = f"import json, sys; sys.path[:] = json.loads(sys.argv[1]); {code}; "
    code += "print('\\n' + json.dumps(result))"
    # Packages that are imported may print lines.
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, json.dumps(sys.path)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=_TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        return None, f"is not loaded after {_TIMEOUT:.0f} s"
    except OSError as error:
        return None, f"cannot be examined: {error}"
    if done.returncode < 0:
        with suppress(ValueError):
            return None, f"ends the process ({signal.Signals(-done.returncode).name})"
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return None, re.sub(r"^[\w.]*Error: ", "", lines[-1])
    return json.loads(done.stdout.splitlines()[-1]), ""


def _processor(found: Any, problem: str) -> Finding:
    name = processor_name()
    if problem:
        text = f"{name}; the kernels CANNOT be used: {problem}"
        return Finding("processor", text, {"name": name, "problem": problem}, True, True)
    isa, isas, threads = found
    values = {"name": name, "instruction_set": isa, "available": isas, "threads": threads}
    return Finding("processor", f"{name}, {threads} threads, instruction set {isa}", values)


def _memory() -> Finding:
    total, free = memory_bytes(), available_memory_bytes()
    values = {"total_bytes": total or None, "available_bytes": free if total else None}
    text = f"{format_bytes(total)}, {format_bytes(free)} available" if total else "not known"
    return Finding("memory", text, values)


def _disk(name: str, folder_of: Callable[[], str]) -> Finding:
    try:
        folder = folder_of()
        usage = shutil.disk_usage(folder)
    except OSError as error:
        return Finding(name, f"NO usable folder: {error}", {"problem": str(error)}, True)
    writable = os.access(folder, os.W_OK)
    text = f"{format_bytes(usage.free)} free of {format_bytes(usage.total)} ({folder})"
    text += "" if writable else ": NOT writable; use another folder for results"
    values = {"folder": folder, "free_bytes": usage.free, "writable": writable}
    return Finding(name, text, values, not writable)


def _torch_and_gpus(found: dict[str, Any] | None, problem: str) -> list[Finding]:
    if found is None:
        text = f"{_advice('torch', problem)}: no training, rendering or evaluation"
        return [
            Finding("PyTorch", text, {"problem": problem}, True, True),
            Finding("GPU", "not known without PyTorch", {}),
        ]
    cuda = found["torch_cuda"]
    build = f"for CUDA {cuda}" if cuda else "CPU build"
    values = {"version": found["torch"], "cuda": cuda}
    findings = [Finding("PyTorch", f"{found['torch']}, {build}", values)]
    driver = f"driver {found['driver'] or 'of unknown version'} for CUDA {found['driver_cuda']}"
    for index, device in enumerate(found["devices"]):
        free = device.get("free_bytes")
        memory = format_bytes(device["memory_bytes"])
        memory += "" if free is None else f" ({format_bytes(free)} free)"
        text = (
            f"{device['name']}, compute capability {device['compute_capability']}, {memory}, "
            f"{driver}"
        )
        why = device["why_unused"]
        text += f"; NOT used: {why}" if why else ""
        values = {**device, "driver": found["driver"], "driver_cuda": found["driver_cuda"]}
        findings.append(Finding(f"GPU cuda:{index}", text, values, bool(why)))
    if not found["devices"]:
        there = found["has_gpu"]
        text = f"{'NOT used' if there else 'none'}: {found['why_unused']}; all commands use the CPU"
        text += f" ({driver})" if there else ""
        values = {"why_unused": found["why_unused"], "driver": found["driver"]}
        findings.append(Finding("GPU", text, values, there))
    findings.append(_kernels(found))
    return findings


def _kernels(found: dict[str, Any]) -> Finding:
    built, nvrtc = found["kernels_for"], found["nvrtc"]
    text = f"for compute capability {', '.join(built)}" if built else "none in this installation"
    text += f"; NVRTC {nvrtc} compiles those for others" if nvrtc else "; no NVRTC for others"
    missing = bool(found["devices"]) and not built and not nvrtc
    text += ", MISSING: pip install nvidia-cuda-nvrtc-cu12" if missing else ""
    return Finding("GPU kernels", text, {"built_for": built, "nvrtc": nvrtc}, missing)


def _webgpu(found: dict[str, Any] | None, problem: str) -> Finding:
    """It is not used unless it is asked for, so it is no problem if it is missing."""
    if found is None:
        return Finding("WebGPU", f"not known: {problem}", {"problem": problem})
    text = f"not usable: {found['why_unused']}"
    if found["adapter"]:
        text = f"{found['adapter']}; used only with --device webgpu, which is experimental"
    return Finding("WebGPU", text, found)


def _package(package: _Package) -> Finding:
    """Whether a package is there, can be imported, and has a suitable version."""
    found, problem = _in_new_process(
        f"import importlib; module = importlib.import_module({package.module!r}); "
        f"result = [getattr(module, '__version__', None), {package.more}]"
    )
    version, more = found or (None, "")
    with suppress(metadata.PackageNotFoundError):
        version = metadata.version(package.name)
    problem = problem or _unsuitable(package.name, version)
    values = {"version": version, **({"problem": problem} if problem else {})}
    if problem:
        text = f"{_advice(package.name, problem)}: {package.without}"
    else:
        text = ", ".join(filter(None, (version or "unknown version", more)))
    return Finding(package.name, text, values, bool(problem), package.essential)


def _advice(name: str, problem: str) -> str:
    """What is wrong with a package, and the command that installs it."""
    if re.fullmatch(r"No module named '[\w.]+'", problem):
        return f"MISSING ({problem}; pip install '{name}{_specifier(name)}')"
    return f"BROKEN ({problem}; pip install --force-reinstall '{name}{_specifier(name)}')"


def _specifier(name: str) -> str:
    """The versions that snowsplat needs: ">=4.2"; "" if this is not known."""
    with suppress(metadata.PackageNotFoundError):
        for requirement in metadata.requires("snowsplat") or []:
            match = re.match(rf"{re.escape(name)}\s*([^;\s]*)", requirement)
            if match and "extra ==" not in requirement:
                return match[1]
    return ""


def _unsuitable(name: str, version: str | None) -> str:
    """What is wrong with a version; "" if it is suitable or unknown."""
    for relation, limit in re.findall(r"(>=|<)([\d.]+)", _specifier(name)):
        if version is not None and (_numbers(version) >= _numbers(limit)) != (relation == ">="):
            return f"version {version} does not fit, {relation}{limit} is needed"
    return ""


def _numbers(version: str) -> tuple[int, ...]:
    match = re.match(r"[\d.]*\d", version)
    return tuple(map(int, match[0].split("."))) if match else ()


def _environment() -> Iterator[Finding]:
    values = {n: os.environ[n] for n in sorted(os.environ) if n.startswith("SNOWSPLAT_")}
    if values:
        yield Finding("environment", " ".join(f"{n}={values[n]}" for n in values), values)
