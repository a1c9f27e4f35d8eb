"""Finds the file of a scene, and the output folder of its training.

`snowsplat info` uses this module, so it does not import torch.
"""

from __future__ import annotations

import filecmp
from pathlib import Path

from snowsplat.formats.lod import INDEX
from snowsplat.pipeline.output.output_folder import SCENE, OutputFolder
from snowsplat.util.errors import UserError


def existing_folder(path: Path) -> OutputFolder:
    """The same as `training_folder`. Raises: UserError: ``path`` is not a folder."""
    if not path.is_dir():
        raise UserError(f"{path}: no such folder; give the output folder of a training run")
    return training_folder(path)


def training_folder(path: Path) -> OutputFolder:
    """The output folder of training: ``path`` or, if `make` created ``path``, a folder in it."""
    folder, made = OutputFolder(path), OutputFolder(path / SCENE)
    return made if made.scenes() and not folder.scenes() else folder


def scene_file(path: Path) -> Path:
    """``path`` itself if it is a file, or the scene in the folder ``path``.

    That is its levels of detail if it has a `lod-meta.json`, else the last scene of the training.

    Raises:
        UserError: a folder without a scene.
    """
    if not path.is_dir():
        return path
    if (path / INDEX).is_file():
        return path / INDEX
    folder = training_folder(path)
    scenes = folder.scenes()
    if not scenes:
        raise UserError(f"{path}: contains no scene (no point_cloud/iteration_N in it)")
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
    if any(filecmp.cmp(scene, made.scene_path(i), shallow=False) for i in made.scenes()[-1:]):
        return made
    return OutputFolder(scene)


def scene_name(scene: Path) -> str:
    """The name of a scene: the name of its folder, or of its file without suffixes."""
    scene = scene.resolve()
    return scene.name.split(".")[0] or scene.name
