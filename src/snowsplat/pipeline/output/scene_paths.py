"""Finds the file of a scene, and the output folder of its training.

`snowsplat info` uses this module, so it does not import torch.
"""

from __future__ import annotations

import filecmp
import re
from pathlib import Path

from snowsplat.formats.lod import INDEX
from snowsplat.formats.sog import META, is_sog
from snowsplat.pipeline.output.edit_record import read_record
from snowsplat.pipeline.output.output_folder import SCENE, OutputFolder
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import read_json

#: The record of `make` in its folder. "title": the name of the scene for people; "file": its file.
RECORD = "make.json"
_HEAD_BYTES = 16_384
_STEP = re.compile(r"_(\d+)")  # in the names of files of gsplat


def existing_folder(path: Path) -> OutputFolder:
    """The same as `training_folder`. Raises: UserError: ``path`` is not a folder."""
    if not path.is_dir():
        what = "is a file" if path.is_file() else "no such folder"
        raise UserError(
            "{path}: {what}; give the output folder of a training run", path=path, what=what
        )
    return training_folder(path)


def training_folder(path: Path) -> OutputFolder:
    """The output folder of training: ``path`` or, if `make` created ``path``, a folder in it."""
    folder, made = OutputFolder(path), OutputFolder(path / SCENE)
    return made if made.scenes() and not folder.scenes() else folder


def index_in(folder: Path) -> Path | None:
    """The file that describes the scene of which ``folder`` consists: `lod-meta.json`, the
    `meta.json` of SOG, or the newest scene of a training of gsplat; None if there is none."""
    if (folder / INDEX).is_file():
        return folder / INDEX
    sog = folder / META
    if sog.is_file():
        with open(sog, "rb") as file:
            if is_sog(file.read(_HEAD_BYTES)):
                return sog
    if any((folder / name).exists() for name in ("point_cloud", "sparse", "transforms.json")):
        return None  # a training of other programs, or a dataset
    theirs = [*folder.glob("ply/point_cloud_*.ply"), *folder.glob("ckpts/ckpt_*_rank0.pt")]
    steps = {path: int(match[1]) for path in theirs if (match := _STEP.search(path.name))}
    return max(steps, key=steps.__getitem__, default=None)


def scene_file(path: Path) -> Path:
    """``path`` itself if it is a file, or the scene in the folder ``path``.

    That is its levels of detail if it has a `lod-meta.json`, its SOG scene if it has a `meta.json`,
    the scene of `make`, else the last scene of the training.
    Raises: UserError: a folder without a scene.
    """
    if not path.is_dir():
        return path
    if index := index_in(path):
        return index
    if made := file_of_make(path):
        return made
    folder = training_folder(path)
    scenes = folder.scenes()
    if not scenes:
        raise folder.without_scene()
    return folder.scene_path(scenes[-1])


def folder_around(scene: Path) -> OutputFolder:
    """The output folder of the training run that wrote a scene file.

    This is OUT for the file OUT/point_cloud/iteration_N/point_cloud.ply, and OUT/scene for the file
    OUT/NAME.ply, the copy that `make` writes. For other files, it is an `OutputFolder` without
    scenes.
    """
    scene = scene.resolve()
    made, trained = OutputFolder(scene.parent / SCENE), OutputFolder(scene.parent.parent.parent)
    if scene in map(trained.scene_path, trained.scenes()):
        return trained
    if scene == file_of_make(scene.parent):
        return made
    if any(filecmp.cmp(scene, made.scene_path(i), shallow=False) for i in made.scenes()[-1:]):
        return made
    return OutputFolder(scene)


def file_of_make(folder: Path) -> Path | None:
    """The scene in a folder of `make`, with its last part; None if there is none."""
    name = _recorded(folder / RECORD, "file")
    file = folder / Path(name).name if name else None
    return file if file is not None and file.is_file() else None


def has_seen_all_photos(scene: Path) -> bool:
    """Whether a scene file is that of `make` after its last part: no photo can judge it."""
    made = OutputFolder(scene.parent / SCENE)
    return scene == file_of_make(scene.parent) and not any(
        filecmp.cmp(scene, made.scene_path(i), shallow=False) for i in made.scenes()[-1:]
    )


def folder_of_make(path: Path) -> Path:
    """The folder of `make` around ``path``, which is its scene or the output folder of its
    training; ``path`` itself if there is none."""
    return path.parent if path.name == SCENE and (path.parent / RECORD).is_file() else path


def scene_name(scene: Path) -> str:
    """The name of a scene: the title that `make` or the editor has recorded; else the name of the
    folder, or of the file without suffixes."""
    scene = scene.resolve()
    record = read_record(scene)
    if record is not None:
        return record.title or scene_name(scene.with_name(record.scene))
    title = _recorded(folder_of_make(scene) / RECORD, "title")
    return title or scene.name.split(".")[0] or scene.name


def _recorded(record: Path, key: str) -> str | None:
    try:
        value = read_json(record).get(key) if record.is_file() else None
    except (OSError, ValueError, AttributeError):
        return None
    return value if isinstance(value, str) else None
