"""Workloads for measurements: scenes that are similar to trained scenes, but not trained.

The points are those of a real garden (`../shared/captures/garden_points.npz` beside the checkout,
or the file named by SNOWSPLAT_GARDEN). Each Gaussian is a flat disc on the surface of its
neighbours. Sizes, opacities and colours are distributed as in trained scenes. Without the file, a
procedural courtyard with similar statistics is used, and `Workload.source` says so: results of the
two must not be compared.
"""

import functools
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.scene.geometry import look_at, morton_order, quat_from_rotation

GARDEN = Path(__file__).resolve().parents[2] / "shared" / "captures" / "garden_points.npz"

#: name -> Gaussians, width, height. "small" has more Gaussians than pixels: most SIMD lanes are
#: idle, as in the first steps of coarse-to-fine training.
SIZES = {
    "tiny": (2_000, 96, 54),
    "10k": (10_000, 240, 135),
    "50k": (50_000, 480, 270),
    "200k": (200_000, 960, 540),
    "1m": (1_000_000, 1920, 1080),
    "3m": (3_000_000, 1920, 1080),
    "small": (120_000, 240, 135),
}


@dataclass(frozen=True)
class Workload:
    """Gaussians in Morton order, as the trainer stores them, and a camera that sees them."""

    name: str
    source: str  # of the points
    gaussians: Gaussians
    camera: Camera


@dataclass(frozen=True)
class Cloud:
    """Coloured points and a view of them; focal lengths in units of the image width."""

    source: str
    xyz: Tensor  # (P, 3) float32
    rgb: Tensor  # (P, 3) float32, 0..1
    cam_from_world: Tensor  # (3, 4) float64
    focal: tuple[float, float]


def workload(name: str, seed: int = 0) -> Workload:
    """The workload of one of `SIZES`; deterministic on every machine."""
    count, width, height = SIZES[name]
    cloud = _cloud()
    gaussians = _gaussians_on_surface(count, np.random.default_rng(seed))
    fx, fy = (focal * width for focal in cloud.focal)
    camera = Camera(width, height, fx, fy, width / 2, height / 2, cloud.cam_from_world)
    return Workload(name, cloud.source, gaussians.select(morton_order(gaussians.means)), camera)


