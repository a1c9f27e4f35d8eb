"""The flags of `mesh` and `points`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import Threads, flag, switch
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.pipeline.mesh import Surface
    from snowsplat.pipeline.output.scene_source import TrainedScene


@dataclass
class SurfaceFlags(Reports):
    """The base class of these subcommands."""

    scene: Annotated[Path | None, tyro.conf.Positional, flag("SCENE")] = None
    """The output folder of train or make; or, with --dataset, a scene file of any format."""
    output: Annotated[Path | None, flag("FILE", "-o")] = None
    """The file to write."""
    dataset: Annotated[Path | None, flag("DATASET", "-s", default="as trained")] = None
    """Folder of the dataset: for a scene file, or if it was moved after the training."""
    voxel: Annotated[float | None, flag("LENGTH", default="2 pixels of the photos")] = None
    """Side of the voxels in which the depth maps are fused: the smallest detail."""
    far: Annotated[float | None, flag("LENGTH", default="3 times the median depth")] = None
    """Leave out what is farther than this from every camera."""
    parts: Annotated[float, flag("SHARE", default="0.01")] = 0.01
    """Leave out connected parts that are smaller than this share of the largest one."""
    overwrite: Annotated[bool, switch()] = False
    """Replace FILE if it exists already."""
    threads: Threads = None
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """Device to compute on."""
    json: JsonFlag = False

    def paths(self) -> tuple[Path, Path]:
        """Scene and file. Raises: UserError: one of them is missing."""
        if self.scene is None or self.output is None:
            raise UserError("name a scene, and the file to write with -o")
        return self.scene, self.output

    def load(self, scene: Path) -> TrainedScene:
        """The scene with its dataset. Raises: UserError: one of them is missing or damaged."""
        from snowsplat.pipeline.compute import Compute
        from snowsplat.pipeline.output.scene_source import load_trained

        compute = Compute(self.device, self.threads)
        return load_trained(scene, dataset=self.dataset, compute=compute)

    def tell(self, target: Path, surface: Surface, what: str) -> None:
        """Print the line of the result, and keep the result for --json."""
        print(
            message(
                "{target}: {what} from {photos} photos, with voxels of {voxel:.3g}",
                target=target,
                what=what,
                photos=surface.photos,
                voxel=surface.voxel,
            )
        )
        if surface.closer:
            print("finer voxels do not fit into memory; a smaller --far makes room for them")
        told = {name: value for name, value in vars(surface).items() if name != "mesh"}
        mesh = surface.mesh
        counts = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
        self.report = {"file": target, "bytes": target.stat().st_size, **counts, **told}
