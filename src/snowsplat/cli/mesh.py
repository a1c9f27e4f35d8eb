"""`snowsplat mesh` and `points`: the surfaces of a scene as triangles, or as dense points."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, next_step, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.scene import MeshOptions
from snowsplat.util.messages import message
from snowsplat.util.settings import group, needed

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

    def write(self, *, points: bool) -> dict[str, Any]:
        """Write the surfaces, and print the lines of the result; returns it for --json."""
        from snowsplat.pipeline.mesh import write_mesh
        from snowsplat.pipeline.output.scene_source import load_trained

        with TerminalObserver() as observer:
            surface = write_mesh(
                lambda: load_trained(self.scene, dataset=self.dataset, compute=self.compute),
                self.output,
                self.options,
                self.overwrite,
                observer,
                points=points,
            )
        mesh = surface.mesh
        counts = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
        if points:
            what = message("{count:,} points", count=counts["vertices"])
            purpose, other = message("for triangles instead"), ("mesh", ".glb")
        else:
            kept, found = counts["triangles"], surface.found
            what = message("{kept:,} of {found:,} triangles", kept=kept, found=found)
            purpose, other = message("for points instead"), ("points", ".ply")
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
        command, suffix = other
        print(next_step(purpose, command, self.scene, "-o", self.output.with_suffix(suffix)))
        about = {name: value for name, value in vars(surface).items() if name != "mesh"}
        return {"file": self.output, "bytes": self.output.stat().st_size, **counts, **about}


@dataclass(frozen=True, kw_only=True)
class Mesh(SurfaceCommand):
    """Write the surfaces as triangles with the colours of the photos.

    Examples:
      snowsplat mesh out/garden -o garden.glb
      snowsplat mesh out/garden -o table.ply --far 3 --voxel 0.005
      snowsplat mesh out/garden -o collision.obj --triangles 5000
      snowsplat mesh garden.spz --dataset garden -o garden.glb

    Notes:
      The suffix of FILE selects the format:
        .glb   for Blender, games and the web; y is up
        .obj   for most other programs; y is up
        .usdz  for augmented reality on an iPhone or iPad (snowsplat[usd]); y is up
        .ply   for MeshLab and CloudCompare; in the frame of the scene
      Lengths are in the units of the dataset: metres if it has the true scale.
      --triangles needs a package: pip install 'snowsplat[mesh]'
    """

    options: MeshOptions = group(MeshOptions)

    def run(self) -> dict[str, Any]:
        return self.write(points=False)


@dataclass(frozen=True, kw_only=True)
class Points(SurfaceCommand):
    """Write a dense cloud of points on the surfaces, with normals.

    Examples:
      snowsplat points out/garden -o garden.ply
      snowsplat points out/garden -o garden.laz --voxel 0.02
      snowsplat points garden.spz --dataset garden -o garden.ply

    Notes:
      There is about one point for each voxel of the surface. The suffix of FILE
      selects the format: .ply, or .las and .laz, which need a package:
      pip install 'snowsplat[mesh]'
    """

    options: MeshOptions = group(MeshOptions, only=("voxel", "far", "parts"))

    def run(self) -> dict[str, Any]:
        return self.write(points=True)
