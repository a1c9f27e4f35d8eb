"""`snowsplat mesh`: the surfaces of a scene as triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.next_steps import next_step
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.surface_flags import SurfaceFlags


@dataclass
class Mesh(SurfaceFlags):
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

    triangles: Annotated[int | None, flag("N", default="all")] = None
    """Simplify the mesh to about this number: 5000 for collisions in a game."""
    fill_holes: Annotated[bool, switch()] = False
    """Close holes with flat triangles, as 3D printing needs it."""

    def run(self) -> int:
        scene, target = self.paths()
        from snowsplat.pipeline.mesh import MeshOptions, write_mesh

        options = MeshOptions(self.voxel, self.far, self.parts, self.triangles, self.fill_holes)
        with TerminalObserver() as observer:
            surface = write_mesh(
                lambda: self.load(scene), target, options, self.overwrite, observer
            )
        count = len(surface.mesh.faces)
        self.tell(target, surface, f"{count:,} of {surface.found:,} triangles")
        print(next_step("for points instead", "points", scene, "-o", target.with_suffix(".ply")))
        return 0
