"""Structure from motion: estimates camera poses, lens parameters and scene points from photos.

child        starts the child process and handles its end
worker       the child process, in which COLMAP runs
reconstruct  repeated attempts, until enough photos have a pose
features, pairs, retrieval, mapping   the steps of an attempt, on the COLMAP `database`
consistency, repair   find photos in a wrong place after mapping, and place them again
diagnosis    explains why photos have no pose
"""

from snowsplat.sfm.colmap.child import estimate_poses
from snowsplat.sfm.colmap.options import SfmOptions, SfmResult
from snowsplat.sfm.colmap.result import describe_model

__all__ = ["SfmOptions", "SfmResult", "describe_model", "estimate_poses"]
