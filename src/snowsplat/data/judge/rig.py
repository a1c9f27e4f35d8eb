"""`Rig`: the cameras of some views as arrays, to ask what would be if they were different."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from snowsplat.scene.camera import Camera


@dataclass(frozen=True)
class Rig:
    """Pinhole cameras of V views, in OpenCV axes. Positions in photos are relative to their size:
    (0, 0) is the upper left corner and (1, 1) the lower right one.
    """

    rotation: np.ndarray  # (V, 3, 3) float64, cam_from_world
    translation: np.ndarray  # (V, 3) float64, cam_from_world, world units
    focal: np.ndarray  # (V, 2) relative to width and height
    centre: np.ndarray  # (V, 2) the principal point, relative to width and height
    aspect: np.ndarray  # (V, 2) width and height in units of the longer side

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Rig:
        pose = torch.stack([camera.cam_from_world.detach() for camera in cameras]).cpu().numpy()
        size = np.array([(camera.width, camera.height) for camera in cameras], np.float64)
        return cls(
            pose[:, :, :3],
            pose[:, :, 3],
            np.array([(camera.fx, camera.fy) for camera in cameras]) / size,
            np.array([(camera.cx, camera.cy) for camera in cameras]) / size,
            size / size.max(1, keepdims=True),
        )

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def positions(self) -> np.ndarray:
        """(V, 3): the camera centres in the world frame."""
        return -np.einsum("vji,vj->vi", self.rotation, self.translation)

    def select(self, views: Sequence[int] | np.ndarray) -> Rig:
        """The cameras of some views."""
        i = np.asarray(views, np.int64)
        return Rig(
            self.rotation[i], self.translation[i], self.focal[i], self.centre[i], self.aspect[i]
        )

    def moved(self, rotation: np.ndarray, positions: np.ndarray) -> Rig:
        """The same lenses with other poses: cam_from_world rotations and camera centres."""
        translation = -np.einsum("vij,vj->vi", rotation, positions)
        return replace(self, rotation=rotation, translation=translation)

    def zoomed(self, factor: float) -> Rig:
        """The same poses with other focal lengths."""
        return replace(self, focal=self.focal * factor)

    def project(self, view: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions in the photo (P, 2), relative to its size, and depths (P,) of world points.

        The position of a point is meaningless if its depth is not positive.
        """
        points = xyz @ self.rotation[view].T + self.translation[view]
        depth = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            where = points[:, :2] / depth[:, None] * self.focal[view] + self.centre[view]
        return where, depth

    def inside(self, view: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `project`, only of the points that are in front of the camera and in the photo.

        Returns: their indices (N,), positions (N, 2) and depths (N,).
        """
        where, depth = self.project(view, xyz)
        with np.errstate(invalid="ignore"):
            seen = np.flatnonzero((depth > 0) & ((where > 0) & (where < 1)).all(1))
        return seen, where[seen], depth[seen]

    def rays(self, view: int, where: np.ndarray) -> np.ndarray:
        """(N, 2) in the normalised image plane, of positions in the photo (N, 2)."""
        return np.asarray((where - self.centre[view]) / self.focal[view])
