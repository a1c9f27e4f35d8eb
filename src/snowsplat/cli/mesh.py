"""`snowsplat mesh`: the surfaces of a scene as triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from snowsplat.cli.next_steps import next_step
from snowsplat.cli.surface import SurfaceCommand
from snowsplat.pipeline.options.surface import MeshOptions
from snowsplat.util.messages import message
from snowsplat.util.settings import group


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
        .ply   for MeshLab and CloudCompare; in the frame of the scene
      Lengths are in the units of the dataset: metres if it has the true scale.
      --triangles needs a package: pip install 'snowsplat[mesh]'
    """

    options: MeshOptions = group(MeshOptions)

    def run(self) -> dict[str, Any]:
        surface = self.written()
        faces = len(surface.mesh.faces)
        count = message("{kept:,} of {found:,} triangles", kept=faces, found=surface.found)
        points = self.output.with_suffix(".ply")
        return self.reported(
            surface,
            count,
            next_step(message("for points instead"), "points", self.scene, "-o", points),
        )
