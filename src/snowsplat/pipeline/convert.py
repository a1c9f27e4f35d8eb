"""Scene files of every format, the HTML page included."""

import snowsplat.viewer.web.html  # noqa: F401 (registers the format)
from snowsplat.formats import format_for_writing, read_gaussians, write_gaussians

__all__ = ["format_for_writing", "read_gaussians", "write_gaussians"]
