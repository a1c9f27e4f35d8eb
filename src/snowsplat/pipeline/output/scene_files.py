"""Reads and writes scene files of every format, including the HTML page of the web viewer.

Importing this module registers the HTML page as a format. It does not import torch.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.formats import (
    FORMATS,
    Format,
    GaussianArrays,
    format_for_reading,
    format_for_writing,
    read_arrays,
    read_gaussians,
    register_format,
    write_gaussians,
)
from snowsplat.formats.lod import lod_bytes, read_index
from snowsplat.formats.lod_writer import write_lod
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.util.messages import message
from snowsplat.util.stages import Outcome

if TYPE_CHECKING:
    from snowsplat.scene.gaussians import Gaussians

__all__ = [
    "FORMATS",
    "GaussianArrays",
    "format_for_reading",
    "format_for_writing",
    "read_arrays",
    "read_gaussians",
    "write_gaussians",
    "write_levels",
]


def _write_html(path: Path, gaussians: GaussianArrays) -> None:
    from snowsplat.viewer.web.publication import write_html
    from snowsplat.viewer.web.scene import ready

    write_html(path, ready(gaussians.to_gaussians(), ()))


register_format(
    Format(
        "HTML",
        (".html",),
        None,
        None,
        _write_html,
        message("the same as in SOG"),
        True,
        instead="use the scene file that the page was made from",
    )
)


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
