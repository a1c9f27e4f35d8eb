"""Structure from motion: estimates camera poses, lens parameters and scene points from photos.

    child        starts the child process and handles its end
    worker       the child process, in which COLMAP runs
    reconstruct  repeated attempts, until enough photos have a pose
    pairs, retrieval   choose the pairs of photos to match
    sift, features       detect features in a photo, in all photos
    matching, pair_matching   match two sets of features; match all pairs, verify the matches
    mapping      estimates poses and points from the matches in the COLMAP `database`
    incremental, view_graph, subset   the order in which photos are registered
    consistency, repair   find photos in a wrong place after mapping, and make the model again
    diagnosis    explains why photos have no pose
    result, check_model   statistics of models; reading models from unknown sources

The child process does not import torch.
"""

from snowsplat.sfm.colmap.child import estimate_poses
from snowsplat.sfm.colmap.options import SfmOptions, SfmResult
from snowsplat.sfm.colmap.result import describe_model

__all__ = ["SfmOptions", "SfmResult", "describe_model", "estimate_poses"]
