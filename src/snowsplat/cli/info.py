"""`snowsplat info`: the contents of a file or folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, next_step, see_and_share
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import printable
from snowsplat.util.settings import needed


@dataclass(frozen=True, kw_only=True)
class Info(JsonCommand):
    """Describe photos, a video, a dataset, a scene, a checkpoint or an output folder.

    Examples:
      snowsplat info out/garden
      snowsplat info walk_scene
      snowsplat info photos
      snowsplat info garden.spz
      snowsplat info out/garden/point_cloud/iteration_2000/point_cloud.ply
      snowsplat info garden

    Notes:
      For a file, this command prints the format, the size, the number of
      Gaussians or points, the bounds of the scene, and percentiles of opacity and
      scale. For a folder, it also prints the photos, scenes, checkpoints and
      metrics. For a checkpoint, it also checks that the file is not damaged. For
      photos and videos, it prints what sfm and make would use of them, and how long
      the camera poses take.
    """

    path: Path = needed(
        "info needs a file or folder; add one",
        "FILE|OUT|DATASET",
        "A scene file of any format, a checkpoint, an output folder, a dataset, photos or a video.",
        argument=True,
    )

    def run(self) -> dict[str, Any]:
        from snowsplat.pipeline.describe import describe

        facts = describe(self.path)
        if not self.json:
            _print(facts)
            for line in _next(facts, self.path):
                print(line)
        return facts


def _next(facts: dict[str, Any], path: Path) -> list[Message]:
    """What to do with what was described."""
    kind = facts["kind"]
    if facts.get("scenes") == []:
        return [next_step(message("to continue"), "train", "-o", path, "--resume")]
    if kind in ("scene", "output folder"):
        return [see_and_share(path)]
    if kind in ("photos", "video"):
        return [next_step(message("to make a scene"), "make", path)]
    if kind == "dataset":
        return [next_step(message("to make a scene"), "train", path, "-o", "OUT", "--eval")]
    return []


def _print(facts: dict[str, Any], indent: str = "") -> None:
    """Print one line per fact; a dict that contains dicts or lists is indented below its name."""
    facts = {
        # "bytes_in_memory" -> "size in memory"
        re.sub("^bytes", "size", name): format_bytes(value) if name.startswith("bytes") else value
        for name, value in facts.items()
    }
    width = max(len(name) for name in facts)
    for name, value in facts.items():
        label = f"{indent}{name.replace('_', ' '):{width}}"
        if isinstance(value, dict) and any(isinstance(v, dict | list) for v in value.values()):
            print(printable(label.rstrip()))
            _print(value, indent + "  ")
        elif isinstance(value, dict):
            inner = ", ".join(f"{k} {_text(v)}" for k, v in value.items())
            print(printable(f"{label} {inner}"))
        else:
            print(printable(f"{label} {_text(value)}"))


def _text(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list):
        return (
            " … ".join(map(_text, value))
            if any(isinstance(v, list) for v in value)
            else (" ".join(map(_text, value)) or "none")
        )
    if isinstance(value, float):  # large numbers are coordinates, for example of UTM
        return f"{value:.5g}" if abs(value) < 1e5 else f"{value:.12g}"
    return str(value)
