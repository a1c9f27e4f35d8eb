"""The stages of `snowsplat make`: dataset, training, pictures."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.cli.progress import duration
from snowsplat.pipeline.output_folder import CAPTURE, SCENE, DatasetSettings, OutputFolder
from snowsplat.pipeline.presets import PRESETS, Preset, Quality
from snowsplat.util.files import atomic_path

if TYPE_CHECKING:
    from snowsplat.cli.train import Train
    from snowsplat.cli.viewing import PageFlags
    from snowsplat.util.stages import Outcome, Stages

STAGES = ("scene", "pictures")  # the dataset keeps its own record
HOLD_OUT = 8
# What of a preset is about the training.
_OF_TRAINING = ("side", "iterations", "max_gaussians", "densify_interval")
# What a kill may cost.
_CHECKPOINT_SECONDS = 15.0
# The shortest training that is worth it: seconds, and as a part of the time given.
_SHORTEST, _SHORTEST_SHARE = 15.0, 0.15
# Pictures of the held-out views take about so long each.
_PICTURE_SECONDS = 0.3


class TrainingStopped(KeyboardInterrupt):
    """Ctrl-C in the training, which has saved what is reached and said how to go on."""


@dataclass
class Making:
    """The stages in their order, each unless it is finished.

    Attributes:
        inputs: folders of photos, photos, videos.
        name: of the scene.
        out: the folder for all, which is there.
        stages: their record.
        command: that goes on, for people.
        minutes, threads, device, memory, overwrite: as the flags of the verb.
        started: when it was, by `time.monotonic`.
        page: where the training is to be watched, and the scene in the end.
    """

    inputs: tuple[Path, ...]
    name: str
    out: Path
    quality: Quality
    stages: Stages
    command: str
    minutes: float | None
    threads: int | None
    device: str | None
    memory: str | None
    overwrite: bool
    started: float
    page: PageFlags | None = None

    def run(self) -> int:
        """Gives the exit code, 0.

        Raises:
            UserError: see each stage.
            KeyboardInterrupt: Ctrl-C; what is finished stays.
        """
        self._make_dataset()
        settings: dict[str, Any] = {"capture": _fingerprint(self.out / CAPTURE)}
        if self.minutes is None:
            preset = PRESETS[self.quality]
            settings |= {word: getattr(preset, word) for word in _OF_TRAINING}
        else:
            settings |= {"minutes": self.minutes}
        folder = OutputFolder(self.out / SCENE)
        outputs = [self.file, folder.path / "point_cloud", folder.path / "metrics.json"]
        scene = self._stage("scene", settings, outputs, lambda: self._train(settings))
        shutil.rmtree(folder.checkpoints, ignore_errors=True)  # now that it is finished
        pictures = folder.path / "test" / f"ours_{scene.result['iteration']}"
        self._stage("pictures", {}, [pictures], self._render)
        print(
            f"\nThe scene, for any viewer:  {self.file}\n"
            f"How its cameras were found: {self.out / CAPTURE / 'capture_report.html'}\n"
            f"How the training went:      {folder.report}\n"
            f"Pictures of it:             {pictures / 'renders'}\n"
            f" and photos held out:       {pictures / 'gt'}\n"
            f"On those:                   PSNR {scene.result['psnr']:.2f} dB, "
            f"SSIM {scene.result['ssim']:.3f} ({scene.result['views']} photos)\n"
            f"This took:                  {duration(self._elapsed())}",
            flush=True,
        )
        if self.page is not None:
            self._watch(folder.path, self.page)
        return 0

    @property
    def file(self) -> Path:
        """The scene, where viewers are pointed to. The old one stays until the new one is ready."""
        return self.out / f"{self.name}.ply"

    def _elapsed(self) -> float:
        return time.monotonic() - self.started

    def _stage(
        self, name: str, settings: dict[str, Any], outputs: list[Path], work: Any
    ) -> Outcome:
        def on_change(reason: str) -> None:
            print(f"{name}: done again ({reason})", flush=True)

        outcome = self.stages.run(name, settings, outputs, work, on_change)
        if outcome.again:
            print(f"{name:<10}done before", flush=True)
        return outcome

    def _make_dataset(self) -> None:
        from snowsplat.cli.sfm import SfmProgress
        from snowsplat.cli.stages import StageProgress
        from snowsplat.sfm.colmap import SfmOptions
        from snowsplat.sfm.dataset_folder import DatasetOptions, make_dataset
        from snowsplat.sfm.ingest.inputs import GatherOptions

        options = DatasetOptions(
            gather=GatherOptions(size=PRESETS[self.quality].photos),
            sfm=SfmOptions(effort=self.quality, threads=self.threads),
        )
        with StageProgress() as progress:
            watcher = SfmProgress(progress)
            make_dataset(*(self.inputs, self.out / CAPTURE, options, watcher, self.overwrite))

    def _train(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Begin, or go on with, the training; copy its scene to where it is looked for."""
        from snowsplat.training import checkpoint

        folder = OutputFolder(self.out / SCENE)
        going_on = self.stages.about.get("training") == settings
        going_on = going_on and checkpoint.exists(folder.checkpoints)
        if not going_on:
            shutil.rmtree(folder.path, ignore_errors=True)
            self.stages.about["training"] = settings
            self.stages.save()
        train = self._resumed(folder.path) if going_on else self._new(folder.path)
        if self._viewed(train).run() != 0:
            raise TrainingStopped
        metrics = json.loads((folder.path / "metrics.json").read_text(encoding="utf-8"))
        with atomic_path(self.file) as temporary:
            shutil.copyfile(folder.scene_path(metrics["iteration"]), temporary)
        kept = {word: metrics[word] for word in ("iteration", "psnr", "ssim")}
        return kept | {"views": len(metrics["views"])}

    def _watch(self, folder: Path, page: PageFlags) -> None:
        """Show the scene until Ctrl-C."""
        from snowsplat.cli.watch import Watch

        Watch(
            output=folder,
            threads=self.threads,
            device=self.device,
            port=page.port,
            host=page.host,
        ).run()

    def _viewed(self, train: Train) -> Train:
        """With the page of the training, which makes way for that of the scene."""
        if self.page is not None:
            train.view, train.stay = True, False
            train.port, train.host = self.page.port, self.page.host
        return train

    def _resumed(self, folder: Path) -> Train:
        from snowsplat.cli.train import Train

        return Train(
            output=folder,
            resume=True,
            threads=self.threads,
            device=self.device,
            memory=self.memory,
            checkpoint_seconds=_CHECKPOINT_SECONDS,
            again=self.command,
        )

    def _new(self, folder: Path) -> Train:
        from snowsplat.cli.train import Train

        dataset = self.out / CAPTURE
        train = Train(
            dataset=dataset,
            output=folder,
            eval=True,
            threads=self.threads,
            device=self.device,
            memory=self.memory,
            checkpoint_seconds=_CHECKPOINT_SECONDS,
            again=self.command,
        )
        if self.minutes is None:
            preset = PRESETS[self.quality]
            train.iterations, train.max_gaussians = preset.iterations, preset.max_gaussians
            train.densify_interval = preset.densify_interval
            train.resolution = _width(dataset, preset)
        else:
            train.minutes = self._minutes_left(dataset)
        return train

    def _minutes_left(self, dataset: Path) -> float:
        """For the training."""
        assert self.minutes is not None
        given = 60.0 * self.minutes
        held_out = -(-len(_photos(dataset)) // HOLD_OUT)
        left = given - self._elapsed() - _PICTURE_SECONDS * held_out
        shortest = max(_SHORTEST, _SHORTEST_SHARE * given)
        if left < shortest:
            print(
                f"{duration(given)} is too short: {duration(self._elapsed())} went into the "
                f"cameras; training for {duration(shortest)} all the same",
                flush=True,
            )
        return max(left, shortest) / 60.0

    def _render(self) -> dict[str, Any]:
        from snowsplat.cli.render import Render

        Render(
            output=self.out / SCENE, split="test", threads=self.threads, device=self.device
        ).run()
        return {}


def _photos(dataset: Path) -> list[Path]:
    return sorted(path for path in (dataset / "images").rglob("*") if path.is_file())


def _width(dataset: Path, preset: Preset) -> int | None:
    """What -r has to be; None where the photos are small enough as they are."""
    cameras = [view.camera for view in DatasetSettings(str(dataset)).load().train]
    camera = max(cameras, key=lambda camera: max(camera.width, camera.height))
    longer = max(camera.width, camera.height)
    return None if longer <= preset.side else round(camera.width * preset.side / longer)


def _fingerprint(dataset: Path) -> str:
    """Of the cameras, and of names and sizes of photos and masks."""
    digest = hashlib.sha256()
    for path in sorted((dataset / "sparse" / "0").glob("*.bin")):
        digest.update(path.read_bytes())
    for folder in ("images", "masks"):
        for path in sorted((dataset / folder).rglob("*")):
            if path.is_file():
                digest.update(f"{path.relative_to(dataset)} {path.stat().st_size}\n".encode())
    return digest.hexdigest()
