"""The last line of a subcommand: what to do next."""

from __future__ import annotations

import shlex
from pathlib import Path


def next_step(purpose: str, *words: object) -> str:
    """A purpose and the command for it: "to see it: snowsplat view 'my garden'"."""
    return f"{purpose}: {shlex.join(['snowsplat', *map(str, words)])}"


def see_and_share(scene: Path) -> str:
    """How to see and share a scene: a file, or the output folder of `train` or `make`."""
    name = scene.resolve().name.split(".")[0].removesuffix("_scene") or "scene"
    see = next_step("to see it", "view", scene)
    return f"{see}; {next_step('to share it', 'publish', scene, '-o', f'{name}_site')}"
