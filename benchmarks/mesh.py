"""Meshes of procedural scenes with known surfaces: accuracy, completeness, F-score.

    python benchmarks/mesh.py --out OUT                       dataset, training, mesh, measures
    python benchmarks/mesh.py --out OUT --scenes table --methods mean poisson --surfaces

The photos are ray traced; poses are exact, points have errors of some millimetres. A point of the
mesh is accurate if a true surface that a photo shows is within 0.5% of the extent, the longest side
of the box of the true points; a true point that two photos show is complete if the mesh is within
the same distance. Rays decide what a photo shows.
Methods: `median`, that of `snowsplat mesh`; `mean`, with the mean depth of each pixel; `reference`,
the plain method: depths that no photo confirms, in the field of the PyTorch reference; `poisson`,
Open3D's surface of the points.
"""

import argparse
import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from mesh_scenes import SCENES, Procedural, true_points, write_dataset
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference
from snowsplat.pipeline import mesh as pipeline_mesh
from snowsplat.pipeline.mesh import surface_of
from snowsplat.pipeline.options.scene import MeshOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import TrainedScene, load_trained
from snowsplat.pipeline.train import train
from snowsplat.scene.mesh import Mesh

_SAMPLES = 60_000
_THRESHOLD = 0.005  # of the extent
_BLOCKS = 2048  # of voxels


@dataclass(frozen=True)
class Score:
    accuracy: float  # share of the mesh that is near a true surface
    completeness: float  # share of the true surface that is near the mesh
    error: float  # metres: median distance of the mesh from the nearest true point, if near
    triangles: int
    seconds: float  # processor time

    @property
    def f(self) -> float:
        both = self.accuracy + self.completeness
        return 2 * self.accuracy * self.completeness / both if both else 0.0


def distances(points: np.ndarray, others: np.ndarray, limit: float) -> np.ndarray:
    """(P,): the distance of each point from the nearest of the others; inf if above ``limit``."""
    low = np.minimum(points.min(0), others.min(0)) - limit
    own, cells = (((p - low) / limit).astype(np.int64) for p in (points, others))
    weights = np.array([1 << 42, 1 << 21, 1])
    keys = cells @ weights
    order = np.argsort(keys, kind="stable")
    keys, others = keys[order], others[order]
    nearest = np.full(len(points), np.inf)
    for shift in itertools.product((-1, 0, 1), repeat=3):
        key = (own + shift) @ weights
        start, end = np.searchsorted(keys, key, "left"), np.searchsorted(keys, key, "right")
        for i in range(int((end - start).max(initial=0))):
            rows = (start + i < end).nonzero()[0]
            gap = np.linalg.norm(points[rows] - others[start[rows] + i], axis=1)
            nearest[rows] = np.minimum(nearest[rows], gap)
    return np.where(nearest <= limit, nearest, np.inf)


