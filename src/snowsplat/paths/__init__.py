"""Ways of a camera through a scene: lists of cameras, one a frame, moving evenly."""

from snowsplat.paths.around import ellipse_path, orbit_path, spiral_path
from snowsplat.paths.sight import resized, viewing_distance
from snowsplat.paths.through import key_path, training_path

__all__ = [
    "ellipse_path",
    "key_path",
    "orbit_path",
    "resized",
    "spiral_path",
    "training_path",
    "viewing_distance",
]
