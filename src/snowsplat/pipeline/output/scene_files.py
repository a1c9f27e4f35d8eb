"""Reads and writes scene files of every format, including the HTML page of the web viewer.

Importing this module registers the HTML page as a format. It does not import torch.
"""

from __future__ import annotations

from pathlib import Path

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

__all__ = [
    "FORMATS",
    "GaussianArrays",
    "format_for_reading",
    "format_for_writing",
    "read_arrays",
    "read_gaussians",
    "write_gaussians",
]


def _write_html(path: Path, gaussians: GaussianArrays) -> None:
    from snowsplat.viewer.web.html import write_html
    from snowsplat.viewer.web.scene import ready

    write_html(path, ready(gaussians.to_gaussians(), ()))


register_format(
    Format(
        "HTML",
        (".html",),
        None,
        None,
        _write_html,
        "the same as in SOG",
        True,
        instead="use the scene file that the page was made from",
    )
)
