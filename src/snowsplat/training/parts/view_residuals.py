"""How well the scene explains each place of each photo, and the same place in other photos.

A photo is divided into cells of `CELL` × `CELL` pixels. The residual of a cell is the difference
between the mean colours of the photo and of the rendering, so detail that is too fine for the scene
does not count. The depth of the rendering tells which cells of other photos show the same place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

from snowsplat.evaluation.renderings import Rendering
from snowsplat.scene.camera import Camera
from snowsplat.training.starts.depth_map import DepthMap

#: Side of a cell, in pixels of the photo.
CELL = 8
#: A cell is compared with the cells of this number of views whose cameras are nearest.
_NEIGHBOURS = 32
#: The usual residual of a place is this quantile of its residuals in these views. It is not the
#: median, because gloss and shadows also change only between some of the views.
_USUAL = 0.75
#: A cell of another view shows the same place if the two depths differ by at most this share.
_SAME_DEPTH = 0.2
#: A cell has a depth if its rendering is at least this opaque.
_OPAQUE = 0.5
#: For the fit of gain and offset, the cells with the largest residuals are left out.
_FITTED, _FITS = 0.8, 3
_GAINS = (0.5, 2.0)
#: The smallest variance in a correlation: that of a plain surface with the noise of a photo.
_PLAIN = 1e-4


@dataclass(frozen=True)
class CellMap:
    """The cells of one view, on the device of its rendering."""

    residual: Tensor  # (h, w) float32 in 0..1, largest of the channels; 0 at masked cells
    correlation: Tensor  # (h, w) float32 in -1..1, of photo and rendering around each cell
    places: DepthMap  # of the same size


def cell_size(camera: Camera) -> tuple[int, int]:
    """Height and width of the map of a view."""
    reduced = camera.downscaled(CELL)
    return reduced.height, reduced.width


def cell_map(rendering: Rendering) -> CellMap:
    """The cells of a view; its rendering has a depth."""
    small = rendering.view.camera.downscaled(CELL)
    size = (small.height, small.width)
    output, target = rendering.output, rendering.photo.permute(2, 0, 1)
    assert output.depth is not None
    planes = [
        rendering.image.permute(2, 0, 1),
        target,
        output.alpha[None],
        output.depth[None],
    ]
    seen, shown, opaque, z = (adaptive_avg_pool2d(plane, size) for plane in planes)
    usable = torch.ones(size, dtype=torch.bool, device=z.device)
    if rendering.mask is not None:
        mask = rendering.mask[None].to(torch.float32)
        usable = adaptive_avg_pool2d(mask, size)[0] == 1.0
    residual = torch.where(usable, _residual(seen, shown, usable), 0.0)
    known = (opaque[0] >= _OPAQUE) & (z[0] > 0.0)
    correlation = _correlation(output.image.mean(2), target.mean(0), size)
    return CellMap(
        residual, correlation, DepthMap(small, torch.where(known, opaque[0] / z[0], 0.0))
    )


def _residual(image: Tensor, photo: Tensor, usable: Tensor) -> Tensor:
    """(h, w): the largest difference of the channels (3, h, w), apart from a gain and an
    offset of each channel.

    They are fitted by least squares to the cells with the smallest residuals, so that neither the
    exposure of the photo counts nor what the residuals are to find.
    """
    fitted = usable
    residual = (image - photo).abs().amax(0)
    for _ in range(_FITS):
        if not bool(fitted.any()):
            return residual
        x, y = image[:, fitted].double(), photo[:, fitted].double()
        x_mean, y_mean = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
        x, y = x - x_mean, y - y_mean
        gain = (x * y).sum(1, keepdim=True) / x.square().sum(1, keepdim=True).clamp_min(1e-9)
        gain = gain.clamp(*_GAINS)
        offset = y_mean - gain * x_mean
        rest = gain[:, :, None] * image + offset[:, :, None] - photo
        residual = rest.abs().amax(0).to(torch.float32)
        fitted = usable & (residual <= torch.quantile(residual[usable], _FITTED))
    return residual


def _correlation(image: Tensor, photo: Tensor, size: tuple[int, int]) -> Tensor:
    """(h, w): the correlation of two images (H, W) in the 3 × 3 cells around each cell."""
    moments = torch.stack([image, photo, image * image, photo * photo, image * photo])
    moments = adaptive_avg_pool2d(moments, size)
    x, y, xx, yy, xy = avg_pool2d(moments, 3, stride=1, padding=1, count_include_pad=False)
    variances = (xx - x * x).clamp_min(0.0) * (yy - y * y).clamp_min(0.0)
    return (xy - x * y) / variances.sqrt().clamp_min(_PLAIN)


def residuals_elsewhere(
    maps: Sequence[CellMap], ignored: Sequence[Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """For each map, the usual residual (h, w) of its places in other views, and the number (h, w)
    of these views. The residual is infinite if there are none.

    ``ignored``: (h, w) bool for each map, cells that do not count in other views; on the device of
    the maps.
    """
    cameras = [cells.places.camera for cells in maps]
    positions = torch.stack([camera.position for camera in cameras])
    to_image = torch.stack([camera.intrinsics @ camera.cam_from_world for camera in cameras])
    size = torch.tensor([[camera.width, camera.height] for camera in cameras])
    # The cells of all maps, one after the other.
    start = size.prod(1).cumsum(0) - size.prod(1)
    device = maps[0].residual.device
    to_image, size, start = to_image.to(device, torch.float32), size.to(device), start.to(device)
    inverse_depth = torch.cat([cells.places.inverse_depth.flatten() for cells in maps])
    residual = torch.cat([cells.residual.flatten() for cells in maps])
    residual[torch.cat([cells.flatten() for cells in ignored])] = torch.nan
    found = []
    for i, cells in enumerate(maps):
        order = torch.argsort((positions - positions[i]).norm(dim=1), stable=True)
        others = order[order != i][:_NEIGHBOURS].to(device)
        known = cells.places.inverse_depth > 0.0
        points = cells.places.points(known)
        x, y, z = (points @ to_image[others, :, :3].mT + to_image[others, None, :, 3]).unbind(2)
        pixel = (torch.stack([x, y], 2) / z[:, :, None]).nan_to_num(-1.0).clamp(-1.0, 1e6)
        place = pixel.floor().to(torch.int64)
        inside = (z > 0.0) & ((place >= 0) & (place < size[others, None])).all(2)
        row = start[others, None] + place[:, :, 1] * size[others, None, 0] + place[:, :, 0]
        row = row.where(inside, 0)
        # 0 if the depth is unknown there, which is none of the same place.
        visible = inside & ((inverse_depth[row] * z - 1.0).abs() <= _SAME_DEPTH)
        table = residual.new_full((_NEIGHBOURS, *known.shape), torch.nan)
        table[: len(others), known] = residual[row].where(visible, torch.nan)
        usual = table.nanquantile(_USUAL, 0).nan_to_num(torch.inf)
        found.append((usual, (~table.isnan()).sum(0)))
    return found
