"""Orientation, origin and scale of the scene: what SfM leaves open, from all that is known.

SfM determines the scene only up to a similarity transform. A viewer also needs the up direction, a
known scale, and the photographed object at the origin.

    scene_frame    the frame of the scene                          placement   its record, its words
    up             up: sensors, the way cameras are held, ground   ground      the largest plane
    positions      scale, north and level from GPS positions       cameras     data of the model
"""

from snowsplat.sfm.orient.placement import PLACEMENT, Placement, placement_of
from snowsplat.sfm.orient.scene_frame import Oriented, orientation

__all__ = ["PLACEMENT", "Oriented", "Placement", "orientation", "placement_of"]
