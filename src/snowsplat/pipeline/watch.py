"""`watch`: shows the newest scene of an output folder in the browser, also during training."""

import json
import sys
from contextlib import suppress
from dataclasses import asdict
from multiprocessing import AuthenticationError
from pathlib import Path
from typing import Any

import torch

from snowsplat.formats import read_gaussians
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.scene_source import load_dataset_of
from snowsplat.pipeline.run.live_page import MOST, LivePage, PageReply, PageRequest, Place
from snowsplat.project.project import Project
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.origin import HERE, Origin
from snowsplat.training.core import checkpoint
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import from_json, parse_json
from snowsplat.viewer.live.viewer import Scene

_NOTHING = [
    message("Nothing is saved yet."),
    message(
        "With --checkpoint-every N, training saves the scene every N steps; it then appears here."
    ),
]


def watch(
    output: Path | str,
    page: LivePage,
    *,
    iteration: int | None = None,
    dataset: Path | str | None = None,
    resolution: int | None = None,
    compute: Compute | None = None,
    observer: Observer = SILENT,
) -> None:
    """Show a training run until Ctrl-C, with cameras and photos.

    A training run on this computer that still runs opens ``page`` itself, with its controls; at
    its end, and otherwise, the newest scene or checkpoint in the folder is shown.

    Args:
        output: the folder of `train` or `make`.
        iteration: show only the scene of this iteration; default: the newest.
        dataset, resolution, compute: as in `load_trained`. With one of these, or with
            ``iteration``, only the folder is shown.

    Raises: UserError: scene, settings or dataset are missing or damaged; an unusable device.
    """
    project = Project.open(output)
    folder = project.training_folder()
    of_folder = any(each is not None for each in (iteration, dataset, resolution))
    if not of_folder and compute in (None, Compute()):
        try:
            if _attached(folder.path, page, observer):
                observer.inform("the training has ended; its result follows")
        except KeyboardInterrupt:
            return
    data, background = load_dataset_of(folder, dataset, resolution)
    newest = NewestScene(folder, iteration, (compute or Compute()).apply(), data.origin)
    newest()  # a scene that cannot be shown is reported before the page opens
    with suppress(KeyboardInterrupt):  # Ctrl-C is the normal end as soon as the page is open
        page.open(data, background, project.name, observer).show_newest(newest)


def _attached(output: Path, page: LivePage, observer: Observer) -> bool:
    """Let the training that runs in a folder open the page, and wait until it ends.

    Returns False at once if no training runs here that this process can reach.

    Raises:
        UserError: the training cannot open the page.
        KeyboardInterrupt: Ctrl-C; the training closes the page, and continues.
    """
    if sys.platform == "win32":
        return False
    request = PageRequest(page.port, page.host, tuple(page.allow_host))
    try:
        connection = Place.of(output).connect()
    except (OSError, ValueError, EOFError, AuthenticationError):
        return False  # it has ended, or runs on another computer
    with connection, suppress(OSError, EOFError):
        connection.send_bytes(json.dumps(asdict(request)).encode())
        observer.inform("the training opens its page after the present step")
        answer = parse_json(connection.recv_bytes(MOST))
        if answer is None:
            return True
        reply = from_json(PageReply, answer)
        if reply.error:
            raise UserError(reply.error)
        observer.inform("closing the page does not end the training")
        observer.page_opened(reply)
        connection.recv_bytes(MOST)  # returns when the training ends
    return True


class NewestScene:
    """The newest scene or checkpoint of a folder; each file is read once."""

    def __init__(
        self,
        folder: TrainingFolder,
        iteration: int | None,
        device: torch.device | None = None,
        origin: Origin = HERE,
    ) -> None:
        """
        Args:
            iteration: show only the scene of this iteration; None: the newest.
            device: the device for the Gaussians; None: the CPU.
            origin: that of the dataset, to which the Gaussians are moved.
        """
        self._folder, self._iteration, self._device = folder, iteration, device
        self._origin = origin
        self._read: tuple[Path, int] | None = None  # the file shown, and when it was written
        self._scene: Scene | None = None

    def __call__(self) -> Scene:
        """The newest scene or checkpoint; the previous one if a newer one cannot be read.
        Raises: UserError: the first one cannot be read.

        """
        try:
            step, path = self._newest()
            if path is None:
                return self._scene or Scene(None, -1, _NOTHING)
            found = path, path.stat().st_mtime_ns
            if self._scene is None or self._read != found:
                gaussians = self._gaussians(path).to(self._device)
                name = path.relative_to(self._folder.path).as_posix()
                about = [
                    message("After {steps:,} steps", steps=step),
                    message("{gaussians:,} Gaussians", gaussians=len(gaussians)),
                    Message(name),
                ]
                self._scene, self._read = Scene(gaussians, found[1], about), found
        except (OSError, UserError):
            # The file was replaced or removed: it is read again at the next call.
            if self._scene is None:
                raise
        return self._scene

    def _newest(self) -> tuple[int, Path | None]:
        if self._iteration is not None:
            return self._folder.find_scene(self._iteration)
        found = [(step, self._folder.scene_path(step)) for step in self._folder.scenes()]
        found += checkpoint.files(self._folder.checkpoints)
        return max(found, key=lambda each: each[0], default=(0, None))

    def _gaussians(self, path: Path) -> Gaussians:
        if path.parent != self._folder.checkpoints:
            return seen_from_dataset(read_gaussians(path), self._origin)
        saved = checkpoint.load(path)
        part = "gaussians."
        own: dict[str, Any] = {
            n.removeprefix(part): t for n, t in saved.tensors.items() if n.startswith(part)
        }
        try:
            antialiased = saved.meta.get("training", {}).get("antialias", False)
            return Gaussians(**own, antialiased=bool(antialiased), origin=self._origin)
        except (AttributeError, TypeError, ValueError):
            raise UserError("{path}: not a checkpoint of a training run", path=path) from None
