"""Experiments on top of the system: a photo with depth, a photo as 2D Gaussians, a snow globe.

Each of them is a folder, with its subcommand in ``command.py``. Nothing below imports them: the
import of this package registers their subcommands.
"""

from snowsplat.cli.subcommands import Subcommand, register

register(
    "lift",
    Subcommand(
        "PHOTO --depth MAP -o OUT",
        "one photo and its depth -> a scene",
        "snowsplat.extras.lift.command",
    ),
)
register(
    "image",
    Subcommand(
        "PHOTO -o OUT",
        "a photo as 1000 Gaussians",
        "snowsplat.extras.image.command",
    ),
)
register(
    "globe",
    Subcommand(
        "SCENE",
        "a snow globe, as a web page",
        "snowsplat.extras.globe.command",
    ),
)
