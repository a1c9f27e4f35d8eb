"""`snowsplat watch`: look at the output folder of a training, finished or running."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from snowsplat.cli.flags import flag
from snowsplat.cli.scene import SceneFlags
from snowsplat.cli.viewing import PageFlags
from snowsplat.pipeline.output_folder import SCENE, OutputFolder
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    import torch

    from snowsplat.scene.gaussians import Gaussians
    from snowsplat.viewer.live.viewer import Scene

_NOTHING = [
    "Nothing is saved yet.",
    "A training saves as it goes with --checkpoint-every N; the scene appears here.",
]


@dataclass
class Watch(SceneFlags):
    """Look at the scene of a training in a browser, with its cameras and photos.

    Examples:
      snowsplat watch out/garden
      snowsplat watch out/garden --port 9000

    While the training runs, the newest scene or checkpoint that it has saved is shown (see train
    --checkpoint-every). OUT of `snowsplat make` will do as well. Ctrl-C ends it.
    """

    port: Annotated[int | None, flag("N", default="8080, or the next that is free")] = None
    """Where the page is: http://localhost:N."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer alone")] = None
    """Who may look; 0.0.0.0: all in the network who have the address, which is printed."""

    def folder(self) -> OutputFolder:
        folder = super().folder()
        made = OutputFolder(folder.path / SCENE)
        return made if made.is_one() and not folder.is_one() else folder

    def run(self) -> int:
        """Gives the exit code: 0, after Ctrl-C."""
        folder = self.folder()
        dataset, background = self.load_dataset()
        newest = NewestScene(folder, self.iteration, self.computing())
        newest()  # what cannot be shown is refused before a page opens
        label = folder.path.absolute().name
        viewer = PageFlags(self.port, self.host).open(dataset, background, label)
        try:
            print("Ctrl-C ends it", flush=True)
            viewer.hold(newest)
        except KeyboardInterrupt:
            pass
        finally:
            viewer.close()
        return 0


class NewestScene:
    """What a folder holds now; a file is read once."""

    def __init__(
        self, folder: OutputFolder, iteration: int | None, device: torch.device | None = None
    ) -> None:
        """``iteration``: show this one, whatever comes. ``device``: where to; default: the CPU."""
        self._folder, self._iteration, self._device = folder, iteration, device
        self._read: tuple[Path, int] | None = None  # the file shown, and when it was written
        self._scene: Scene | None = None

    def __call__(self) -> Scene:
        """The newest scene or checkpoint; what was there, where a newer one cannot be read.

        Raises:
            UserError: the first one cannot be read.
        """
        from snowsplat.viewer.live.viewer import Scene

        try:
            step, path = self._newest()
            if path is None:
                return self._scene or Scene(None, -1, _NOTHING)
            found = path, path.stat().st_mtime_ns
            if self._scene is None or self._read != found:
                gaussians = self._gaussians(path).to(self._device)
                name = path.relative_to(self._folder.path).as_posix()
                about = [f"After {step:,} steps", f"{len(gaussians):,} Gaussians", name]
                self._scene, self._read = Scene(gaussians, found[1], about), found
        except (OSError, UserError):  # replaced or removed while it was read: next time
            if self._scene is None:
                raise
        return self._scene

    def _newest(self) -> tuple[int, Path | None]:
        from snowsplat.training import checkpoint

        if self._iteration is not None:
            there = self._folder.scenes()
            if self._iteration not in there:
                self._folder.read_scene(self._iteration)  # which says what there is
            return self._iteration, self._folder.scene_path(self._iteration)
        found = [(step, self._folder.scene_path(step)) for step in self._folder.scenes()]
        found += checkpoint.files(self._folder.checkpoints)
        return max(found, key=lambda each: each[0], default=(0, None))

    def _gaussians(self, path: Path) -> Gaussians:
        from snowsplat.formats import read_gaussians
        from snowsplat.scene.gaussians import Gaussians
        from snowsplat.training import checkpoint

        if path.parent != self._folder.checkpoints:
            return read_gaussians(path)
        tensors = checkpoint.load(path).tensors
        part = "gaussians."
        own = {name[len(part) :]: t for name, t in tensors.items() if name.startswith(part)}
        try:
            return Gaussians(**own)
        except (TypeError, ValueError):
            raise UserError(f"{path}: not the checkpoint of a training") from None
