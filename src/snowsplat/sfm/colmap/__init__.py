"""Structure from motion: estimates camera poses, lens parameters and scene points from photos.

`child` starts the process `worker`, in which COLMAP runs and which does not import torch.
`reconstruct` makes the attempts there, from `features` to `repair`.
"""

from snowsplat.sfm.colmap.child import estimate_poses
from snowsplat.sfm.colmap.options import SfmOptions, SfmResult
from snowsplat.sfm.colmap.result import describe_model

__all__ = ["SfmOptions", "SfmResult", "describe_model", "estimate_poses"]
