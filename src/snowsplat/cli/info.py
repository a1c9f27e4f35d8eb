"""`snowsplat info`: the contents of a file or folder."""

import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, next_step, see_and_share
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import printable
from snowsplat.util.settings import needed

_OF_ANY = message("kind"), message("path"), message("file"), message("size"), message("next")
_KINDS = [message("scene"), message("point cloud"), message("checkpoint"), message("output folder")]
_KINDS += [message("zip file"), message("photos"), message("video"), message("dataset")]
_OF_SCENES = [message("format"), message("lost in it"), message("encoding"), message("gaussians")]
_OF_SCENES += [message("gaussians per level"), message("points"), message("sh degree")]
_OF_SCENES += [message("antialiased"), message("size in memory"), message("not finite")]
_OF_SCENES += [message("opacity"), message("scale"), message("longest to shortest axis")]
_PLACES = [message("bounds"), message("bounds of 98 percent"), message("origin")]
_PLACES += [message("metres per unit"), message("extent")]
_OF_RUNS = [message("step"), message("tensors"), message("background"), message("scenes")]
_OF_RUNS += [message("checkpoints"), message("metrics"), message("last scene"), message("left out")]
_OF_DATASETS = [message("description"), message("held out with eval"), message("sizes")]
_OF_DATASETS += [message("focal length pixels"), message("masks"), message("depth maps")]
_OF_DATASETS += [message("normal maps"), message("impossible"), message("doubtful")]
_OF_PHOTOS = [message("videos"), message("files"), message("formats"), message("cameras")]
_OF_PHOTOS += [message("with focal length"), message("with gps"), message("with attitude")]
_OF_PHOTOS += [message("with transparency"), message("not used"), message("unused masks")]
_OF_PHOTOS += [message("and"), message("camera poses")]
_GROUPS = _OF_ANY, _KINDS, _OF_SCENES, _PLACES, _OF_RUNS, _OF_DATASETS, _OF_PHOTOS
#: What facts are called; the names of settings and tensors are in no language.
_LABELS = {label.key: label for labels in _GROUPS for label in labels}


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
      scale. For a folder, it also prints the photos, scenes, checkpoints, metrics,
      and which photos were left out and why. For a checkpoint, it also checks that
      the file is not damaged. For photos and videos, it prints what sfm and make
      would use of them, and how long the camera poses take.
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
    lines = []
    for name, value in facts.items():
        # "bytes_in_memory" -> "size in memory"
        key = re.sub("^bytes", "size", name).replace("_", " ")
        label = printable(str(_LABELS.get(key, key)))
        if name.startswith("bytes"):
            value = format_bytes(value)
        elif name == "kind":
            value = _LABELS[value]
        lines.append((indent + label, value))
    width = max(_columns(label) for label, _ in lines)
    for label, value in lines:
        label += " " * (width - _columns(label))
        if isinstance(value, dict) and any(isinstance(v, dict | list) for v in value.values()):
            print(label.rstrip())
            _print(value, indent + "  ")
        elif isinstance(value, list) and value and isinstance(value[0], dict):  # left out
            print(label.rstrip())
            for each in value:
                print(printable(f"{indent}  {each['photo']}: {each['reason']}"))
        elif isinstance(value, dict):
            inner = ", ".join(f"{k} {_text(v)}" for k, v in value.items())
            print(printable(f"{label} {inner}"))
        else:
            print(printable(f"{label} {_text(value)}"))


def _columns(text: str) -> int:
    """The columns of a text in a terminal, where Chinese characters take two."""
    return sum(2 if unicodedata.east_asian_width(each) in "FW" else 1 for each in text)


def _text(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return "-" if value is None else str(message("yes") if value else message("no"))
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list):
        return (
            " … ".join(map(_text, value))
            if any(isinstance(v, list) for v in value)
            else (" ".join(map(_text, value)) or str(message("none")))
        )
    if isinstance(value, float):  # large numbers are coordinates, for example of UTM
        return f"{value:.5g}" if abs(value) < 1e5 else f"{value:.12g}"
    return str(value)
