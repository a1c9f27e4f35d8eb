"""`OutputFolder`: the files of a training run, in the layout of the reference implementation.

    OUT/cfg_args                                   settings, in the format of that implementation
    OUT/cameras.json                               all cameras, refined if the training did so
    OUT/input.ply                                  the points that the training started from
    OUT/point_cloud/iteration_N/point_cloud.ply    the scene after N steps
    OUT/config.json                                *all settings
    OUT/checkpoints/step_N.safetensors             *see snowsplat.training.core.checkpoint
    OUT/metrics.json                               metrics of the last evaluation
    OUT/history.json                               *the curves of the training
    OUT/report.html                                *a page about the training
    OUT/masks/NAME.png                             *masks of what moves, if something moves
    OUT/test/ours_N/renders, gt                    rendered images and photos; also train/
    OUT/refined/sparse/0                           *a COLMAP model with refined cameras
    OUT/videos/                                    *rendered videos (films/ in earlier versions)

The reference implementation does not write the entries marked *. Its folders are read too.
`snowsplat info` and the flags of `train` use this module: torch is imported in the methods that
need it.
"""

from __future__ import annotations

import argparse
import ast
import logging
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat._version import __version__
from snowsplat.formats.origin_file import Place, origin_file, read_place, write_place
from snowsplat.scene.origin import Origin
from snowsplat.util.errors import UserError
from snowsplat.util.files import (
    atomic_path,
    is_temporary,
    remove_temporaries,
    write_json,
    write_text,
)
from snowsplat.util.run_lock import LOCK
from snowsplat.util.safe_json import from_json, read_json

if TYPE_CHECKING:
    from PIL import Image

    from snowsplat.data import Dataset, DatasetFiles, View
    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.scene.gaussians import Gaussians
    from snowsplat.training.settings.config import TrainConfig

logger = logging.getLogger(__name__)

#: Folders inside the folder of `make`: the dataset, and the output folder of its training.
DATASET, SCENE = "dataset", "scene"
#: The name of a dataset in version 0.1.0: of its folder, and of its key in JSON files.
FORMER_DATASET = "capture"
# _WORD: a string, a name, a number, or a single character. _LITERAL: a literal whose value is used.
# An expression that matches spaces would take quadratic time for a file with a million of them.
_WORD = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[\w.+-]+|\S""", re.DOTALL)
_LITERAL = re.compile(r"""['"].*['"]|True|False|None|-?[\d.]+(?:e[+-]?\d+)?""", re.DOTALL)
_NAMESPACE_LIMIT = 1 << 20  # characters
# So many words of an argument of Namespace are kept: NAME = VALUE, and one more if it is longer.
_STORED_WORDS = 4
_SCENE = re.compile(r"iteration_(\d+)")
_TENSORBOARD = "tensorboard"
_RESULTS = (
    "point_cloud",
    "checkpoints",
    "refined",
    "train",
    "test",
    "videos",
    "films",
    "masks",
    _TENSORBOARD,
)
_REPORTS = ("metrics.json", "exposure.json", "history.json", "report.html", "log.csv")
_CAMERAS = "cameras.json"
_FILES = (
    "cfg_args",
    "config.json",
    _CAMERAS,
    origin_file(Path(_CAMERAS)).name,
    "input.ply",
    *_REPORTS,
)


@dataclass(frozen=True)
class DatasetSettings:
    """How the dataset of a training run is read: the arguments of `load_dataset`."""

    path: str
    images: str = "images"
    resolution: int = -1
    hold_out: int | None = None
    first_held_out: int = 0
    test_list: str | None = None

    def load(self) -> Dataset:
        """Read the dataset. Raises: UserError: see `snowsplat.data.load_dataset`."""
        return self.read_files().dataset(self.resolution)

    def read_files(self) -> DatasetFiles:
        """Read the files of the dataset, to load it at several resolutions; see `load`."""
        from snowsplat.data import read_files

        return read_files(
            self.path,
            images=self.images,
            resolution=self.resolution,
            hold_out=self.hold_out,
            first_held_out=self.first_held_out,
            test_list=self.test_list,
        )


