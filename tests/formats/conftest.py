"""Fixtures for the tests of all formats: scenes, comparisons, and checks of error messages."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from snowsplat.formats import read_gaussians
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render
from snowsplat.util.errors import UserError

Make = Callable[..., Gaussians]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of scene files next to the project; the test is skipped if it is missing."""
    folder = Path(__file__).parents[2].parent / "shared/splats"
    if not folder.is_dir():
        pytest.skip(f"{folder} is missing")
    return folder


@pytest.fixture(scope="session")
def make_scene() -> Make:
    """``make_scene(n, degree)``: small, thin, faint to opaque Gaussians as in trained scenes."""

    def make(n: int, degree: int = 3, seed: int = 0) -> Gaussians:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=generator)

        return Gaussians(
            normal(n, 3),
            normal(n, 3) - 3,
            normal(n, 4),
            2 * normal(n) + 1,
            0.7 * normal(n, 1, 3),
            0.12 * normal(n, SH_REST_COUNTS[degree], 3),
        )

    return make


@pytest.fixture(scope="session")
def view() -> Callable[[Gaussians], torch.Tensor]:
    """``view(scene)``: the image (120, 160, 3) of a camera in front of such a scene."""
    cam_from_world = look_at(
        torch.tensor([0.5, -1.0, -5.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    )
    camera = Camera(160, 120, 150.0, 150.0, 80.0, 60.0, cam_from_world)
    return lambda gaussians: render(gaussians, camera).image


@pytest.fixture(scope="session")
def psnr(view) -> Callable[[Gaussians, Gaussians], float]:
    """``psnr(a, b)``: in dB, between the images of two scenes."""

    def compare(a: Gaussians, b: Gaussians) -> float:
        error = float(((view(a).clamp(0, 1) - view(b).clamp(0, 1)) ** 2).mean())
        return math.inf if error == 0 else -10 * math.log10(error)

    return compare


@pytest.fixture(scope="session")
def one_line() -> Callable[[Path], str]:
    """``one_line(path)``: reads a file that must be refused; returns the error message."""

    def refused(path: Path) -> str:
        with pytest.raises(UserError) as error:
            read_gaussians(path)
        line = str(error.value)
        assert line.startswith(str(path))
        assert "\n" not in line
        assert len(line) < 300 + len(str(path))
        return line

    return refused


@pytest.fixture(scope="session")
def rotation_error() -> Callable[[Gaussians, Gaussians], float]:
    """The largest difference between unit quaternions, up to their sign."""

    def largest(a: Gaussians, b: Gaussians) -> float:
        p, q = a.rotations, b.rotations
        error = torch.minimum((p - q).abs().amax(1), (p + q).abs().amax(1))
        return float(error.max()) if len(error) else 0.0

    return largest


class NodeProgram:
    """A program in tests/node that answers each line of JSON with a line of JSON."""

    def __init__(self, script: str, package: str) -> None:
        folder = Path(__file__).parents[1] / "node"
        if not (folder / "node_modules" / package).is_dir() or shutil.which("node") is None:
            pytest.skip(f"{package} or node is missing; `npm ci --ignore-scripts` in {folder}")
        self._process = subprocess.Popen(
            ["node", folder / script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "NO_COLOR": "1"},
        )

    def ask(self, request: object) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        timer = threading.Timer(100, self._process.kill)
        timer.start()
        answer = self._process.stdout.readline()
        timer.cancel()
        assert answer, "the program ended, or it took more than 100 s"
        return json.loads(answer)

    def __enter__(self) -> NodeProgram:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()


@pytest.fixture(scope="session")
def splat_transform() -> Iterator[Callable[..., None]]:
    """``splat_transform(source, target, *flags)``: the converter of PlayCanvas, an independent
    implementation. It needs Node; `npm ci --ignore-scripts` in tests/node installs it.
    """
    with NodeProgram("splat_transform.mjs", "@playcanvas/splat-transform") as program:

        def convert(source: Path, target: Path, *flags: str) -> None:
            arguments = ["--quiet", "--overwrite", source, *flags, target]
            done = program.ask([str(argument) for argument in arguments])
            assert done["code"] == 0, done["output"]

        yield convert
