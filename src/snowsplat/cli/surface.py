"""`SurfaceCommand`: what `mesh` and `points` have in common."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.cli.command import JsonCommand
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.print_message import print_message
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.surface import MeshOptions
from snowsplat.util.messages import Message, message
from snowsplat.util.settings import group, needed

if TYPE_CHECKING:
    from snowsplat.pipeline.mesh import Surface

_NEEDED = message("name a scene, and the file to write with -o")


@dataclass(frozen=True, kw_only=True)
class SurfaceCommand(JsonCommand):
    """The base class of these subcommands."""

    scene: Path = needed(
        _NEEDED,
        "SCENE",
        "The output folder of train or make; or, with --dataset, a scene file of any format.",
        argument=True,
    )
    output: Path = needed(_NEEDED, "FILE", "The file to write.", "-o")
    dataset: Path | None = common.dataset()
    options: MeshOptions
    overwrite: bool = common.overwrite()
    compute: Compute = group(Compute, only=("device", "threads"))

    def written(self, *, points: bool = False) -> Surface:
        """What `write_mesh` has written."""
        from snowsplat.pipeline.mesh import write_mesh
        from snowsplat.pipeline.output.scene_source import load_trained

        with TerminalObserver() as observer:
            return write_mesh(
                lambda: load_trained(self.scene, dataset=self.dataset, compute=self.compute),
                self.output,
                self.options,
                self.overwrite,
                observer,
                points=points,
            )

    def reported(self, surface: Surface, what: Message, hint: Message) -> dict[str, Any]:
        """Print the lines of the result; returns it for --json."""
        print_message(
            "{output}: {what} from {photos} photos, with voxels of {voxel:.3g}",
            output=self.output,
            what=what,
            photos=surface.photos,
            voxel=surface.voxel,
        )
        if surface.closer:
            print_message(
                "finer voxels do not fit into memory; a smaller --far makes room for them"
            )
        print(hint)
        told = {name: value for name, value in vars(surface).items() if name != "mesh"}
        mesh = surface.mesh
        counts = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
        return {"file": self.output, "bytes": self.output.stat().st_size, **counts, **told}