@dataclass(frozen=True)
class OutputFolder:
    """An output folder, existing or not."""

    path: Path

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def history(self) -> Path:
        return self.path / "history.json"

    @property
    def report(self) -> Path:
        return self.path / "report.html"

    @property
    def videos(self) -> Path:
        return self.path / "videos"

    def is_output_folder(self) -> bool:
        """Whether snowsplat or the reference implementation has written a training run here."""
        return any((self.path / name).is_file() for name in ("config.json", "cfg_args"))

    # Before a training run

    def check_free(self, *, resume: bool, overwrite: bool) -> None:
        """Check that a training run may write here; writes nothing.

        Raises:
            UserError: the path is a file or a folder with other files, or contains a training run
                that is to be neither resumed nor overwritten.
        """
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise UserError("{path}: is a file; use a folder for the output", path=self.path)
        others = (
            entry
            for entry in self.path.iterdir()
            if entry.name != LOCK and not is_temporary(entry, _FILES)
        )
        if any(others) and not self.is_output_folder():
            raise UserError(
                "{path}: contains other files; use a new or an empty folder", path=self.path
            )
        if self.is_output_folder() and not resume and not overwrite:
            raise UserError(
                "{path}: already contains a training run; use `resume` to continue it, "
                "`overwrite` to replace it, or use another folder",
                path=self.path,
            )

    def clear(self) -> None:
        """Remove everything except for the lock, which the caller holds."""
        for entry in self.path.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            elif entry.name != LOCK:
                entry.unlink(missing_ok=True)

    def begin(self, dataset: Dataset, settings: DatasetSettings, config: TrainConfig) -> None:
        """Create the folder, remove the results of an earlier run, and call `describe`."""
        for name in _RESULTS:
            shutil.rmtree(self.path / name, ignore_errors=True)
        for name in _REPORTS:
            (self.path / name).unlink(missing_ok=True)
        self.describe(dataset, settings, config)

    def describe(self, dataset: Dataset, settings: DatasetSettings, config: TrainConfig) -> None:
        """Write the files that are known before the first step: settings, cameras, points."""
        self.path.mkdir(parents=True, exist_ok=True)
        self.write_config(settings, config)  # from now on, `is_output_folder` is true
        if dataset.points is not None:
            from snowsplat.data.points_ply import write_points

            points = dataset.points
            write_points(self.path / "input.ply", points.xyz.numpy(), points.rgb.numpy())
        self.write_cameras([*dataset.train, *dataset.test])
        write_place(self.path / _CAMERAS, Place(dataset.origin, dataset.metres_per_unit))

    def write_cameras(self, views: Sequence[View]) -> None:
        """Write `cameras.json`."""
        from snowsplat.scene.camera_json import write_cameras

        # Several views of one photo are named by the photo and the view.
        cameras = (
            (view.name if part and part.name else Path(view.name).stem, view.camera)
            for view in views
            for part in [view.image.view]
        )
        write_cameras(self.path / _CAMERAS, cameras)

    def origin(self) -> Origin | None:
        """That of `cameras.json`; None if the cameras are in the world, or it is not known."""
        origin = read_place(self.path / _CAMERAS).origin
        return origin if any(origin) else None

    def write_config(self, settings: DatasetSettings, config: TrainConfig) -> None:
        """Write `config.json` and `cfg_args`; remove unfinished files of a killed process."""
        from snowsplat.training.settings.stored import config_to_json

        remove_temporaries(self.path, _FILES)
        self._remove_unwritten_scenes()
        training = config_to_json(config)
        whole = {"snowsplat": __version__, "dataset": asdict(settings), "training": training}
        write_json(self.path / "config.json", whole)
        namespace = argparse.Namespace(
            data_device="cpu",
            eval=settings.hold_out is not None,
            images=settings.images,
            model_path=str(self.path.absolute()),
            resolution=settings.resolution,
            sh_degree=config.sh_degree,
            source_path=settings.path,
            white_background=config.background == "white",
        )
        write_text(self.path / "cfg_args", repr(namespace))

    def _remove_unwritten_scenes(self) -> None:
        """Remove folders without a scene: the process was killed, or the disk was full."""
        for folder in (self.path / "point_cloud").glob("iteration_*"):
            if not (folder / "point_cloud.ply").exists():
                shutil.rmtree(folder, ignore_errors=True)

    def write_exposure(self, exposures: dict[str, list[float]]) -> None:
        """Write `exposure.json`: the exposure of each training photo in EV, for each channel."""
        write_json(self.path / "exposure.json", {"unit": "EV", "photos": exposures})

    def exposures(self) -> dict[str, list[float]]:
        """What `write_exposure` has written; empty if no gains were learnt. Raises UserError."""
        file = self.path / "exposure.json"
        if not file.is_file():
            return {}
        try:
            photos = read_json(file)["photos"]
            return {str(name): [float(ev) for ev in channels] for name, channels in photos.items()}
        except (ValueError, KeyError, TypeError, AttributeError):
            raise UserError("{file}: damaged; train again", file=file) from None

    def discard(self) -> None:
        """Remove what `begin` wrote, if there is neither a scene nor a checkpoint."""
        if self.scenes() or self.checkpoints.exists():
            return
        for name in _FILES:
            (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(self.path / _TENSORBOARD, ignore_errors=True)
        self._remove_unwritten_scenes()
        with suppress(OSError):  # missing, or not empty
            (self.path / "point_cloud").rmdir()
        if self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    # Scenes

    def scenes(self) -> list[int]:
        """The iterations that have a scene, ascending."""
        folder = self.path / "point_cloud"
        if not folder.is_dir():
            return []
        found = [_SCENE.fullmatch(entry.name) for entry in folder.iterdir()]
        steps = sorted(int(match[1]) for match in found if match)
        return [step for step in steps if self.scene_path(step).is_file()]

    def scene_path(self, iteration: int) -> Path:
        return self.path / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"

    def without_scene(self) -> UserError:
        """The error that this folder has no scene."""
        what = "contains no scene (no point_cloud/iteration_N in it)"
        if any(self.checkpoints.glob("step_*.safetensors")):
            what = "contains no scene yet, but checkpoints; show it with watch, or continue it"
        return UserError("{path}: {what}", path=self.path, what=what)

    def write_scene(self, iteration: int, gaussians: Gaussians) -> Path:
        """Save the scene; returns the file."""
        from snowsplat.formats import write_gaussians

        path = self.scene_path(iteration)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_gaussians(path, gaussians)
        return path

    def read_scene(self, iteration: int | None) -> tuple[int, Gaussians]:
        """An iteration and its scene; None or -1: the last one.

        Raises:
            UserError: no such folder or scene, or a damaged one.
        """
        from snowsplat.formats import read_gaussians

        scenes = self.scenes()
        if not scenes:
            raise self.without_scene()
        chosen = scenes[-1] if iteration in (None, -1) else iteration
        if chosen not in scenes:
            there = ", ".join(map(str, scenes))
            what = f"contains no scene of iteration {chosen}; there are {there}"
            raise UserError("{path}: {what}", path=self.path, what=what)
        return chosen, read_gaussians(self.scene_path(chosen))

    def write_metrics(
        self,
        iteration: int,
        split: str,
        evaluation: Evaluation,
        left_out: tuple[str, ...] | None = None,
    ) -> None:
        """Write `metrics.json`: iteration, split, mean metrics, and the metrics of each view.

        ``left_out``: names of the photos that the training has left out, for the list "left_out";
        None: the list of the existing file is kept.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        path = self.path / "metrics.json"
        names = _left_out_in(path) if left_out is None else list(left_out)
        head: dict[str, Any] = {"iteration": iteration, "split": split}
        if names:
            head["left_out"] = names
        write_json(path, head | evaluation.as_json())

    # Settings

    def write_masks(self, masks: Mapping[str, Image.Image]) -> None:
        """Write masks by the name of the photo, in the format of the masks of a dataset."""
        for name, image in masks.items():
            path = self.path / "masks" / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                image.save(temporary, format="PNG")

    def settings(self) -> tuple[DatasetSettings, tuple[float, float, float]]:
        """How the dataset was read, and the background colour (red, green, blue in 0..1).

        If the folder was moved, the paths are those of `located`.

        Raises:
            UserError: missing or damaged settings.
        """
        ours, theirs = self.path / "config.json", self.path / "cfg_args"
        try:
            if ours.is_file():
                whole = read_json(ours)
                dataset = from_json(
                    DatasetSettings, whole["dataset" if "dataset" in whole else FORMER_DATASET]
                )
                white = whole["training"]["background"] == "white"
            elif theirs.is_file():
                values = _namespace(theirs)
                dataset = DatasetSettings(
                    path=str(values["source_path"]),
                    images=str(values.get("images", "images")),
                    resolution=int(values.get("resolution", -1)),
                    hold_out=8 if values.get("eval") else None,
                )
                white = bool(values.get("white_background"))
            else:
                raise UserError(
                    "{path}: not the output folder of a training run (no config.json)",
                    path=self.path,
                )
        except (KeyError, TypeError, ValueError, SyntaxError, OverflowError):
            where = ours if ours.is_file() else theirs
            raise UserError("{where}: damaged; it does not name the dataset", where=where) from None
        return self.located(dataset), (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)

    def located(self, dataset: DatasetSettings) -> DatasetSettings:
        """``dataset`` with the paths of today, if this folder was moved with its dataset.

        A path of `make` is always that of the dataset beside this folder: after a copy, the first
        one exists, too. Any other path is replaced only if it does not exist any more, but the same
        relative path does.
        """
        try:
            former = Path(str(_namespace(self.path / "cfg_args")["model_path"]))
        except (OSError, KeyError, ValueError, SyntaxError):
            return dataset
        here = self.path.absolute()
        if not former.is_absolute() or former == here:
            return dataset

        def today(path: str) -> str:
            moved = Path(os.path.normpath(here / os.path.relpath(path, former)))
            own = former.name == SCENE and Path(path) in (
                former.parent / DATASET,
                former.parent / FORMER_DATASET,
            )
            if not moved.exists() or (Path(path).exists() and not own):
                return path
            if not own:
                logger.info("%s was moved; %s is read from %s", self.path, Path(path).name, moved)
            return str(moved)

        tests = dataset.test_list
        return replace(
            dataset, path=today(dataset.path), test_list=None if tests is None else today(tests)
        )


def _left_out_in(metrics: Path) -> list[str]:
    """The list "left_out" of `metrics.json`; empty if there is none, or the file is damaged."""
    try:
        names = read_json(metrics).get("left_out", [])
    except (OSError, ValueError, AttributeError):
        return []
    return names if isinstance(names, list) else []


def _namespace(path: Path) -> dict[str, Any]:
    """Strings, numbers, True, False and None of ``Namespace(name=value, …)``; others are ignored.

    Only single words are passed to `ast.literal_eval`: it executes nothing, but deep nesting may
    crash the interpreter.
    """
    with open(path, encoding="utf-8") as file:
        words = (match[0] for match in _WORD.finditer(file.read(_NAMESPACE_LIMIT)))
        if [next(words, ""), next(words, "")] != ["Namespace", "("]:
            raise ValueError("not a Namespace")
        values, depth, part = {}, 1, list[str]()
        for word in words:
            if word in ("'", '"'):
                raise ValueError("a string without an end")
            depth += (word in "([{") - (word in ")]}")
            if depth > 1 or (depth == 1 and word != ","):
                part = [*part, word][:_STORED_WORDS]
                continue
            if len(part) == _STORED_WORDS - 1 and part[1] == "=" and _LITERAL.fullmatch(part[2]):
                values[part[0]] = ast.literal_eval(part[2])
            part = []
            if depth < 1:
                return values
    raise ValueError("no end")
