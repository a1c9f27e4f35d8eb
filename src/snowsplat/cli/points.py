"""`snowsplat points`: the surfaces of a scene as a dense point cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from snowsplat.cli.next_steps import next_step
from snowsplat.cli.surface import SurfaceCommand
from snowsplat.pipeline.options.surface import MeshOptions
from snowsplat.util.messages import message
from snowsplat.util.settings import group


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
        surface = self.written(points=True)
        count = message("{count:,} points", count=len(surface.mesh.vertices))
        mesh = self.output.with_suffix(".glb")
        return self.reported(
            surface,
            count,
            next_step(message("for triangles instead"), "mesh", self.scene, "-o", mesh),
        )
