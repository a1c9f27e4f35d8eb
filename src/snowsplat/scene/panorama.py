"""`PanoramaRenderer`: Gaussians and a place -> an equirectangular image of all directions.

The six sides of a cube are rendered, each a little larger than its side. Splats are flattened onto
the plane of a side, so two sides differ slightly where they meet. There, the image changes
gradually from one to the other.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render

# Half the width of a rendered side, in units of half the side of the cube: 5 degrees more.
_REACH = math.tan(math.radians(50))
# side_from_panorama of the six sides: ahead, right, behind, left, up, down. Rows are x, y and z of
# the side; in the frame of the panorama, x is right, y down and z ahead.
_SIDES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
)


class PanoramaRenderer:
    """Renders panorama images of one size.

    Attributes:
        width, height: pixels; a column is a longitude and a row a latitude, with the direction
            ahead at the centre.

    Raises: ValueError: a width that is not a positive multiple of 4.
    """

    def __init__(self, width: int, device: torch.device | None = None) -> None:
        if width < 4 or width % 4:
            raise ValueError(f"a panorama needs a width that is a multiple of 4, not {width}")
        self.width, self.height = width, width // 2
        focal = width / (2 * math.pi)  # at the centre of a side as many pixels as at the equator
        self._size = 2 * math.ceil(focal * _REACH)
        self._focal = focal
        longitude = (torch.arange(width, device=device) + 0.5) * (2 * math.pi / width) - math.pi
        latitude = (torch.arange(width // 2, device=device) + 0.5) * (2 * math.pi / width)
        latitude = latitude[:, None] - math.pi / 2
        level = latitude.cos()
        rays = torch.stack(
            [level * longitude.sin(), latitude.sin().expand(-1, width), level * longitude.cos()], -1
        )
        self._sides = [self._side(torch.tensor(side).to(rays), rays) for side in _SIDES]
        total = torch.zeros(width // 2, width, device=device)
        for rows, columns, weight, _ in self._sides:
            total[rows, columns] += weight
        for rows, columns, weight, _ in self._sides:
            weight /= total[rows, columns]

    def _side(self, side: Tensor, rays: Tensor) -> tuple[slice, slice, Tensor, Tensor]:
        """The rows and columns of the panorama that show a side, the weights (h, w) of the side
        there, and the positions (1, h, w, 2) in its image, for `grid_sample`.
        """
        x, y, z = (rays @ side.T).unbind(-1)
        away = torch.where(z > 0, torch.maximum(x.abs(), y.abs()) / z, math.inf)
        weight = (_REACH - away).clamp(0, _REACH - 1 / _REACH)
        rows, columns = (weight.amax(dim) > 0 for dim in (1, 0))
        box = (_span(rows), _span(columns))
        scale = 2 * self._focal / self._size
        grid = torch.stack([x[box] / z[box] * scale, y[box] / z[box] * scale], -1)[None]
        return *box, weight[box].clone(), grid.nan_to_num(2.0).clamp(-2, 2)

    def render(
        self, gaussians: Gaussians, cam_from_world: Tensor, background: Tensor | None = None
    ) -> Tensor:
        """(H, W, 3) in [0, ∞): the Gaussians seen from a place, on the device of the Gaussians.

        ``cam_from_world``: (3, 4) float64; its z is the direction ahead, y is down. ``background``:
        (3,) RGB; None is black.
        """
        image = gaussians.means.new_zeros(self.height, self.width, 3)
        middle = self._size / 2
        for side, (rows, columns, weight, grid) in zip(_SIDES, self._sides, strict=True):
            pose = torch.tensor(side).to(cam_from_world) @ cam_from_world
            camera = Camera(self._size, self._size, self._focal, self._focal, middle, middle, pose)
            seen = render(gaussians, camera, background).image.permute(2, 0, 1)[None]
            part = F.grid_sample(seen, grid, "bicubic", "border", align_corners=False)[0]
            image[rows, columns] += weight[..., None] * part.permute(1, 2, 0)
        return image.clamp_(min=0)


def _span(used: Tensor) -> slice:
    indices = used.nonzero()
    return slice(int(indices[0]), int(indices[-1]) + 1)


def level_pose(cam_from_world: Tensor, up: np.ndarray) -> Tensor:
    """(3, 4) float64: the camera turned so that its horizon is level; its heading is kept.

    ``up``: (3,) unit vector in the world frame.
    """
    rotation, shift = cam_from_world.double()[:, :3].cpu(), cam_from_world.double()[:, 3].cpu()
    position, upward = -rotation.T @ shift, torch.from_numpy(np.asarray(up, np.float64))
    ahead = rotation[2]
    if abs(float(ahead @ upward)) > 0.98:  # it looks straight down or up
        ahead = rotation[1] * float(ahead @ upward)
    ahead = ahead - (ahead @ upward) * upward
    return look_at(position, position + ahead, upward)
