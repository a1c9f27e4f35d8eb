"""The subcommands, by name. The module of a subcommand is imported when it is called."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any


@dataclass(frozen=True)
class Subcommand:
    """Where a subcommand is, and what the overview of all subcommands tells about it."""

    summary: str  # the first line of the docstring of its dataclass
    usage: str  # its arguments in an example
    result: str  # what this example does
    module: str  # defines its dataclass; ``Train`` for the subcommand ``train``


def _own(name: str, summary: str, usage: str, result: str) -> tuple[str, Subcommand]:
    return name, Subcommand(summary, usage, result, f"snowsplat.cli.{name}")


SUBCOMMANDS: dict[str, Subcommand] = dict(
    (
        _own(
            "demo",
            "Try snowsplat: make a scene from rendered photos of a synthetic scene.",
            "",
            "try it, without own photos",
        ),
        _own(
            "make",
            "Make a scene from photos or a video: sfm, train and render in one command.",
            "PHOTOS",
            "photos or a video -> a scene",
        ),
        _own(
            "sfm",
            "Estimate the camera poses of photos or a video, and create a dataset.",
            "PHOTOS -o DATASET",
            "photos or a video -> a dataset",
        ),
        _own(
            "train",
            "Train a scene from photos with known camera poses (COLMAP or transforms.json).",
            "DATASET -o OUT --eval",
            "a dataset -> a scene in OUT",
        ),
        _own(
            "evaluate",
            "Compare a scene with the held-out photos: PSNR, SSIM and, with weights, LPIPS.",
            "OUT",
            "PSNR and SSIM on the held-out photos",
        ),
        _own(
            "render",
            "Render images at the camera poses of the photos, or a video.",
            "OUT",
            "images and videos of the scene",
        ),
        _own(
            "view",
            "Show a finished scene in the browser.",
            "FILE|OUT",
            "show a finished scene in the browser",
        ),
        _own(
            "watch",
            "Show an ongoing or finished training run in the browser, with its photos.",
            "OUT",
            "show the training in the browser",
        ),
        _own(
            "convert",
            "Write a scene in another file format; crop, decimate, transform or merge scenes.",
            "SCENE [MORE …] FILE",
            "another format; crop, decimate, merge",
        ),
        _own(
            "clean",
            "Remove floaters: Gaussians that hang in front of the surfaces.",
            "SCENE FILE",
            "the scene without floaters",
        ),
        _own(
            "publish",
            "Write a static web site that shows a scene.",
            "SCENE -o FOLDER",
            "a web site, for any host",
        ),
        _own(
            "benchmark",
            "Train and evaluate all scenes of a folder by the protocol of the papers.",
            "FOLDER -o OUT",
            "all scenes of a folder, and a table",
        ),
        _own(
            "blocks",
            "Train a scene that is larger than the memory, in blocks that are merged.",
            "plan DATASET -o OUT",
            "a scene larger than the memory, in blocks",
        ),
        _own(
            "info",
            "Describe photos, a video, a dataset, a scene, a checkpoint or an output folder.",
            "PATH",
            "describe a file or a folder",
        ),
    )
)


def register(name: str, subcommand: Subcommand) -> None:
    """Add a subcommand, or replace one."""
    SUBCOMMANDS[name] = subcommand


def load_subcommand(name: str) -> Any:
    """Import the dataclass of a subcommand."""
    return getattr(import_module(SUBCOMMANDS[name].module), name.capitalize())


def description() -> str:
    """The overview of all subcommands."""
    lines = [
        f"  snowsplat {f'{name} {subcommand.usage}':29} {subcommand.result}"
        for name, subcommand in SUBCOMMANDS.items()
    ]
    return _DESCRIPTION.format(subcommands="\n".join(lines))


_DESCRIPTION = """3D Gaussian Splatting on any computer: makes a 3D scene from photos or a video.

{subcommands}

A dataset is a folder of photos with their camera poses.

Each subcommand has its own help: snowsplat train --help

For shell completion, add this line to your shell's startup file:
  eval "$(snowsplat --tyro-print-completion bash)"    (or zsh)"""


# The experiments register themselves. Everything else works without that folder.
if find_spec("snowsplat.extras"):
    import_module("snowsplat.extras")
