"""`snowsplat points`: the surfaces of a scene as a dense point cloud."""

from __future__ import annotations

from dataclasses import dataclass

from snowsplat.cli.next_steps import next_step
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.surface_flags import SurfaceFlags


@dataclass
class Points(SurfaceFlags):
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

    def run(self) -> int:
        scene, target = self.paths()
        from snowsplat.pipeline.mesh import MeshOptions, write_points

        options = MeshOptions(self.voxel, self.far, self.parts)
        with TerminalObserver() as observer:
            surface = write_points(
                lambda: self.load(scene), target, options, self.overwrite, observer
            )
        self.tell(target, surface, f"{len(surface.mesh.vertices):,} points")
        print(next_step("for triangles instead", "mesh", scene, "-o", target.with_suffix(".glb")))
        return 0
