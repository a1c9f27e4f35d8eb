"""Experiments on top of the system: a photo with depth, a photo as 2D Gaussians, a snow globe.

Each of them is a folder, with its subcommand in ``command.py``. Nothing below imports them: the
import of this package registers their subcommands.
"""

from snowsplat.cli.subcommands import Subcommand, register

for _name, _usage, _result in (
    ("lift", "PHOTO --depth MAP -o OUT", "one photo and its depth -> a scene"),
    ("image", "PHOTO -o OUT", "a photo as 1000 Gaussians"),
    ("globe", "SCENE", "a snow globe, as a web page"),
):
    register(_name, Subcommand(_usage, _result, f"snowsplat.extras.{_name}.command"))
