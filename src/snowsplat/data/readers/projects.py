"""`advice`: what to do with the files of programs that are not readable here."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

from snowsplat.data.readers.parse import head_of
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import quoted

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


# Text that begins with numbers, after comments.
_NUMBERS = rb"(?:#[^\n]*\n)*\s*(?:[-+.\deE]+\s+){3}"
# Files of poses: where they are in a folder, how they begin, and who writes such ones.
_POSES = (
    ("pose/*.txt", _NUMBERS, "ScanNet and NSVF"),
    ("cams/*_cam.txt", rb"extrinsic", "MVSNet"),
    ("cameras*.npz", rb"PK", "IDR and NeuS"),
    ("groundtruth.txt", _NUMBERS, "TUM"),
    ("traj*.txt", _NUMBERS, "Replica and other SLAM datasets"),
    ("poses.txt", _NUMBERS, "KITTI"),
    ("*.log", _NUMBERS, "Tanks and Temples"),
    ("*.xmp", rb"(?s).*capturingreality", "RealityCapture"),
    ("*.json", rb'(?s).*"cameraPoseARFrame"', "3d Scanner App"),
)
_TRIED = 3  # files of a pattern that are opened


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
    for pattern, start, program in _POSES:
        for path in islice(folder.glob(pattern), _TRIED):
            if re.match(start, head_of(path)):
                return message(
                    "{file} has camera poses in the layout of {program}, which are not read; to "
                    "use them, export a COLMAP model",
                    file=quoted(path.relative_to(folder).as_posix()),
                    program=program,
                )
    return None
