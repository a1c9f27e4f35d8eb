"""Structure from motion: photos -> where each was taken, the cameras' lenses, points of the scene.

child        runs the rest in a process of its own and tells how that ended
worker       that process
reconstruct  the tries, one after another, until enough photos are placed
features, pairs, retrieval, mapping   the steps of a try, on COLMAP's `database`
diagnosis    why a photo, or none, could be placed
"""

from snowsplat.sfm.colmap.child import estimate_poses
from snowsplat.sfm.colmap.options import SfmOptions, SfmResult
from snowsplat.sfm.colmap.result import describe_model

__all__ = ["SfmOptions", "SfmResult", "describe_model", "estimate_poses"]
