"""Camera paths through a scene: lists with one camera per frame, at a constant speed."""

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
