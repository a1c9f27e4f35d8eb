"""The last line of a subcommand: what to do next."""

from __future__ import annotations

import shlex
from pathlib import Path

from snowsplat.util.messages import Message, message


def next_step(purpose: Message, *words: object) -> Message:
    """A purpose and the command for it: "to see it: snowsplat view 'my garden'"."""
    command = shlex.join(["snowsplat", *map(str, words)])
    return message("{purpose}: {command}", purpose=purpose, command=command)


def see_and_share(scene: Path) -> Message:
    """How to see and share a scene: a file, or the output folder of `train` or `make`."""
    name = scene.resolve().name.split(".")[0].removesuffix("_scene") or "scene"
    see = next_step(message("to see it"), "view", scene)
    share = next_step(message("to share it"), "publish", scene, "-o", f"{name}_site")
    return message("{see}; {share}", see=see, share=share)