def _gaussians_on_surface(count: int, random: np.random.Generator) -> Gaussians:
    """``count`` Gaussians of SH degree 3 along the surface of the cloud.

    If there are more Gaussians than points, points are used several times, with random offsets in
    their neighbourhood. Sizes are proportional to the inverse root of the count, so the surface is
    covered equally.
    """
    cloud, (axes, spacing) = _cloud(), _surface()
    points = len(cloud.xyz)
    passes = [random.permutation(points) for _ in range(-(-count // points))]
    chosen = np.concatenate(passes)[:count]
    axes, spacing = axes[chosen], spacing[chosen]

    def normal(*shape: int) -> Tensor:
        return torch.from_numpy(random.standard_normal((count, *shape), dtype=np.float32))

    means = cloud.xyz[chosen]
    if count > points:
        strewn = 0.5 * normal(3) * torch.tensor([0.15, 1.0, 1.0])
        means = means + spacing[:, None] * torch.einsum("nij,nj->ni", axes, strewn)
    flat = torch.stack([0.15 * (0.5 * normal()).exp(), 0.6 * (0.4 * normal()).exp()], dim=1)
    shape = torch.cat([flat, torch.ones(count, 1)], dim=1)
    size = spacing * math.sqrt(points / count) * (0.55 * normal()).exp()
    # A third is nearly opaque, the others are transparent.
    opaque = torch.from_numpy(random.random(count) < 0.35)
    logits = 1.5 * normal() + torch.where(opaque, 2.5, -1.2)
    return Gaussians(
        means=means.contiguous(),
        log_scales=(size[:, None] * shape).log(),
        quats=quat_from_rotation(axes).contiguous(),
        opacity_logits=logits,
        sh_dc=((cloud.rgb[chosen] - 0.5) / SH_C0)[:, None].contiguous(),
        sh_rest=0.05 * normal(15, 3),
    )


@functools.cache
def _surface() -> tuple[Tensor, Tensor]:
    """For each point of the cloud, the axes of its surface (P, 3, 3) and the spacing (P,)."""
    xyz = _cloud().xyz
    # Root mean square distance to 3 neighbours, limited for outliers.
    spacing = ops.neighbours(xyz, k=3).square().mean(dim=1).sqrt()
    return _surface_axes(xyz), spacing.clamp(1e-4, float(spacing.quantile(0.98)))


def _surface_axes(xyz: Tensor, k: int = 8, window: int = 16) -> Tensor:
    """(P, 3, 3) rotations whose columns are the principal axes of near points, normal first.

    Near points are the k nearest of the 2 · ``window`` neighbours along a Morton curve. They are
    nearly the nearest of all points, which is sufficient to estimate the surface.
    """
    order = morton_order(xyz)
    along = xyz[order]
    steps = torch.cat([torch.arange(-window, 0), torch.arange(1, window + 1)])
    axes = torch.empty(len(xyz), 3, 3)
    for start in range(0, len(xyz), 16384):
        rows = torch.arange(start, min(start + 16384, len(xyz)))
        # At the ends of the curve, the same number of neighbours is taken from one side.
        middle = rows.clamp(window, max(window, len(xyz) - window - 1))
        near = along[(middle[:, None] + steps).clamp(0, len(xyz) - 1)]
        distance = (near - along[rows, None]).square().sum(dim=2)
        nearest = distance.topk(k, largest=False).indices
        near = near.gather(1, nearest[:, :, None].expand(-1, -1, 3))
        near = near - near.mean(dim=1, keepdim=True)
        vectors = torch.linalg.eigh(torch.einsum("nki,nkj->nij", near, near)).eigenvectors
        vectors[:, :, 0] *= torch.linalg.det(vectors).sign()[:, None]
        axes[order[rows]] = vectors
    return axes


@functools.cache
def _cloud() -> Cloud:
    path = Path(os.environ.get("SNOWSPLAT_GARDEN", GARDEN))
    if not path.is_file():
        return courtyard()
    with np.load(path) as file:
        K, width = file["Ks"][0], float(file["width"])
        return Cloud(
            source="garden points",
            xyz=torch.from_numpy(file["means3d"]),
            rgb=torch.from_numpy(file["colors"]).float() / 255,
            cam_from_world=torch.from_numpy(file["viewmats"][0, :3]).double(),
            focal=(float(K[0, 0]) / width, float(K[1, 1]) / width),
        )


def courtyard(points: int = 138_766, seed: int = 0) -> Cloud:
    """A round table on rough ground in front of hedges: replaces the garden."""
    random = np.random.default_rng(seed)
    ground, table, vase, hedge = np.split(
        np.arange(points), np.cumsum([int(points * share) for share in (0.45, 0.47, 0.04)])
    )
    turn = random.uniform(0, 2 * np.pi, points)
    height = np.zeros(points)
    radius = np.zeros(points)
    radius[ground] = 4 * random.random(len(ground)) ** 0.65
    radius[table] = 0.6 * np.sqrt(random.random(len(table)))
    height[table] = 0.45
    rise = random.random(len(vase))
    radius[vase], height[vase] = 0.12 + 0.04 * np.sin(7 * rise), 0.45 + 0.35 * rise
    radius[hedge] = 4 + 0.5 * random.exponential(size=len(hedge))
    height[hedge] = 2.5 * random.random(len(hedge))
    xyz = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    rough = np.full(points, 0.01)
    rough[table], rough[vase], rough[hedge] = 0.002, 0.002, 0.08
    xyz += rough[:, None] * random.standard_normal((points, 3))
    waves = np.sin(xyz @ random.normal(0, 6, (3, 3)) + random.uniform(0, 6, 3))
    rgb = 0.45 + 0.2 * waves + 0.08 * random.standard_normal((points, 3))
    return Cloud(
        source="procedural courtyard (no garden points here)",
        xyz=torch.from_numpy(xyz).float(),
        rgb=torch.from_numpy(rgb).float().clamp(0, 1),
        cam_from_world=look_at(
            torch.tensor([-1.3, 0.2, 1.0]).double(),
            torch.tensor([0.0, 0.0, 0.4]).double(),
            torch.tensor([0.0, 0.0, 1.0]).double(),
        ),
        focal=(0.742, 0.742),
    )
