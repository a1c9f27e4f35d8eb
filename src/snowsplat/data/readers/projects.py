"""`advice`: what to do with the files of programs that are not readable here."""

from __future__ import annotations

from pathlib import Path

from snowsplat.data.colmap.places import folders_below
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
    ".mvs": ("a scene of OpenMVS", "convert it: InterfaceCOLMAP -i scene.mvs -o model"),
    "calibrated_camera_parameters.txt": ("a file of Pix4D", "export an undistorted COLMAP model"),
    "sensors/trajectories.txt": ("a file of kapture", "convert it: kapture_export_colmap.py"),
    "cameras.bin": ("a part of a COLMAP model", "put its images.bin and points3D.bin beside it"),
}
#: How deep in a dataset such files, and exports, are searched: kapture/mapping/sensors,
#: MeshroomCache/StructureFromMotion/UID.
DEEPEST = 3


def advice(path: Path) -> str | Message | None:
    """What a file, or the first such file in a folder or below, is and what to do, as the end of a
    message; or None."""
    folders = [path] if path.is_file() else list(folders_below(path, DEEPEST))
    for folder in folders:
        try:
            names = [path.name] if path.is_file() else sorted(p.name for p in folder.iterdir())
        except OSError:
            continue
        for ending, (kind, action) in _PROJECTS.items():
            for name in names:
                here = f"{folder.name}/{name}".lower().endswith(ending)
                if here and "images.bin" not in names:  # a whole COLMAP model
                    name = (folder / name).relative_to(path).as_posix() if path.is_dir() else name
                    return f"{name} is {kind}; {action}"
        if (unread := without_camera(folder)) is not None:
            return unread
    return None
