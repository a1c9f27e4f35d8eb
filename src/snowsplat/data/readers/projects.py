"""`advice`: what to do with the files of programs that are not readable here."""

from pathlib import Path

from snowsplat.data.colmap.places import folders_below
from snowsplat.data.readers.pose_matrices import without_camera
from snowsplat.util.messages import Message
from snowsplat.util.safe_json import read_json

#: How deep in a dataset such files, and exports, are searched: kapture/mapping/sensors,
#: MeshroomCache/StructureFromMotion/UID.
DEEPEST = 3


def advice(path: Path) -> str | Message | None:
    """What a file, or the first such file in a folder or below, is and what to do, as the end of a
    message; or None."""
    # The ending of a file name: what it is, and what to do.
    projects: dict[str, tuple[str, str]] = read_json(Path(__file__).with_suffix(".json"))
    folders = [path] if path.is_file() else list(folders_below(path, DEEPEST))
    for folder in folders:
        try:
            names = [path.name] if path.is_file() else sorted(p.name for p in folder.iterdir())
        except OSError:
            continue
        for ending, (kind, action) in projects.items():
            for name in names:
                here = f"{folder.name}/{name}".lower().endswith(ending)
                if here and "images.bin" not in names:  # a whole COLMAP model
                    name = (folder / name).relative_to(path).as_posix() if path.is_dir() else name
                    return f"{name} is {kind}; {action}"
        if (unread := without_camera(folder)) is not None:
            return unread
    return None
