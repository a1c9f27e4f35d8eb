"""Dense initialisation: points from depth maps that a plane sweep computes from the photos."""

from snowsplat.training.dense_init.dense_points import dense_points, map_pixels

__all__ = ["dense_points", "map_pixels"]
