"""The pinhole camera, in OpenCV axes: x right, y down, z forward.

The near plane is relative to the scene, because the unit of a scene is not ours to choose.
Gaussians nearer than the near plane are not drawn: their projections would be huge, and the linear
approximation of EWA splatting does not hold there. The implementation of the paper uses 0.2 world
units. In the unit of COLMAP, a scene is usually 3 to 5 units away; in metres, it may be 0.3 units
or 300. So the near plane is 0.2 · 2ᵏ, where 2ᵏ is about the distance of the scene divided by the
usual distance. Thus usual scenes have the near plane of the paper, and a scene that is scaled by a
power of two has the same images.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.geometry import Similarity, invert_rigid, transform_points
from snowsplat.scene.origin import Origin
from snowsplat.util.image_size import scaled_size

#: The near plane of the implementation of the paper, in world units.
NEAR = 0.2
# The distance of scenes for which `NEAR` is used is between this and twice this, in world units.
_USUAL_DISTANCE = 2.8
# What is nearer than nearly everything is at least this many times as far as the near plane.
_NEAREST = 3.0
# For a scene whose cameras are not known, relative to the distance of its middle.
_OF_DISTANCE = 0.05


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera and its pose.

    A point x_cam = R x_world + t in front of the camera (z > 0) projects to
    (fx·x/z + cx, fy·y/z + cy), in pixels from the upper left corner of the image. The centre of the
    pixel in column i and row j is at (i + 0.5, j + 0.5). This is also COLMAP's convention.

    Raises:
        ValueError: a size, a focal length or the near plane is not positive, or the shape of the
            pose is not (3, 4).
    """

    width: int  # pixels
    height: int  # pixels
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels
    cy: float  # pixels
    cam_from_world: Tensor  # (3, 4) float64, [R | t]; may require grad
    near: float = NEAR  # world units, > 0; nearer Gaussians are not drawn; see `near_plane`

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a camera needs a positive size, not {self.width}x{self.height}")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"a camera needs positive focal lengths, not {self.fx}, {self.fy}")
        if not self.near > 0:
            raise ValueError(f"a camera needs a positive near plane, not {self.near}")
        if self.cam_from_world.shape != (3, 4):
            raise ValueError(f"cam_from_world is (3, 4), not {tuple(self.cam_from_world.shape)}")

    def is_finite(self) -> bool:
        """Whether intrinsics and pose are finite in float32, the precision of the kernels."""
        pose = self.cam_from_world.detach().reshape(-1).tolist()
        return all(abs(n) < 1e38 for n in (self.fx, self.fy, self.cx, self.cy, *pose))

    @property
    def world_from_cam(self) -> Tensor:
        """(3, 4), the inverse of ``cam_from_world``."""
        return invert_rigid(self.cam_from_world)

    @property
    def position(self) -> Tensor:
        """(3,): the camera centre in the world frame."""
        return self.world_from_cam[:, 3]

    @property
    def intrinsics(self) -> Tensor:
        """(3, 3) float64: K, which maps a point of the camera frame to (x·z, y·z, z) in pixels."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def scaled(self, width: int, height: int) -> Camera:
        """The same view at another image size: intrinsics are scaled by the ratio of each axis."""
        sx, sy = width / self.width, height / self.height
        lens = self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy
        return Camera(width, height, *lens, self.cam_from_world, self.near)

    def reduced(self, longest: int) -> Camera:
        """The same view in an image whose longer side has at most ``longest`` pixels."""
        return self.scaled(*scaled_size(self.width, self.height, longest))

    def to(self, device: torch.device) -> Camera:
        """This camera with its pose on ``device``, as rendering on that device needs it."""
        return dataclasses.replace(self, cam_from_world=self.cam_from_world.to(device))

    def transformed(self, change: Similarity) -> Camera:
        """The camera that shows the same in the new world frame of ``change``."""
        pose = change.apply_to_poses(self.cam_from_world)
        return dataclasses.replace(self, cam_from_world=pose, near=change.scale * self.near)

    def seen_from(self, origin: Origin) -> Camera:
        """The same camera in a world frame whose 0 is at ``origin`` in this one."""
        pose = self.cam_from_world
        by = torch.tensor(origin, dtype=pose.dtype, device=pose.device)
        moved = pose[:, 3] + pose[:, :3] @ by
        return dataclasses.replace(self, cam_from_world=torch.cat([pose[:, :3], moved[:, None]], 1))

    def downscaled(self, factor: int) -> Camera:
        """The camera of the image that `ImageLoader.get` returns with ``downscale=factor``."""
        return self.scaled(max(1, self.width // factor), max(1, self.height // factor))

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points (P, 3) to pixel positions (P, 2) and depths (P,), the camera's z.

        The position of a point is meaningless if its depth is not positive. The results are on the
        device of the points.
        """
        x_cam = transform_points(self.cam_from_world.to(points), points)
        depth = x_cam[:, 2]
        focal, centre = points.new_tensor([[self.fx, self.fy], [self.cx, self.cy]])
        return x_cam[:, :2] / depth[:, None] * focal + centre, depth

    def sees(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The depths (P,) of world points (P, 3), and whether they are in the image."""
        pixel, depth = self.project(points)
        size = pixel.new_tensor([self.width, self.height])
        return depth, (depth > 0.0) & ((pixel >= 0.0) & (pixel < size)).all(1)

    def depths_in_view(self, points: Tensor) -> Tensor:
        """The depths (V,) of those of the world points (P, 3) that are in the image; in order."""
        depth, inside = self.sees(points)
        return depth[inside]


def near_of_overview(distance: float) -> float:
    """The near plane of a camera that shows a scene from ``distance``, in world units.

    Such a scene is rendered as it is, so no compatibility with a training asks for `NEAR`.
    """
    return _OF_DISTANCE * distance if 0 < distance < math.inf else NEAR


def near_plane(distance: float, nearest: float | None = None) -> float:
    """The depth below which no Gaussian is drawn, in world units.

    Args:
        distance: the usual depth of what the cameras see, in world units, > 0.
        nearest: the depth that nearly everything exceeds, if it is known.
    """
    ratio = distance / _USUAL_DISTANCE
    if nearest is not None:
        ratio = min(ratio, nearest / (_NEAREST * NEAR))
    return math.ldexp(NEAR, math.floor(math.log2(ratio))) if 0 < ratio < math.inf else NEAR
