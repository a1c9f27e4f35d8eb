"""`random_points`: a start that needs neither points nor depths, only cameras and photos."""

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.frame.bounds import scene_bounds
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import transform_points
from snowsplat.training.starts.photos import reduced_photo, usable_pixels

#: Number of candidates per point; those that fewest views show are left out.
_CANDIDATES = 2
#: Photos are reduced so that their longer side has at most this number of pixels.
_LONGER_SIDE = 320
#: The nearest and the farthest depth, in units of the distance to the far side of the scene.
_NEAREST, _FARTHEST = 0.05, 3.0


def random_points(
    dataset: Dataset, images: Photos, count: int, generator: torch.Generator
) -> Points:
    """``count`` points at random positions in the union of the view frusta, in the world frame.

    A point lies on the ray of a random pixel of a random training photo and has its colour. The
    inverse of its depth is uniformly distributed: far away, a view needs fewer points per unit of
    depth. The range of depths is estimated from the cameras alone. Points that only one view shows
    are avoided; masked and transparent pixels are not used.

    Args:
        generator: a random generator on the CPU.
    """
    views = dataset.train
    cameras = [view.camera for view in views]
    bounds = scene_bounds(cameras).to(torch.float64)
    chosen = torch.randint(len(views), (_CANDIDATES * count,), generator=generator)
    numbers = torch.bincount(chosen, minlength=len(views)).tolist()
    xyz, rgb = [torch.zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.uint8)]
    for view, number in zip(views, numbers, strict=True):
        camera = view.camera.reduced(_LONGER_SIDE)
        photo = reduced_photo(view, images, camera.width, camera.height).to(torch.device("cpu"))
        usable = usable_pixels(photo)
        if usable is None or not usable.any():
            usable = torch.ones(camera.height, camera.width, dtype=torch.bool)
        y, x = usable.nonzero(as_tuple=True)
        pixel = torch.randint(len(y), (number,), generator=generator)
        y, x = y[pixel], x[pixel]
        far, near = (1.0 / depth for depth in _depths(camera, bounds))
        inverse = near + (far - near) * torch.rand(number, generator=generator, dtype=torch.float64)
        xyz.append(_on_rays(camera, x, y, 1.0 / inverse, generator))
        rgb.append(photo.rgb[y, x])
    points = Points(torch.cat(xyz), torch.cat(rgb))
    # Points that several views show come first; the others are used if there are too few.
    order = torch.randperm(len(points), generator=generator)
    seen = torch.zeros(len(points), dtype=torch.int64)  # by this number of views
    for camera in cameras:
        seen += camera.sees(points.xyz[order])[1]
    alone = seen < min(2, len(views))
    order = order[torch.argsort(alone.to(torch.uint8), stable=True)][:count]
    return Points(points.xyz[order], points.rgb[order])


def _depths(camera: Camera, bounds: Tensor) -> tuple[float, float]:
    """The nearest and the farthest depth at which a camera may show something."""
    centre, radius = bounds.mean(0), 0.5 * float((bounds[1] - bounds[0]).norm())
    distance = float((camera.position.to(torch.float64) - centre).norm())
    far = distance + radius
    return max(distance - radius, _NEAREST * far), _FARTHEST * far


def _on_rays(
    camera: Camera, x: Tensor, y: Tensor, depth: Tensor, generator: torch.Generator
) -> Tensor:
    """(P, 3) float32: points at a random position in each pixel, at the given depths."""
    inside = torch.rand(2, len(x), generator=generator, dtype=torch.float64)
    right = (x + inside[0] - camera.cx) / camera.fx * depth
    down = (y + inside[1] - camera.cy) / camera.fy * depth
    cam = torch.stack([right, down, depth], dim=1)
    return transform_points(camera.world_from_cam.to(torch.float64), cam).to(torch.float32)
