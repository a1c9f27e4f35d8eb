"""`TrainingFolder`: the files of a training run, in the layout of the reference implementation.

    OUT/cfg_args                                   settings, in the format of that implementation
    OUT/cameras.json                               all cameras, refined if the training did so
    OUT/input.ply                                  the points that the training started from
    OUT/point_cloud/iteration_N/point_cloud.ply    the scene after N steps
    OUT/config.json                                *all settings
    OUT/checkpoints/step_N.safetensors             *see snowsplat.training.core.checkpoint
    OUT/metrics.json                               metrics of the last evaluation
    OUT/exposure.json                              *gains of the photos, if they were learnt
    OUT/history.json                               *the curves of the training
    OUT/report.html                                *a page about the training
    OUT/masks/NAME.png                             *masks of what moves, if something moves
    OUT/test/ours_N/renders, gt                    rendered images and photos; also train/
    OUT/refined/sparse/0                           *a COLMAP model with refined cameras
    OUT/videos/                                    *rendered videos
    OUT/log.csv, OUT/tensorboard/                  *logs of the steps, if they are asked for

The reference implementation does not write the entries marked *. Its folders are read too.
"""

import argparse
import logging
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from snowsplat._version import __version__
from snowsplat.formats.origin_file import read_place
from snowsplat.project.cfg_args import read_cfg_args
from snowsplat.project.inside import Inside
from snowsplat.project.left_out import LeftOut
from snowsplat.scene.origin import Origin
from snowsplat.util.errors import UserError
from snowsplat.util.files import (
    atomic_path,
    check_output,
    is_temporary,
    remove_temporaries,
    write_json,
    write_text,
)
from snowsplat.util.messages import message
from snowsplat.util.run_lock import LOCK
from snowsplat.util.safe_json import from_json, read_json

logger = logging.getLogger(__name__)

Color = tuple[float, float, float]

#: Folders inside the folder of `make`: the dataset, and the output folder of its training.
DATASET, SCENE = "dataset", "scene"
#: Why the training has left a photo out.
UNEXPLAINED = message("the scene does not explain it")
#: Why a training leaves out a photo before its first step.
DAMAGED = message("its data are damaged")
CONTRADICTED = message("the matches with other photos contradict its pose")
_SCENE = re.compile(r"iteration_(\d+)")


@dataclass(frozen=True)
class DatasetSettings:
    """How the dataset of a training run is read: the arguments of `snowsplat.load_dataset`.

    ``left_out``: names of photos that are not used, because the matches contradict their poses.
    ``damaged``: names of further ones, whose data or masks are damaged.
    """

    path: str
    images: str = "images"
    resolution: int = -1
    hold_out: int | None = None
    first_held_out: int = 0
    test_list: str | list[str] | None = None
    left_out: list[str] | None = None
    damaged: list[str] | None = None

    def unused(self) -> tuple[LeftOut, ...]:
        """The photos that are not used, and why."""
        return (
            *(LeftOut(name, "photos", DAMAGED) for name in self.damaged or []),
            *(LeftOut(name, "poses", CONTRADICTED) for name in self.left_out or []),
        )


@dataclass(frozen=True)
class RenderedFolder:
    """The rendered images of a split, existing or not."""

    path: Path
    renders = Inside("renders")
    #: The photos.
    photos = Inside("gt")
    depth = Inside("depth")
    depth_units = Inside("depth/world_units_per_step.json")
    panoramas = Inside("panoramas")


