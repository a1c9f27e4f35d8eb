"""What runs with the rights of the project or of its users is fixed, and has few rights."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_actions_are_pinned_by_commit():
    """A tag of another repository can be moved to other code, a commit cannot."""
    uses = []
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        uses += re.findall(r"uses:\s*(\S+)(.*)", path.read_text(encoding="utf-8"))
    others = [(name, comment) for name, comment in uses if not name.startswith("./")]
    assert len(others) > 10
    for name, comment in others:
        assert re.fullmatch(r"[\w.-]+/[\w./-]+@[0-9a-f]{40}", name), name
        assert re.fullmatch(r" # v[\d.]+", comment), f"{name}: add its version as a comment"


def test_packages_of_other_viewers_have_exact_versions():
    """`benchmarks/viewers.py` runs them in a browser."""
    file = ROOT / "benchmarks" / "viewers" / "package.json"
    for name, version in json.loads(file.read_text(encoding="utf-8"))["dependencies"].items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version), name


def test_images_of_the_container_do_not_run_as_root():
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    stages = re.split(r"^FROM .* AS (\w+)$", text, flags=re.MULTILINE)
    targets = dict(zip(stages[1::2], stages[2::2], strict=True))
    for target in ("cpu", "gpu"):
        users = re.findall(r"^USER (\w+)$", targets[target], flags=re.MULTILINE)
        assert users
        assert users[-1] != "root"
