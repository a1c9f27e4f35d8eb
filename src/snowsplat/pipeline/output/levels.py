"""Levels of detail: when a scene is shown with them, and writing them with progress."""

from __future__ import annotations

import time
from pathlib import Path

from snowsplat.formats import GaussianArrays
from snowsplat.formats.lod import lod_bytes, read_index
from snowsplat.formats.lod_writer import write_lod
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.stages import Outcome


def write_levels(path: Path, gaussians: Gaussians, observer: Observer = SILENT) -> None:
    """Write FOLDER/lod-meta.json; the observer gets the stage "levels".

    Raises:
        UserError: ``path`` has another name.
        OSError: a file cannot be written.
    """
    start = time.monotonic()
    report = observer.begin("levels")
    write_lod(path, GaussianArrays.from_gaussians(gaussians), report=report)
    result = {"gaussians": read_index(path).counts(), "bytes": lod_bytes(path)}
    observer.end("levels", Outcome(result, time.monotonic() - start, again=False))
