"""Few Gaussians learn to look like many."""

import math

import torch

from snowsplat.evaluation.metrics import psnr
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render
from snowsplat.scene.simplify import simplify
from snowsplat.training.core.distillation import distill

UP = torch.tensor([0.0, -1.0, 0.0])


def sphere(n):
    """A sphere with spots, of n flat Gaussians."""
    generator = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    return Gaussians(
        means=means,
        log_scales=torch.full((n, 3), 0.5 * math.log(4 * math.pi / n)),
        quats=torch.randn(n, 4, generator=generator),
        opacity_logits=torch.full((n,), 2.0),
        sh_dc=(6 * means).sin()[:, None],
        sh_rest=0.02 * torch.randn(n, 3, 3, generator=generator),
    )


def ring(count, width=96, start=0.0):
    """Cameras around the sphere."""
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * (i + start) / count
        position = torch.tensor([3 * math.sin(angle), -1.0, 3 * math.cos(angle)])
        size = (width, width, 1.04 * width, 1.04 * width, width / 2, width / 2)
        cameras.append(Camera(*size, look_at(position, torch.zeros(3), UP)))
    return cameras


def test_a_student_looks_like_its_teacher_also_from_other_views():
    teacher, white = sphere(2000), torch.ones(3)
    merged = simplify(teacher, 500, ring(8))
    before = merged.clone()
    losses = []
    student = distill(merged, teacher, ring(8), white, 60, lambda step, loss: losses.append(loss))
    assert len(losses) == 60
    assert len(student) == 500
    assert all(
        torch.equal(value, before.parameters()[name]) for name, value in merged.parameters().items()
    )

    def quality(gaussians):
        return min(
            psnr(render(gaussians, camera, white).image, render(teacher, camera, white).image)
            for camera in ring(8, start=0.5)
        )

    assert quality(student) > quality(merged) + 2.0


def test_antialiased_scenes_stay_antialiased():
    teacher = sphere(200)
    teacher.antialiased = True
    merged = simplify(teacher, 100, ring(3))
    assert distill(merged, teacher, ring(3), torch.zeros(3), 3).antialiased


def test_large_photos_are_compared_at_a_smaller_size():
    teacher = sphere(50)
    merged = simplify(teacher, 40)
    large, small = (
        distill(merged, teacher, ring(2, width), torch.zeros(3), 4) for width in (1280, 640)
    )
    torch.testing.assert_close(large.means, small.means)