@dataclass(frozen=True)
class TrainingFolder:
    """An output folder of a training run, existing or not."""

    path: Path

    cfg_args = Inside("cfg_args")
    config = Inside("config.json")
    cameras = Inside("cameras.json")
    #: See `snowsplat.formats.origin_file`.
    place = Inside("cameras.json.origin.json")
    points = Inside("input.ply")
    #: The folder of the scenes.
    point_clouds = Inside("point_cloud")
    checkpoints = Inside("checkpoints")
    metrics = Inside("metrics.json")
    exposure = Inside("exposure.json")
    history = Inside("history.json")
    report = Inside("report.html")
    masks = Inside("masks")
    videos = Inside("videos")
    csv_log = Inside("log.csv")
    tensorboard = Inside("tensorboard")
    #: A folder beside whose model a link to the photos makes a dataset.
    refined = Inside("refined")
    refined_model = Inside("refined/sparse/0")
    # What a training writes after it has begun: folders, and files.
    _folders = (
        *(point_clouds, checkpoints, refined, videos, masks, tensorboard),
        *(Inside("train"), Inside("test")),
    )
    _reports = (metrics, exposure, history, report, csv_log)
    #: The names of all files in the folder itself.
    FILES = tuple(each.name for each in (cfg_args, config, cameras, place, points, *_reports))

    def rendered(self, split: str, iteration: int) -> RenderedFolder:
        """The rendered images of a split, "test" or "train"."""
        return RenderedFolder(self.path / split / f"ours_{iteration}")

    def rendered_views(self) -> list[Path]:
        """The rendered held-out views."""
        return sorted(self.path.glob("test/ours_*/renders/*.png"))

    def is_training(self) -> bool:
        """Whether snowsplat or the reference implementation has written a training run here."""
        return self.config.is_file() or self.cfg_args.is_file()

    # Before a training run

    def check_free(self, *, resume: bool, overwrite: bool) -> None:
        """Check that a training run may write here; writes nothing.

        Raises:
            UserError: the path is a file or a folder with other files, or contains a training run
                that is to be neither resumed nor overwritten.
        """
        found = self.is_training()
        check_output(
            self.path, lambda entry: found or entry.name == LOCK or is_temporary(entry, self.FILES)
        )
        if found and not resume and not overwrite:
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

    def remove_results(self) -> None:
        """Remove what an earlier run wrote after its first step."""
        for each in self._folders:
            shutil.rmtree(self.path / each.name, ignore_errors=True)
        for each in self._reports:
            (self.path / each.name).unlink(missing_ok=True)

    def discard(self) -> None:
        """Remove what was written before the first step, if there is neither a scene nor a
        checkpoint."""
        if self.scenes() or self.checkpoints.exists():
            return
        for name in self.FILES:
            (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(self.tensorboard, ignore_errors=True)
        self._remove_unwritten_scenes()
        with suppress(OSError):  # missing, or not empty
            self.point_clouds.rmdir()
        if self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    # Settings

    def write_settings(self, dataset: DatasetSettings, training: Mapping[str, Any]) -> None:
        """Write `config.json` and `cfg_args`; from now on, `is_training` is true. Removes
        unfinished files of a killed process.

        ``training``: all settings of the training, see `config_to_json`.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        remove_temporaries(self.path, self.FILES)
        self._remove_unwritten_scenes()
        whole = {"snowsplat": __version__, "dataset": asdict(dataset), "training": training}
        write_json(self.config, whole)
        namespace = argparse.Namespace(
            data_device="cpu",
            eval=dataset.hold_out is not None,
            images=dataset.images,
            model_path=str(self.path.absolute()),
            resolution=dataset.resolution,
            sh_degree=training["sh_degree"],
            source_path=dataset.path,
            white_background=training["background"] == "white",
        )
        write_text(self.cfg_args, repr(namespace))

    def training_settings(self) -> dict[str, Any]:
        """All settings of the training, see `config_to_json`. Raises UserError: damaged."""
        file = self.config
        try:
            return dict(read_json(file)["training"])
        except (OSError, ValueError, KeyError, TypeError):
            raise UserError("{file}: damaged; train again", file=file) from None

    def settings(self) -> tuple[DatasetSettings, Color]:
        """How the dataset was read, and the background colour (red, green, blue in 0..1).

        If the folder was moved, the paths are those of `located`.

        Raises:
            UserError: missing or damaged settings.
        """
        ours, theirs = self.config, self.cfg_args
        try:
            if ours.is_file():
                whole = read_json(ours)
                dataset = from_json(DatasetSettings, whole["dataset"])
                white = whole["training"]["background"] == "white"
            elif theirs.is_file():
                values = read_cfg_args(theirs)
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

    def background(self) -> Color:
        """The background colour; black if it is not stored. Raises UserError: damaged settings."""
        return self.settings()[1] if self.is_training() else (0.0, 0.0, 0.0)

    def origin(self) -> Origin | None:
        """That of the cameras; None if they are in the world, or it is not known."""
        origin = read_place(self.cameras).origin
        return origin if any(origin) else None

    def located(self, dataset: DatasetSettings) -> DatasetSettings:
        """``dataset`` with the paths of today, if this folder was moved with its dataset.

        A path of `make` is always that of the dataset beside this folder: after a copy, the first
        one exists, too. Any other path is replaced only if it does not exist any more, but the same
        relative path does.
        """
        try:
            former = Path(str(read_cfg_args(self.cfg_args)["model_path"]))
        except (OSError, KeyError, ValueError, SyntaxError):
            return dataset
        here = self.path.absolute()
        if not former.is_absolute() or former == here:
            return dataset

        def today(path: str) -> str:
            moved = Path(os.path.normpath(here / os.path.relpath(path, former)))
            own = former.name == SCENE and Path(path) == former.parent / DATASET
            if not moved.exists() or (Path(path).exists() and not own):
                return path
            if not own:
                logger.info("%s was moved; %s is read from %s", self.path, Path(path).name, moved)
            return str(moved)

        tests = dataset.test_list
        tests = today(tests) if isinstance(tests, str) else tests
        return replace(dataset, path=today(dataset.path), test_list=tests)

    # Scenes

    def scenes(self) -> list[int]:
        """The iterations that have a scene, ascending."""
        folder = self.point_clouds
        if not folder.is_dir():
            return []
        found = [_SCENE.fullmatch(entry.name) for entry in folder.iterdir()]
        steps = sorted(int(match[1]) for match in found if match)
        return [step for step in steps if self.scene_path(step).is_file()]

    def scene_path(self, iteration: int) -> Path:
        return self.point_clouds / f"iteration_{iteration}" / "point_cloud.ply"

    def find_scene(self, iteration: int | None = None) -> tuple[int, Path]:
        """An iteration and the file of its scene; None or -1: the last one.

        Raises:
            UserError: there is no such scene.
        """
        scenes = self.scenes()
        if not scenes:
            if any(self.checkpoints.glob("step_*.safetensors")):
                raise UserError(
                    "{path}: contains no scene yet, but checkpoints; show it with watch, or "
                    "continue it",
                    path=self.path,
                )
            raise UserError(
                "{path}: contains no scene (no point_cloud/iteration_N in it)", path=self.path
            )
        chosen = scenes[-1] if iteration in (None, -1) else iteration
        if chosen not in scenes:
            raise UserError(
                "{path}: contains no scene of iteration {chosen}; there are {there}",
                path=self.path,
                chosen=chosen,
                there=scenes,
            )
        return chosen, self.scene_path(chosen)

    def _remove_unwritten_scenes(self) -> None:
        """Remove folders without a scene: the process was killed, or the disk was full."""
        for folder in self.point_clouds.glob("iteration_*"):
            if not (folder / "point_cloud.ply").exists():
                shutil.rmtree(folder, ignore_errors=True)

    # Results

    def write_metrics(
        self,
        iteration: int,
        split: str,
        metrics: Mapping[str, Any],
        left_out: Sequence[LeftOut] | None = None,
    ) -> None:
        """Write `metrics.json`: iteration, split, mean metrics, and the metrics of each view.

        Args:
            metrics: the JSON value of an `Evaluation`.
            left_out: the photos that the training has left out, whose names are the list
                "left_out"; None: those in the existing file.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        names = [each.photo for each in (self.left_out() if left_out is None else left_out)]
        head: dict[str, Any] = {"iteration": iteration, "split": split}
        if names:
            head["left_out"] = names
        write_json(self.metrics, {**head, **metrics})

    def read_metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`; empty if there is none, or it is damaged."""
        try:
            return dict(read_json(self.metrics))
        except (OSError, ValueError, TypeError):
            return {}

    def left_out(self) -> list[LeftOut]:
        """The photos that were not used, and those that the scene does not explain."""
        names = self.read_metrics().get("left_out")
        found = [str(name) for name in names] if isinstance(names, list) else []
        unused = self.settings()[0].unused() if self.is_training() else ()
        known = {each.photo for each in unused}
        rest = (LeftOut(name, "training", UNEXPLAINED) for name in found if name not in known)
        return [*unused, *rest]

    def exposures(self) -> dict[str, list[float]]:
        """The exposure of each training photo in EV, by channel; empty if no gains were learnt.

        Raises UserError: the file is damaged.
        """
        file = self.exposure
        if not file.is_file():
            return {}
        try:
            photos = read_json(file)["photos"]
            return {str(name): [float(ev) for ev in channels] for name, channels in photos.items()}
        except (ValueError, KeyError, TypeError, AttributeError):
            raise UserError("{file}: damaged; train again", file=file) from None

    def write_files(self, files: Mapping[str, Any]) -> None:
        """Write JSON objects, and images in PNG files, by their paths in this folder."""
        for name, content in files.items():
            path = self.path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Mapping):
                write_json(path, content)
                continue
            with atomic_path(path) as temporary:
                content.save(temporary, format="PNG")
