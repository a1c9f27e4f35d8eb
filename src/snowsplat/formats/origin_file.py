"""The place of a scene beside a file whose format cannot store it: `NAME.spz.origin.json`.

The place is the `scene.origin`, and the true scale of `scene.length`.
"""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from snowsplat.scene.length import stored_metres
from snowsplat.scene.origin import HERE, Origin, stored_origin
from snowsplat.util.files import COMPLETE, write_json
from snowsplat.util.safe_json import is_file, parse_json

logger = logging.getLogger(__name__)

_MOST_BYTES = 1 << 16
_NEXT = "next"  # the place of the file that is about to replace the present one


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
        # The process that has written the scene was killed before it wrote its place.
        if _NEXT in values and values[_NEXT]["of"] == _facts(scene.stat()):
            values = values[_NEXT]
        origin = stored_origin(values["origin"]) if "origin" in values else HERE
        metres = stored_metres(values.get("metres_per_unit"))
        if origin is None or ("metres_per_unit" in values and metres is None):
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError):
        logger.warning("%s: damaged; the place of the scene is unknown", path)
        return Place()
    return Place(origin, metres)


@contextmanager
def written_with_place(scene: Path, place: Place) -> Iterator[None]:
    """Context in which `atomic_path` writes a scene file, which then has this place.

    A file that is replaced has its own place until then, also if the process is killed.

    Raises:
        OSError: the folder is not writable, or the disk is full.
    """
    COMPLETE[scene] = lambda about: announce_place(scene, place, about)
    try:
        yield
    finally:
        del COMPLETE[scene]
    write_place(scene, place)


def announce_place(scene: Path, place: Place, about: os.stat_result) -> None:
    """Store the place of the file with these facts, which is about to replace ``scene``."""
    before = read_place(scene)
    if before != Place() or place != Place():
        after = _values(place) | {"of": _facts(about)}
        write_json(origin_file(scene), _values(before) | {_NEXT: after})


def write_place(scene: Path, place: Place) -> None:
    """Store the place of a scene file, or remove the stored one if there is nothing to say.

    Raises:
        OSError: the folder is not writable, or the disk is full.
    """
    if values := _values(place):
        write_json(origin_file(scene), values)
    else:
        origin_file(scene).unlink(missing_ok=True)


def _values(place: Place) -> dict[str, Any]:
    origin = {"origin": list(place.origin)} if any(place.origin) else {}
    metres = {"metres_per_unit": place.metres_per_unit} if place.metres_per_unit else {}
    return origin | metres


def _facts(about: os.stat_result) -> list[int]:
    """By which a file is known: its size, and the time of its last change in nanoseconds."""
    return [about.st_size, about.st_mtime_ns]
