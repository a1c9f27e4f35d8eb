"""The origin of a scene beside a file whose format cannot store it: `NAME.spz.origin.json`."""

from __future__ import annotations

import logging
from pathlib import Path

from snowsplat.scene.origin import HERE, Origin, stored_origin
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import is_file, parse_json

logger = logging.getLogger(__name__)

_MOST_BYTES = 1 << 16


def origin_file(scene: Path) -> Path:
    """Where the origin of a scene file is stored."""
    return scene.with_name(scene.name + ".origin.json")


def read_origin(scene: Path) -> Origin:
    """The origin beside a scene file; `HERE` if there is none. A damaged one is a warning."""
    path = origin_file(scene)
    if not is_file(path):
        return HERE
    try:
        with open(path, "rb") as file:
            origin = stored_origin(parse_json(file.read(_MOST_BYTES))["origin"])
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        origin = None
    if origin is None:
        logger.warning("%s: damaged; the place of the scene is unknown", path)
    return origin or HERE


def write_origin(scene: Path, origin: Origin) -> None:
    """Store the origin of a scene file, or remove the stored one if it is `HERE`.

    Raises:
        OSError: the folder is not writable, or the disk is full.
    """
    if any(origin):
        write_json(origin_file(scene), {"origin": list(origin)})
    else:
        origin_file(scene).unlink(missing_ok=True)
