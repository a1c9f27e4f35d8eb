"""`Project.open`: which scene, training, dataset, edits and title belong to a folder or a file.

The folder of `make` has:

    OUT/NAME.ply            the scene
    OUT/NAME_edited.ply     the scene as it was edited in its page; NAME_edited.json says how
    OUT/make.json           the inputs, the title, the file of the scene, and the finished stages
    OUT/dataset/            see `DatasetFolder`; none if the input is a dataset
    OUT/scene/              see `TrainingFolder`
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from snowsplat.formats.lod import INDEX
from snowsplat.formats.sog import META, is_sog
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.edit_record import EditRecord, read_record
from snowsplat.project.left_out import LeftOut
from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.training_folder import DATASET, SCENE, TrainingFolder
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.ply import open_table
from snowsplat.util.safe_json import read_json

#: The record of `make` in its folder. "title": the name of the scene for people; "file": its file;
#: "last_part": the scene has seen the held-out photos, too.
MAKE_RECORD = "make.json"
_HEAD_BYTES = 16_384
_SUFFIXES = (".ply", ".sog", ".spz", ".splat", ".ksplat", ".glb")
_STEP = re.compile(r"_(\d+)")  # in the names of files of gsplat


@dataclass(frozen=True)
class Project:
    """What belongs to a folder, or to a scene file.

    Attributes:
        path: the folder or file that was opened; it need not exist.
        scene: the file of the scene: ``path`` itself; or the chosen one in the folder; None if
            there is none. In a folder, this is that of its levels of detail or of its SOG, the
            scene of `make`, else the last scene of the training.
        training: of the scene. Of a folder, also a training that has no scene so far; None for a
            file whose training is not known, and for an edited scene, whose world may be another
            one (see ``original``).
        edit: how the scene was made from another one, if it was edited in a page.
        made: the record of `make`; empty if it has not made the folder.
    """

    path: Path
    scene: Path | None
    training: TrainingFolder | None
    edit: EditRecord | None
    made: dict[str, Any]

    @classmethod
    def open(cls, path: Path | str, iteration: int | None = None) -> Project:
        """Read a folder or a file; what does not exist is a project without a scene.

        ``iteration``: choose this scene of a training.
        Raises: UserError: ``iteration`` is given for a file, or there is no such scene.
        """
        path = Path(path)
        file = path if path.is_file() else _index_in(path)
        if file is not None:
            if iteration is not None:
                raise UserError("`iteration` selects a scene of an output folder; leave it out")
            edit = read_record(file)
            made = _read_make_record(file.resolve().parent)
            training = None if edit else _training_of(file.resolve(), made)
            return cls(path, file, training, edit, made)
        made = _read_make_record(path)
        training = _training_in(path)
        scene = _scene_of_make(path, made) if iteration is None else None
        if scene is None and (iteration is not None or training.scenes()):
            scene = training.find_scene(iteration)[1]
        return cls(path, scene, training, None, made)

    @property
    def is_file(self) -> bool:
        """Whether this is a scene file, or a folder that is one, as of levels of detail or SOG."""
        return self.scene is not None and (self.scene == self.path or self.training is None)

    def scene_file(self) -> Path:
        """The file of the scene. Raises: UserError: there is none."""
        if self.scene is not None:
            return self.scene
        if self.training is not None and self.path.is_dir():
            self.training.find_scene()  # it says what the folder has
        raise UserError("{path}: no such file or folder", path=self.path)

    def training_folder(self) -> TrainingFolder:
        """The training, of a folder. Raises: UserError: a file, or no such folder."""
        if self.training is None or not self.path.is_dir():
            what = message("is a file") if self.path.is_file() else message("no such folder")
            raise UserError(
                "{path}: {what}; give the output folder of a training run",
                path=self.path,
                what=what,
            )
        return self.training

    @cached_property
    def original(self) -> Project:
        """That of the scene that was edited; this one if it was not edited."""
        if self.edit is None or self.scene is None:
            return self
        return Project.open(self.scene.with_name(Path(self.edit.scene).name))

    @property
    def name(self) -> str:
        """The name of the scene for people: the title that `make` or the editor has recorded; else
        the name of the folder, or of the file without suffixes."""
        if self.edit is not None:
            return self.edit.title or self.original.name
        path = self.path.resolve()
        title = _read_make_record(self.home).get("title") if path.is_dir() else None
        if isinstance(title, str) and title:
            return title
        return path.name.split(".")[0] or path.name

    @property
    def home(self) -> Path:
        """The folder of `make` around its training; else ``path``."""
        inside = self.path.name == SCENE and (self.path.parent / MAKE_RECORD).is_file()
        return self.path.parent if inside else self.path

    @property
    def dataset(self) -> DatasetFolder:
        """The dataset: this folder if `sfm` made it, else that of `make`. It need not exist."""
        own = DatasetFolder(self.path)
        return own if own.record.is_file() else DatasetFolder(self.home / DATASET)

    @property
    def left_out(self) -> list[LeftOut]:
        """The photos that are not used, in the order of the stages."""
        return [*self.dataset.left_out(), *(self.training.left_out() if self.training else [])]

    @property
    def verdict(self) -> Any:
        """The JSON value of the `Verdict` on the scene of `make`, as its record has it, or None."""
        try:
            return self.made["stages"]["scene"]["result"]["verdict"]
        except (KeyError, TypeError):
            return None

    @property
    def has_seen_all_photos(self) -> bool:
        """Whether the scene is that of `make` after its last part: no photo can judge it."""
        if self.scene is None or self.edit is not None:
            return False
        is_made = self.scene.resolve() == _scene_of_make(self.scene.resolve().parent, self.made)
        return is_made and self.made.get("last_part") is True


def scene_at(path: Path) -> Path | None:
    """The scene file that ``path`` is, or that a folder has or consists of; or None.

    A zip file is none: most have photos.
    """
    file = Project.open(path).scene
    usable = file is not None and file.suffix.lower() != ".zip"
    return file if usable and (path.is_dir() or _is_scene(path)) else None


def is_output(folder: Path) -> bool:
    """Whether a folder is a dataset or an output folder that snowsplat has written."""
    records = folder / MAKE_RECORD, DatasetFolder(folder).record, TrainingFolder(folder).cfg_args
    return any(record.is_file() for record in records)


def _training_in(path: Path) -> TrainingFolder:
    """The training in a folder: ``path`` itself or, if `make` created it, a folder in it."""
    folder, made = TrainingFolder(path), TrainingFolder(path / SCENE)
    if folder.is_training() or folder.scenes():
        return folder
    return made if made.is_training() or made.scenes() else folder


def _training_of(scene: Path, made: dict[str, Any]) -> TrainingFolder | None:
    """The training that wrote a scene file: its place tells, or the record of `make`."""
    trained = TrainingFolder(scene.parent.parent.parent)
    if scene in map(trained.scene_path, trained.scenes()):
        return trained
    is_made = scene == _scene_of_make(scene.parent, made)
    return TrainingFolder(scene.parent / SCENE) if is_made else None


def _scene_of_make(folder: Path, made: dict[str, Any]) -> Path | None:
    """The scene in a folder of `make`, as its record names it; None if there is none."""
    name = made.get("file")
    file = folder / Path(name).name if isinstance(name, str) and name else None
    return file if file is not None and file.is_file() else None


def _read_make_record(folder: Path) -> dict[str, Any]:
    """The record of `make`; empty if there is none, or it is damaged."""
    try:
        return dict(read_json(folder / MAKE_RECORD))
    except (OSError, ValueError, TypeError):
        return {}


def _index_in(folder: Path) -> Path | None:
    """The file that describes the scene of which ``folder`` consists: `lod-meta.json`, the
    `meta.json` of SOG, what a published site shows, the newest scene of a training of gsplat, or
    its only scene file; None if there is none."""
    if content := SiteFolder(folder).content():
        return content
    if (folder / INDEX).is_file():
        return folder / INDEX
    sog = folder / META
    if sog.is_file():
        with open(sog, "rb") as file:
            if is_sog(file.read(_HEAD_BYTES)):
                return sog
    others = ("point_cloud", "sparse", "transforms.json", "cfg_args", "checkpoints", SCENE)
    if any((folder / name).exists() for name in (*others, MAKE_RECORD)) or not folder.is_dir():
        return None  # a training, or a dataset
    theirs = [*folder.glob("ply/point_cloud_*.ply"), *folder.glob("ckpts/ckpt_*_rank0.pt")]
    steps = {path: int(match[1]) for path in theirs if (match := _STEP.search(path.name))}
    if steps:
        return max(steps, key=steps.__getitem__)
    files = [path for path in folder.iterdir() if path.is_file()]
    scenes = [path for path in files if path.suffix.lower() in _SUFFIXES and _is_scene(path)]
    photos = sum(path.suffix.lower() in (".jpg", ".jpeg", ".png") for path in files)
    return scenes[0] if len(scenes) == 1 and photos < 2 else None


def _is_scene(path: Path) -> bool:
    """Whether a file has Gaussians; a PLY file may have points."""
    from snowsplat.formats.ply import is_scene
    from snowsplat.formats.registry import format_for_reading

    try:
        format = format_for_reading(path)
        return format.read is not None and (format.name != "PLY" or is_scene(open_table(path)))
    except UserError:
        return False
