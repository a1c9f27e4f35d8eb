"""Experiments on top of the system: a photo with depth, a photo as 2D Gaussians, a snow globe.

Each of them is a folder, with its subcommand in ``command.py``. Nothing below imports them:
`snowsplat.__main__` adds their subcommands to those of the command line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from snowsplat.cli.subcommands import SUBCOMMANDS, Subcommand

if TYPE_CHECKING:
    from snowsplat.cli.command import Command


def register() -> None:
    """Add the subcommands of the experiments."""
    SUBCOMMANDS["lift"] = Subcommand(
        "PHOTO --depth MAP -o OUT", "one photo and its depth -> a scene", _lift
    )
    SUBCOMMANDS["image"] = Subcommand("PHOTO -o OUT", "a photo as 1000 Gaussians", _image)
    SUBCOMMANDS["anamorph"] = Subcommand(
        "A B [C] -o OUT", "another picture from each side", _anamorph
    )
    SUBCOMMANDS["globe"] = Subcommand("SCENE", "a snow globe, as a web page", _globe)


def _lift() -> type[Command]:
    from snowsplat.extras.lift.command import Lift

    return Lift


def _image() -> type[Command]:
    from snowsplat.extras.image.command import Image

    return Image


def _anamorph() -> type[Command]:
    from snowsplat.extras.anamorph.command import Anamorph

    return Anamorph


def _globe() -> type[Command]:
    from snowsplat.extras.globe.command import Globe

    return Globe
