"""`distill`: trains a scene with few Gaussians on renderings of one with many.

The renderings replace the photos, so only the cameras of the photos are needed. As in the
distillation of a neural network, the larger scene is the teacher and the smaller one the student.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.frame.bounds import scene_extent
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project, render
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient

#: Learning rates for merged Gaussians, which are nearly right. The means move a tenth as far as in
#: a training from points: at its rates, small Gaussians would leave the surfaces.
MERGED_RATES = LearningRates(
    means=4.8e-5,
    means_final=1.6e-6,
    means_steps=1.0,
    log_scales=0.03,
    quats=3e-3,
    opacity_logits=0.05,
    sh_dc=7.5e-3,
    sh_rest=1.5e-3,
    anneal=0.3,
    anneal_from=0.0,
)
#: Longest side of the images that are compared, in pixels.
_SIDE = 640


@torch.no_grad()
def distill(
    student: Gaussians,
    teacher: Gaussians,
    cameras: Sequence[Camera],
    background: Tensor,
    steps: int,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> Gaussians:
    """The student after ``steps`` steps of training; its number of Gaussians does not change.

    A step compares the images of student and teacher from one camera, by the loss of training.

    Args:
        student: finite Gaussians on the CPU; unchanged.
        teacher: finite Gaussians on the CPU.
        cameras: at least one.
        background: (3,) colour in 0..1.
        on_step: called with the number of finished steps and the loss.
    """
    student = student.clone()
    optimizer = Adam(
        student,
        MERGED_RATES,
        schedule=Schedule(steps),
        extent=scene_extent(cameras),
        visible_only=True,
    )
    random = torch.Generator().manual_seed(0)
    order: list[int] = []
    for step in range(1, steps + 1):
        order = order or torch.randperm(len(cameras), generator=random).tolist()
        camera = cameras[order.pop()].reduced(_SIDE)
        wanted = render(teacher, camera, background).image
        splats = project(student, camera)
        splats.packed.requires_grad_()
        with torch.enable_grad():
            image, _, _ = ops.rasterize(splats, camera.width, camera.height, background)
            loss = ops.photometric_loss(image, wanted)
            loss.backward()
        optimizer.step(student, [ViewGradient(splats, camera, student.sh_degree)], step)
        on_step(step, float(loss))
    return student
