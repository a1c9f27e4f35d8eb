"""`--memory`: a dataset that is four times as large as the allowed memory."""

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import snowsplat

SOURCES = Path(snowsplat.__file__).parents[1]
WIDTH, HEIGHT, BUDGET = 640, 480, 170_000_000
COUNT = 4 * BUDGET // (3 * WIDTH * HEIGHT)


pytestmark = pytest.mark.slow


def snowsplat_cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(SOURCES), "SNOWSPLAT_DEVICE": "cpu"}
    command = [sys.executable, "-m", "snowsplat", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photos under many names (hard links)."""
    folder: Path = tmp_path_factory.mktemp("large")
    random = np.random.default_rng(0)
    frames = []
    for i in range(COUNT):
        name = f"{i:05d}.jpg"
        if i < 4:
            coarse = random.integers(0, 255, (HEIGHT // 20, WIDTH // 20, 3), dtype=np.uint8)
            Image.fromarray(coarse).resize((WIDTH, HEIGHT)).save(folder / name)
        else:
            os.link(folder / f"{i % 4:05d}.jpg", folder / name)
        c, s = math.cos(2 * math.pi * i / COUNT), math.sin(2 * math.pi * i / COUNT)
        pose = [[c, 0, s, 4 * s], [0, 1, 0, 0], [-s, 0, c, 4 * c], [0, 0, 0, 1]]
        frames.append({"file_path": name, "transform_matrix": pose})
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 600, "fl_y": 600, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.mark.nightly  # it takes a minute; tests/training/test_memory_budget.py tests the plan
def test_a_dataset_of_four_times_the_memory_trains(large: Path, tmp_path: Path) -> None:
    arguments = (
        "-o",
        str(tmp_path / "out"),
        "--memory",
        f"{BUDGET // 10**6}MB",
        *("--iterations", "25", "--densify-from-iter", "10", "--densify-interval", "10"),
    )
    run = snowsplat_cli("train", str(large), *arguments)
    assert run.returncode == 0, run.stderr
    line = r"^training on .* threads, \w+; memory: [\d.]+ MB at most \(.*photos [\d.]+ MB\)$"
    assert re.search(line, run.stdout, re.MULTILINE)
    assert re.search(r"^for lack of memory: at most [\d,]+ Gaussians", run.stdout, re.MULTILINE)
    assert "of the photos stay decoded" in run.stdout
    used = re.search(r"at most (\d+) MB, (\d+) of them Python", run.stdout)
    assert used is not None
    assert int(used[1]) - int(used[2]) <= BUDGET / 1e6


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ("40MB", r"40 MB is too little for photos .* a lower resolution"),
        ("lots", r"'lots' is not a size; use e.g. 4GB or 800MB"),
    ],
)
def test_invalid_budgets_are_rejected_before_any_output(refused, dataset, tmp_path, size, message):
    out = tmp_path / "out"
    error = refused("train", dataset, "-o", out, "--memory", size, "--device", "cpu")
    assert re.fullmatch(f"snowsplat: --memory: {message}", error), error
    assert not out.exists()
