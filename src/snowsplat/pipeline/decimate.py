"""How many Gaussians `convert` keeps: a number, a share, or as many as fit into a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.simplify import simplify
from snowsplat.util.errors import SettingError
from snowsplat.util.files import atomic_path

_UNITS = {"kb": 1000, "mb": 1000**2, "gb": 1000**3}


def gaussians_to_keep(decimate: int | str, count: int) -> int:
    """How many of ``count`` Gaussians ``decimate`` keeps.

    Args:
        decimate: a number such as 5000 or "5000", or a percentage such as "50%".

    Raises:
        SettingError: ``decimate`` is neither.
    """
    text = str(decimate)
    if re.fullmatch(r"\d+", text):
        return int(text)
    match = re.fullmatch(r"(\d+(?:\.\d+)?)%", text)
    if not match or float(match[1]) > 100:
        raise SettingError(
            "decimate", f"{text!r} is not valid; use a number, 0% to 100%, or a size such as 10MB"
        )
    return round(count * float(match[1]) / 100)


def file_size(decimate: int | str | None) -> int | None:
    """The bytes that a size such as "10MB", "0.5 GB" or "800KB" stands for; None: not a size."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kmg]b)", str(decimate).lower())
    return round(float(match[1]) * _UNITS[match[2]]) if match else None


def write_within(
    size: int,
    target: Path,
    scene: Gaussians,
    write: Callable[[Path, Gaussians], None],
    refined: Callable[[Gaussians], Gaussians] | None = None,
    cameras: Sequence[Camera] = (),
) -> None:
    """Write ``scene`` with so many Gaussians that the file ``target`` has at most ``size`` bytes.

    Args:
        write: writes a scene to a path.
        refined: improves a scene before it is written; may change its size a little.
        cameras: those of the photos, see `simplify`.

    Raises:
        SettingError: even one Gaussian needs more.
    """
    count = len(scene)
    with atomic_path(target) as temporary:
        # The suffix selects the format.
        path = temporary.with_name(temporary.name + target.name)
        try:
            for improve in [None, refined] if refined else [None]:
                while count:
                    smaller = simplify(scene, count, cameras)
                    write(path, improve(smaller) if improve else smaller)
                    actual = path.stat().st_size
                    if actual <= size:
                        break
                    count = int(count * min(0.98, size / actual))
            if not count:
                raise SettingError("decimate", f"no scene fits into {size:,} bytes; use more")
            path.replace(temporary)
        finally:
            path.unlink(missing_ok=True)
