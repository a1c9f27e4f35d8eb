"""The examples of docs/guides/research.md: they are short, they run, and they survive kill -9."""

import os
import re
from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset

from .fork_server import ENVIRONMENT, run

PAGE = Path(__file__).resolve().parents[1] / "docs" / "guides" / "research.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
#: The examples whose training writes checkpoints.
RESUMED = [block for block in BLOCKS if "checkpoint_every" in block]
NAMES = [re.search(r'"out/(\w+)"', block)[1] for block in RESUMED]
KILLED = """
import os, signal
from snowsplat import Trainer

step_once = Trainer.step_once


def killed(trainer):
    if trainer.step == 35:
        os.kill(os.getpid(), signal.SIGKILL)
    return step_once(trainer)


Trainer.step_once = killed
"""


#: In place of matplotlib, which is no requirement.
PLOTS = (
    "import sys; from unittest.mock import MagicMock as M; p = M();"
    "p.subplots = lambda: (M(), M());"
    "sys.modules |= {'matplotlib': M(pyplot=p), 'matplotlib.pyplot': p}"
)


def quick(block: str) -> str:
    """The example with fewer steps, and a checkpoint after step 25."""
    block = block.replace('"iterations": 300', '"iterations": 50')
    block = block.replace("iterations=300", "iterations=50").replace("range(100)", "range(5)")
    block = block.replace("(100, 200)", "(10, 30)")
    return block.replace('"checkpoint_every": 50', '"checkpoint_every": 25')


def executed(code: str, folder: Path) -> tuple[int, str, str]:
    (folder / "example.py").write_text(code)
    inside = f"{PLOTS}; import os, runpy; os.chdir({str(folder)!r}); runpy.run_path('example.py')"
    done = run("-c", inside, env={**ENVIRONMENT, "OMP_NUM_THREADS": "1"})
    return done.returncode, done.stdout, done.stderr


def scene(folder: Path, name: str) -> bytes:
    return (folder / "out" / name / "point_cloud/iteration_50/point_cloud.ply").read_bytes()


@pytest.fixture
def folder(tmp_path) -> Path:
    write_toy_dataset(tmp_path / "garden", n_views=9, width=48, height=36, n_points=300)
    return tmp_path


def test_each_addition_has_at_most_15_lines():
    assert set(NAMES) == {"depth", "frozen", "pruned"}
    for block in BLOCKS:
        added = [
            re.match(
                r".*?\n(?=settings =|options =|dataset =|parts =|$)", block[at.start() :], re.S
            )
            for at in re.finditer(r"^(?:@register|class |def )", block, re.M)
        ]
        code = [line for line in "".join(m[0] for m in added[:1]).splitlines() if line.strip()]
        assert len(code) <= 15, block


@pytest.mark.slow
@pytest.mark.parametrize("block", [b for b in BLOCKS if b not in RESUMED])
def test_an_example_runs(folder, block):
    if "write_toy_dataset" in block:
        block = block.replace('"garden", n_views=24', '"other", n_views=3')
    code, out, err = executed(quick(block), folder)
    assert code == 0, err
    if "print(" in block:
        assert 0.0 < float(out.split()[-1]) < 60.0


@pytest.mark.kill
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize("name", NAMES)
def test_a_training_that_was_killed_continues_to_the_same_bits(folder, name):
    block = quick(RESUMED[NAMES.index(name)])
    code, _, err = executed(block, folder)
    assert code == 0, err
    whole = scene(folder, name)

    other = block.replace(f"out/{name}", f"out/{name}_killed")
    code, _, err = executed(KILLED + other, folder)
    assert code == -9, err
    assert not (folder / f"out/{name}_killed/point_cloud/iteration_50").exists()

    again, changes = re.subn(r'snowsplat\.train\("garden", ', "snowsplat.resume(", other)
    again, more = re.subn(r", options(?=[,)])", "", again)
    assert (changes, more) == (1, 1)
    code, _, err = executed(again, folder)
    assert code == 0, err
    assert scene(folder, f"{name}_killed") == whole

    # Without what was added, the message says what is missing.
    code, _, err = executed(f"import snowsplat\nsnowsplat.resume('out/{name}_killed')\n", folder)
    assert code != 0
    missing = {"depth": "SmoothDepth", "frozen": "Freeze", "pruned": "Prune"}[name]
    assert missing in err.splitlines()[-1]
