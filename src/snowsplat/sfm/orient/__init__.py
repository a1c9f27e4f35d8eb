"""Orientation, origin and scale of the scene: what SfM leaves open, from all that is known.

SfM determines the scene only up to a similarity transform. A viewer also needs the up direction, a
known scale, and the photographed object at the origin.

    scene_frame    the frame of the scene, from the parts below
    up             the up direction, from sensors, the way people hold cameras, and the ground
    positions      scale, north and level from GPS positions
    cameras        the data of the model

What was found is recorded in sfm.json; see `snowsplat.data.frame.placement`.
"""

from snowsplat.sfm.orient.scene_frame import Oriented, orientation

__all__ = ["Oriented", "orientation"]
