"""Scene files of every format, the HTML page included."""

from snowsplat.pipeline.scene_files import format_for_writing, read_gaussians, write_gaussians

__all__ = ["format_for_writing", "read_gaussians", "write_gaussians"]
