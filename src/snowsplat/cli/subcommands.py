"""The subcommands, by name. The module of a subcommand is imported when it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.util.safe_json import read_json

if TYPE_CHECKING:
    from snowsplat.cli.command import Command


@dataclass(frozen=True)
class Subcommand:
    """What the overview of all subcommands tells about one, and where it is."""

    usage: str  # its arguments in an example
    result: str  # what this example does
    load: Callable[[], type[Command]]  # imports its module


def _load(name: str) -> type[Command]:
    # Only modules of this package; a package above hands over a function, see `extras.register`.
    file = "mesh" if name == "points" else name
    module = import_module(f"{__package__}.{file}")
    found: type[Command] = getattr(module, name.capitalize())
    return found


SUBCOMMANDS = {
    name: Subcommand(usage, result, partial(_load, name))
    for name, usage, result in (
        ("studio", "[FOLDER]", "all of this in the browser"),
        ("demo", "", "try it, without own photos"),
        ("make", "PHOTOS", "photos or a video -> a scene"),
        ("sfm", "PHOTOS -o DATASET", "photos, video -> a dataset with poses"),
        ("train", "DATASET -o OUT --eval", "a dataset -> a scene in OUT"),
        ("evaluate", "OUT", "PSNR and SSIM on the held-out photos"),
        ("render", "OUT", "images and videos of the scene"),
        ("view", "FILE|OUT", "show a finished scene in the browser"),
        ("watch", "OUT", "show the training in the browser"),
        ("convert", "SCENE [MORE …] FILE", "another format; crop, decimate, merge"),
        ("clean", "SCENE FILE", "the scene without floaters"),
        ("mesh", "SCENE -o FILE.glb", "triangles for Blender, games"),
        ("points", "SCENE -o FILE.laz", "a dense point cloud with normals"),
        ("publish", "SCENE -o FOLDER", "a web site, for any host"),
        ("benchmark", "FOLDER -o OUT", "all scenes of a folder, and a table"),
        ("blocks", "plan DATASET -o OUT", "a scene larger than the memory"),
        ("info", "PATH", "describe a file or a folder"),
        ("doctor", "", "is everything installed? which GPU?"),
    )
}


def load_subcommand(name: str) -> type[Command]:
    """Import a subcommand."""
    return SUBCOMMANDS[name].load()


def known_words() -> dict[str, str]:
    """What to use -> the words that people try, with spaces between them."""
    found: dict[str, str] = read_json(Path(__file__).with_name("words.json"))
    return found


def advice(word: str) -> str | None:
    """What to use for a word that is no subcommand, such as "export"; None if it is not known."""
    word = word.lower().removeprefix("ns-")
    names = (word, word.removesuffix(".py"))
    known = known_words()
    return next((hint for n in names for hint, words in known.items() if n in words.split()), None)


def overview() -> str:
    """All subcommands, a line each. It fits into a terminal of 80 columns and 24 lines."""
    lines = [
        f"  snowsplat {f'{name} {subcommand.usage}':29} {subcommand.result}"
        for name, subcommand in SUBCOMMANDS.items()
    ]
    return _OVERVIEW.format(subcommands="\n".join(lines))


_OVERVIEW = """3D scenes from photos (Gaussian Splatting). For each: snowsplat NAME --help
{subcommands}"""
