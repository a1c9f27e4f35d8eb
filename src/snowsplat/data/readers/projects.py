"""`advice`: what to do with the files of programs that are not readable here."""

from __future__ import annotations

from pathlib import Path

from snowsplat.data.readers.pose_matrices import without_camera
from snowsplat.util.messages import Message

_METASHAPE = "export the cameras: File > Export > Export Cameras, as XML"
_REALITYSCAN = "export the alignment as Internal/External camera parameters (CSV), or as COLMAP"
_MESHROOM = "add the node ConvertSfMFormat, with the format sfm, after StructureFromMotion"
# The ending of a file name: what it is, and what to do.
_PROJECTS = {
    ".psx": ("a project of Metashape", _METASHAPE),
    ".psz": ("a project of Metashape", _METASHAPE),
    ".rcproj": ("a project of RealityCapture", _REALITYSCAN),
    ".rsproj": ("a project of RealityScan", _REALITYSCAN),
    ".mg": ("a project of Meshroom", _MESHROOM),
    ".abc": ("an Alembic file, as Meshroom writes it", _MESHROOM),
    "sfm_data.bin": (
        "a binary file of OpenMVG",
        "convert it: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json",
    ),
    ".p4d": ("a project of Pix4D", "export an undistorted COLMAP model"),
    ".r3d": ("a packed recording of Record3D", "unpack it as a zip archive"),
    ".nvm": ("a file of VisualSFM", "export bundle.out and list.txt"),
}


def advice(folder: Path) -> str | Message | None:
    """What the first such file in a folder is and what to do, as the end of a message; or None."""
    try:
        names = sorted(path.name for path in folder.iterdir())
    except OSError:
        return None
    for ending, (kind, action) in _PROJECTS.items():
        for name in names:
            if name.lower().endswith(ending):
                return f"{name} is {kind}; {action}"
    return without_camera(folder)