def sampled(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """(P, 3): random points on a mesh, one for each square of ``spacing``."""
    random = np.random.default_rng(0)
    corners = vertices[faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1) / 2
    count = int(area.sum() / spacing**2)
    chosen = random.choice(len(faces), count, p=area / area.sum())
    return (random.dirichlet((1, 1, 1), count)[:, :, None] * corners[chosen]).sum(1)


def near_cameras(points: np.ndarray, scene: TrainedScene, reach: float) -> np.ndarray:
    """(P,) bool: whether a point is in a photo, hidden or not, and within the reach."""
    near = np.zeros(len(points), bool)
    for view in scene.dataset.train:
        pixel, depth = view.camera.project(torch.from_numpy(points))
        size = torch.tensor([view.camera.width, view.camera.height])
        near |= (
            (depth > 0) & (depth < reach) & (pixel >= 0).all(1) & (pixel < size).all(1)
        ).numpy()
    return near


def score(
    mesh: tuple[np.ndarray, np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    scene: TrainedScene,
    reach: float,
    seconds: float,
) -> Score:
    """``truth``: of `true_points`."""
    limit = _THRESHOLD * float(np.ptp(truth[1], axis=0).max())
    vertices, faces = mesh
    faces = faces[near_cameras(vertices.astype(np.float64), scene, reach)[faces].all(1)]
    points = sampled(vertices, faces, 0.25 * limit)
    off = distances(points[:: max(1, len(points) // _SAMPLES)], truth[0], limit)
    missed = distances(truth[1][:: max(1, len(truth[1]) // _SAMPLES)], points, limit)
    near = np.isfinite(off)
    median = float(np.median(off[near])) if near.any() else np.inf
    shares = float(near.mean()), float(np.isfinite(missed).mean())
    return Score(*shares, median, len(mesh[1]), seconds)


def poisson(scene: TrainedScene) -> tuple[np.ndarray, np.ndarray]:
    """Open3D's screened Poisson surface of the points of the dataset."""
    import open3d

    cloud = open3d.geometry.PointCloud()
    assert scene.dataset.points is not None
    cloud.points = open3d.utility.Vector3dVector(scene.dataset.points.xyz.double().numpy())
    cloud.estimate_normals()
    middle = torch.stack([v.camera.position for v in scene.dataset.train]).mean(0)
    cloud.orient_normals_towards_camera_location(middle.numpy())
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=9)
    mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(np.asarray(density), 0.05))
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def with_mean(*arguments: object) -> tuple[Tensor, Tensor, Tensor]:
    median, mean, alpha = _MEDIAN(*arguments)  # type: ignore[arg-type]
    del median
    return mean / alpha[..., None].clamp_min(1e-6), mean, alpha


_MEDIAN = ops.rasterize_median


def with_reference(sums: Tensor, origins: Tensor, *arguments: Any) -> None:
    """`reference.fuse_depth` of some blocks at a time, which needs less memory."""
    for own, at in zip(sums.split(_BLOCKS), origins.split(_BLOCKS), strict=True):
        reference.fuse_depth(own, at, *arguments)


def made(method: str, scene: TrainedScene) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a method."""

    def ours() -> tuple[np.ndarray, np.ndarray]:
        mesh: Mesh = surface_of(scene, MeshOptions()).mesh
        return mesh.vertices, mesh.faces

    if method == "poisson":
        return poisson(scene)
    if method == "mean":
        with patch.object(ops, "rasterize_median", with_mean):
            return ours()
    if method == "reference":
        plain = patch.object(pipeline_mesh, "confirm_by_photos", lambda *_: None)
        with plain, patch.object(ops, "fuse_depth", with_reference):
            return ours()
    return ours()


def output_of(name: str, options: argparse.Namespace) -> Path:
    return Path(options.out / f"out_{name}{'_surfaces' if options.surfaces else ''}")


def measured(name: str, scene: Procedural, options: argparse.Namespace) -> None:
    truth_file = options.out / f"{name}_truth.npz"
    if not truth_file.exists():
        found = true_points(scene, options.width, options.points)
        np.savez_compressed(truth_file, one=found[0], two=found[1])
    with np.load(truth_file) as stored:
        truth = stored["one"], stored["two"]
    trained = load_trained(output_of(name, options))
    for method in options.methods:
        before = time.process_time()
        mesh = made(method, trained)
        result = score(mesh, truth, trained, scene.reach, time.process_time() - before)
        print(
            f"| {name} | {method} | {result.f:.3f} | {result.accuracy:.3f} | "
            f"{result.completeness:.3f} | {1000 * result.error:.1f} | {result.triangles:,} | "
            f"{result.seconds:.0f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=["table", "room"], choices=list(SCENES))
    parser.add_argument("--methods", nargs="*", default=["median", "mean", "reference", "poisson"])
    parser.add_argument("--width", type=int, default=480, help="of the photos, pixels")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--surfaces", action="store_true", help="train flat Gaussians")
    parser.add_argument("--points", type=int, default=500_000, help="true points, drawn")
    options = parser.parse_args()
    print("| scene | method | F | accuracy | completeness | error, mm | triangles | CPU s |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for name in options.scenes:
        scene = SCENES[name]()
        output = output_of(name, options)
        if not output.exists():
            write_dataset(options.out / name, scene, options.width)
            settings = {"iterations": options.iterations, "surfaces": options.surfaces}
            train(options.out / name, output, TrainOptions(settings=settings))
        measured(name, scene, options)


if __name__ == "__main__":
    main()
