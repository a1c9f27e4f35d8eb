"""`sharded_render`: renders the Gaussians of all processes, in every process."""

from __future__ import annotations

from torch import Tensor

from snowsplat import ops
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer, RenderOutput, project
from snowsplat.training.processes.shards import Shards


def sharded_render(shards: Shards) -> Renderer:
    """A function that renders the Gaussians of all processes; each process must call it."""

    def render(
        gaussians: Gaussians, camera: Camera, background: Tensor, sh_degree: int | None
    ) -> RenderOutput:
        splats = shards.everywhere(project(gaussians, camera, sh_degree))
        image, alpha, _ = ops.rasterize(splats, camera.width, camera.height, background)
        return RenderOutput(image, alpha, None, splats)

    return render
