"""The modules of the pages have the types that their comments say."""

import shutil
import subprocess
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[2]
_TSC = _ROOT / "tests/node/node_modules/typescript/bin/tsc"

pytestmark = pytest.mark.skipif(
    shutil.which("node") is None or not _TSC.is_file(),
    reason="needs Node, and npm ci --ignore-scripts in tests/node",
)


def check(project: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["node", _TSC, "-p", project], capture_output=True, text=True)


def test_types():
    done = check(_ROOT / "jsconfig.json")
    assert done.returncode == 0, done.stdout


def test_a_wrong_type_is_found(tmp_path):
    settings = (_ROOT / "jsconfig.json").read_text("utf-8").split('"include"')[0]
    (tmp_path / "jsconfig.json").write_text(settings + '"include": ["*.js"]\n}')
    (tmp_path / "page.js").write_text("/** @param {number} x */\nexport const f = x => x.length;\n")
    assert "TS2339" in check(tmp_path / "jsconfig.json").stdout
