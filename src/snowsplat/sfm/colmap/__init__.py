"""Structure from motion: estimates camera poses, lens parameters and scene points from photos.

process/     starts the process in which COLMAP runs, and which does not import torch
reconstruct  makes the attempts there, from features to checks
features/    detects features
pairs/       chooses pairs of photos and matches them
lenses/      chooses camera models
mapping/     makes models of poses and points
checks/      finds wrong poses, and explains what is missing
"""

from snowsplat.util.errors import UserError
from snowsplat.util.interrupts import handle_again

try:
    from snowsplat.sfm.colmap.options import SfmResult
    from snowsplat.sfm.colmap.process.child import estimate_poses
    from snowsplat.sfm.colmap.result import describe_model
except ModuleNotFoundError as error:
    if error.name != "pycolmap":
        raise
    raise UserError(
        "pycolmap is not installed, and PyPI may have no package for this computer; build it "
        "from the sources of COLMAP 4.2, or make the dataset on another computer; train needs none"
    ) from None
handle_again()

__all__ = ["SfmResult", "describe_model", "estimate_poses"]
