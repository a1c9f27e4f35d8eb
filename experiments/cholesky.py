"""What if training optimises the Cholesky factor of Σ instead of rotation and scales?

    python experiments/cholesky.py

trains the same Gaussians with three parameterisations of the covariance, for several learning rates
and seeds, and prints the PSNR of held-out photos. The scene is that of `snowsplat demo` with
all photos; its dataset is made first if it does not exist. docs/learn/covariance.md describes the
result.

Everything else is equal: the number of Gaussians is fixed, colours do not depend on the view, and
all other learning rates are those of the recipe `classic`. The seed selects the initial points, the
order of the photos, and a rotation of the world, because the Cholesky factor depends on the axes.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.dataset import Dataset
from snowsplat.data.load import load_dataset
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.ops.reference import LOW_PASS
from snowsplat.ops.splats import Splats2D
from snowsplat.pipeline.observer import SILENT
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.scene.sh_constants import SH_C0
from snowsplat.sfm.make_dataset import make_dataset
from snowsplat.sfm.options import DatasetOptions
from snowsplat.synthetic import write_synthetic_photos
from snowsplat.training.settings.recipes import recipe

DOWNSCALE = 4
NEAR = 0.2
RATES = (0.003, 0.01, 0.03, 0.1, 0.3)
# The first seed tries all rates. A rate that is much worse than the best is not tried again.
SEEDS = (5, 0, 1, 2, 3)
MUCH = 0.25  # dB; several times the spread between seeds


@dataclass(frozen=True)
class Shape:
    """A parameterisation of Σ = M Mᵀ.

    Attributes:
        parameters: the initial parameters of isotropic Gaussians, from their log scales (N, 1).
        factor: M (N, 3, 3) in world units.
        rates: the learning rate of each parameter, relative to the rate of the experiment.
    """

    parameters: Callable[[Tensor], list[Tensor]]
    factor: Callable[[list[Tensor]], Tensor]
    rates: Callable[[float], list[float]]


def rotation_and_scales(p: list[Tensor]) -> Tensor:
    """M = R S, as in the paper. p: log scales (N, 3), quaternions (N, 4)."""
    return rotation_from_quat(p[1]) * p[0].exp()[:, None, :]


def cholesky(p: list[Tensor]) -> Tensor:
    """M = L, lower triangular. p: log of the diagonal (N, 3); l21, l31, l32 (N, 3)."""
    return torch.diag_embed(p[0].exp()) + _below_diagonal(p[1])


def scaled_cholesky(p: list[Tensor]) -> Tensor:
    """M = D (I + N): as `cholesky`, but each row below the diagonal is relative to its diagonal."""
    eye = torch.eye(3, dtype=p[0].dtype)
    return p[0].exp()[:, :, None] * (eye + _below_diagonal(p[1]))


def _below_diagonal(entries: Tensor) -> Tensor:
    zero = torch.zeros_like(entries[:, 0])
    l21, l31, l32 = entries.unbind(dim=1)
    return torch.stack([zero, zero, zero, l21, zero, zero, l31, l32, zero], 1).reshape(-1, 3, 3)


def _quaternions(log_scales: Tensor) -> list[Tensor]:
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(log_scales)
    return [log_scales.expand(-1, 3).clone(), identity.repeat(len(log_scales), 1)]


def _triangular(log_scales: Tensor) -> list[Tensor]:
    diagonal = log_scales.expand(-1, 3).clone()
    return [diagonal, torch.zeros_like(diagonal)]


SHAPES = {
    # The paper's ratio of the rates of scales and quaternions is 5 : 1.
    "rotation and scales": Shape(_quaternions, rotation_and_scales, lambda scale: [1, 0.2]),
    # The entries below the diagonal are lengths: their rate is relative to a typical scale.
    "Cholesky": Shape(_triangular, cholesky, lambda scale: [1, scale]),
    "Cholesky, scaled rows": Shape(_triangular, scaled_cholesky, lambda scale: [1, 1]),
}


def project(means: Tensor, M: Tensor, opacity: Tensor, colors: Tensor, camera: Camera) -> Splats2D:
    """Splats of Gaussians with Σ = M Mᵀ: the geometry of `ops.project`, from another factor.

    means (N, 3), M (N, 3, 3), opacity (N,), colors (N, 3); all in the same floating dtype.
    """
    pose = camera.cam_from_world.to(means)
    W, t = pose[:, :3], pose[:, 3]
    x, y, z = (means @ W.T + t).unbind(dim=1)
    visible = (z > NEAR).nonzero()[:, 0]
    x, y, z, M = x[visible], y[visible], z[visible], M[visible]
    mean2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    margin_x, margin_y = 0.15 * camera.width, 0.15 * camera.height
    low_x, high_x = -(camera.cx + margin_x), camera.width - camera.cx + margin_x
    low_y, high_y = -(camera.cy + margin_y), camera.height - camera.cy + margin_y
    tx = (x / z).clamp(low_x / camera.fx, high_x / camera.fx)
    ty = (y / z).clamp(low_y / camera.fy, high_y / camera.fy)
    zero = torch.zeros_like(z)
    J = torch.stack([camera.fx / z, zero, -camera.fx * tx / z], dim=1)
    J = torch.stack([J, torch.stack([zero, camera.fy / z, -camera.fy * ty / z], dim=1)], dim=1)
    U = J @ W @ M
    xx, yy = (U[:, 0] ** 2).sum(dim=1) + LOW_PASS, (U[:, 1] ** 2).sum(dim=1) + LOW_PASS
    xy = (U[:, 0] * U[:, 1]).sum(dim=1)
    det = xx * yy - xy * xy
    conics = torch.stack([yy / det, -xy / det, xx / det], dim=1)
    return Splats2D.pack(mean2d, conics, opacity[visible], z, colors[visible])


@dataclass
class Result:
    shape: str
    rate: float
    seed: int
    psnr: float
    axis_ratio: float


def rotated(dataset: Dataset, seed: int) -> Dataset:
    """The dataset in a world that is rotated by a random rotation."""
    quat = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    R = rotation_from_quat(quat)  # new world from old world
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = R.T

    def moved(views):  # type: ignore[no-untyped-def]
        pose = [replace(v.camera, cam_from_world=v.camera.cam_from_world @ turn) for v in views]
        return [replace(v, camera=c) for v, c in zip(views, pose, strict=True)]

    assert dataset.points is not None
    points = replace(dataset.points, xyz=(dataset.points.xyz.double() @ R.T).float())
    return replace(dataset, train=moved(dataset.train), test=moved(dataset.test), points=points)


def train(dataset: Dataset, name: str, rate: float, seed: int, count: int, steps: int) -> Result:
    """Train `count` Gaussians for `steps` steps; the PSNR is the mean of the test views."""
    shape = SHAPES[name]
    random = torch.Generator().manual_seed(seed)
    dataset = rotated(dataset, seed)
    points = dataset.points
    assert points is not None
    chosen = torch.randperm(len(points), generator=random)[:count]
    start = Gaussians.from_points(replace(points, xyz=points.xyz[chosen], rgb=points.rgb[chosen]))
    log_scales = start.log_scales[:, :1]
    factors = shape.parameters(log_scales)
    means, logits = start.means, start.opacity_logits
    dc = start.sh_dc[:, 0].clone()
    learned = [means, logits, dc, *factors]
    for parameter in learned:
        parameter.requires_grad_()
    rates = recipe("classic").learning_rates
    shape_rates = [rate * share for share in shape.rates(float(log_scales.exp().median()))]
    all_rates = [rates.means * dataset.extent, rates.opacity_logits, rates.sh_dc, *shape_rates]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(learned, all_rates, strict=True)]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    # All rates decrease to a tenth in the last 40% of the steps, as in the recipe `default`.
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda i: 0.1 ** max(0.0, (i / steps - 0.6) / 0.4)
    )
    train_images, test_images = (ImageLoader(views) for views in (dataset.train, dataset.test))

    def image(camera: Camera) -> Tensor:
        colors = (0.5 + SH_C0 * dc).clamp(min=0)
        splats = project(means, shape.factor(factors), logits.sigmoid(), colors, camera)
        return ops.rasterize(splats, camera.width, camera.height)[0]

    order: list[int] = []
    for _ in range(steps):
        if not order:
            order = torch.randperm(len(dataset.train), generator=random).tolist()
        view = dataset.train[order.pop()]
        target = train_images.get(view, DOWNSCALE).rgb
        loss = ops.photometric_loss(image(view.camera.downscaled(DOWNSCALE)), target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()

    if not all(bool(parameter.isfinite().all()) for parameter in learned):
        return Result(name, rate, seed, -math.inf, math.inf)  # the training has diverged
    with torch.no_grad():
        values = []
        for view in dataset.test:
            target = test_images.get(view, DOWNSCALE).rgb.float() / 255
            error = (image(view.camera.downscaled(DOWNSCALE)).clamp(0, 1) - target).square().mean()
            values.append(float(-10 * error.log10()))
        axes = torch.linalg.svdvals(shape.factor(factors))
        ratio = float((axes[:, 0] / axes[:, 2]).median())
    return Result(name, rate, seed, statistics.mean(values), ratio)


def chosen(results: list[Result]) -> list[Result]:
    """The results with the best rate, one for each seed. Only rates of the last seed are chosen."""
    rates = {result.rate for result in results if result.seed == results[-1].seed}

    def mean(rate: float) -> float:
        return statistics.mean(result.psnr for result in results if result.rate == rate)

    best = max(rates, key=mean)
    return [result for result in results if result.rate == best]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("build/learn"))
    parser.add_argument("--gaussians", type=int, default=4000)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    photos, folder = options.data / "photos", options.data / "dataset"
    write_synthetic_photos(photos)
    make_dataset([photos], folder, DatasetOptions(), SILENT)
    dataset = load_dataset(folder)
    results = []
    for name in SHAPES:
        own: list[Result] = []
        rates: list[float] = list(RATES)
        for seed in SEEDS:
            for rate in rates:
                result = train(dataset, name, rate, seed, options.gaussians, options.steps)
                print(
                    f"{name:24} rate {rate:<6g} seed {seed}  {result.psnr:.2f} dB"
                    f"  axis ratio {result.axis_ratio:.1f}",
                    flush=True,
                )
                own.append(result)
            of_seed = own[-len(rates) :]
            best = max(result.psnr for result in of_seed)
            rates = [result.rate for result in of_seed if result.psnr > best - MUCH]
        selected = chosen(own)
        psnr = [result.psnr for result in selected]
        mean, spread = statistics.mean(psnr), statistics.stdev(psnr)
        print(f"{name}: rate {selected[0].rate:g}, {mean:.2f} ± {spread:.2f} dB\n")
        results += own
    rows = [vars(result) for result in results]
    for row in rows:  # JSON has no infinity: null if the training has diverged
        row.update({k: None for k in ("psnr", "axis_ratio") if not math.isfinite(row[k])})
    options.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
