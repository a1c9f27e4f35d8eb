"""COLMAP: a sparse model (`read_model`, `write_model`) and a dataset folder (`read_colmap`)."""

from snowsplat.data.colmap.model import count_images, read_model, read_points, write_model
from snowsplat.data.colmap.reader import find_models, posed_camera, read_colmap
from snowsplat.data.colmap.types import ColmapCamera, ColmapImage, ColmapModel

__all__ = [
    "ColmapCamera",
    "ColmapImage",
    "ColmapModel",
    "count_images",
    "find_models",
    "posed_camera",
    "read_colmap",
    "read_model",
    "read_points",
    "write_model",
]
