"""Files of COLMAP: sparse models, which are read, written and searched."""

from snowsplat.data.colmap.model import (
    count_images,
    posed_camera,
    read_model,
    read_points,
    write_model,
)
from snowsplat.data.colmap.places import find_models, find_models_below
from snowsplat.data.colmap.types import ColmapImage, ColmapModel

__all__ = [
    "ColmapImage",
    "ColmapModel",
    "count_images",
    "find_models",
    "find_models_below",
    "posed_camera",
    "read_model",
    "read_points",
    "write_model",
]
