"""COLMAP: a sparse model (`read_model`, `write_model`) and a dataset folder (`read_colmap`)."""

from snowsplat.data.colmap.model import count_images, read_model, read_points, write_model
from snowsplat.data.colmap.places import find_models, find_models_below
from snowsplat.data.colmap.reader import posed_camera, read_colmap
from snowsplat.data.colmap.types import ColmapImage, ColmapModel

__all__ = [
    "ColmapImage",
    "ColmapModel",
    "count_images",
    "find_models",
    "find_models_below",
    "posed_camera",
    "read_colmap",
    "read_model",
    "read_points",
    "write_model",
]
