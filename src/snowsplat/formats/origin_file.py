"""The place of a scene beside a file whose format cannot store it: `NAME.spz.origin.json`.

The place is the `scene.origin`, and the true scale of `scene.length`.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

from snowsplat.scene.origin import HERE, Origin, stored_metres, stored_origin
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import is_file, parse_json

logger = logging.getLogger(__name__)

_MOST_BYTES = 1 << 16


class Place(NamedTuple):
    """What a scene has in such a file."""

    origin: Origin = HERE
    metres_per_unit: float | None = None


def origin_file(scene: Path) -> Path:
    """Where the place of a scene file is stored."""
    return scene.with_name(scene.name + ".origin.json")


def read_place(scene: Path) -> Place:
    """The place beside a scene file; that of 0 if there is none. A damaged file is a warning."""
    path = origin_file(scene)
    if not is_file(path):
        return Place()
    try:
        with open(path, "rb") as file:
            values = parse_json(file.read(_MOST_BYTES))
        origin = stored_origin(values["origin"]) if "origin" in values else HERE
        metres = stored_metres(values.get("metres_per_unit"))
        if origin is None or ("metres_per_unit" in values and metres is None):
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError):
        logger.warning("%s: damaged; the place of the scene is unknown", path)
        return Place()
    return Place(origin, metres)


def write_place(scene: Path, place: Place) -> None:
    """Store the place of a scene file, or remove the stored one if there is nothing to say.

    Raises:
        OSError: the folder is not writable, or the disk is full.
    """
    origin = {"origin": list(place.origin)} if any(place.origin) else {}
    metres = {"metres_per_unit": place.metres_per_unit} if place.metres_per_unit else {}
    if origin or metres:
        write_json(origin_file(scene), origin | metres)
    else:
        origin_file(scene).unlink(missing_ok=True)
