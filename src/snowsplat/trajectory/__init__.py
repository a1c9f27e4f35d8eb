"""Ways of a camera through a scene: lists of cameras, one a frame, moving evenly."""

from snowsplat.trajectory.focus import resized, viewing_distance
from snowsplat.trajectory.follow import key_path, training_path
from snowsplat.trajectory.orbit import ellipse_path, orbit_path, spiral_path

__all__ = [
    "ellipse_path",
    "key_path",
    "orbit_path",
    "resized",
    "spiral_path",
    "training_path",
    "viewing_distance",
]
