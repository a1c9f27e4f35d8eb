"""How well the scene explains each place of each photo, and what the other photos say about it.

A photo is divided into cells of `CELL` × `CELL` pixels. The residual of a cell is the difference
between the mean colours of the photo and of the rendering, so detail that is too fine for the scene
does not count. The depth of the rendering tells which cells of other photos show the same place:
these photos are its witnesses.

A difference is evidence in units of its usual size: what the scene does not explain, or two photos
show differently, because of a sensor, a focus or a pose, or since the training has just begun, is
usual in these photos.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d, pad

from snowsplat.evaluation.metrics import Rendering
from snowsplat.scene.camera import Camera
from snowsplat.training.starts.depth_map import DepthMap

#: Side of a cell, in pixels of the photo.
CELL = 8
#: A cell is compared with the cells of this number of views whose cameras are nearest.
_NEIGHBOURS = 32
#: A cell of another view shows the same place if the two depths differ by at most this share, ...
_SAME_DEPTH = 0.2
#: ... and at the same size if its width at this depth differs by at most this factor. The mean
#: colour of a larger or smaller place may be another one.
_SAME_SIZE = 2.0
#: A difference of this number of standard deviations is none of noise.
_SIGNIFICANT = 3.0
#: The standard deviation of differences between photos that agree: that of their encoding.
_LEAST_NOISE = 0.01
#: What moves is in less than this share of the cells; so the noise of a photo is computed from
#: this quantile of its differences, which is so many standard deviations. The differences of every
#: fourth of the views are enough.
_QUANTILE, _DEVIATIONS_OF_QUANTILE, _EVERY = 0.6, 0.8416, 4
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
    noise: float  # the standard deviation of the residuals; infinite if all cells are masked
    correlation: Tensor  # (h, w) float32 in -1..1, of photo and rendering around each cell
    colors: Tensor  # (3, h, w) float32, means of the photo, in the exposure of the rendering
    usable: Tensor  # (h, w) bool: False at masked cells
    places: DepthMap  # of the same size


@dataclass(frozen=True)
class Witnesses:
    """What the other photos that show the places of the cells of a view say; each (h, w) int64.

    Attributes:
        others: the number of these photos.
        explained: how many of them the scene explains there.
        comparable: the number of those that show the place at the same size.
        contradicting: how many of these have another colour there, and the scene explains them.
    """

    others: Tensor
    explained: Tensor
    comparable: Tensor
    contradicting: Tensor


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
    residual, colors = _compared(seen, shown, usable)
    known = (opaque[0] >= _OPAQUE) & (z[0] > 0.0)
    noise = _deviation(residual[usable]) if bool(usable.any()) else math.inf
    return CellMap(
        torch.where(usable, residual, 0.0),
        noise,
        _correlation(output.image.mean(2), target.mean(0), size),
        colors,
        usable,
        DepthMap(small, torch.where(known, opaque[0] / z[0], 0.0)),
    )


def _compared(image: Tensor, photo: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """The residual, (h, w): the largest difference of the channels (3, h, w), apart from a gain and
    an offset of each channel; and the photo without this gain and offset, (3, h, w).

    They are fitted by least squares to the cells with the smallest residuals, so that neither the
    exposure of the photo counts nor what the residuals are to find.
    """
    fitted = usable
    residual, colors = (image - photo).abs().amax(0), photo
    for _ in range(_FITS):
        if not bool(fitted.any()):
            break
        x, y = image[:, fitted].double(), photo[:, fitted].double()
        x_mean, y_mean = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
        x, y = x - x_mean, y - y_mean
        gain = (x * y).sum(1, keepdim=True) / x.square().sum(1, keepdim=True).clamp_min(1e-9)
        gain = gain.clamp(*_GAINS)
        offset = y_mean - gain * x_mean
        gain, offset = gain[:, :, None], offset[:, :, None]
        residual = (gain * image + offset - photo).abs().amax(0).to(torch.float32)
        colors = ((photo - offset) / gain).to(torch.float32)
        fitted = usable & (residual <= torch.quantile(residual[usable], _FITTED))
    return residual, colors


def _correlation(image: Tensor, photo: Tensor, size: tuple[int, int]) -> Tensor:
    """(h, w): the correlation of two images (H, W) in the 3 × 3 cells around each cell."""
    moments = torch.stack([image, photo, image * image, photo * photo, image * photo])
    moments = adaptive_avg_pool2d(moments, size)
    x, y, xx, yy, xy = avg_pool2d(moments, 3, stride=1, padding=1, count_include_pad=False)
    variances = (xx - x * x).clamp_min(0.0) * (yy - y * y).clamp_min(0.0)
    return (xy - x * y) / variances.sqrt().clamp_min(_PLAIN)


def _deviation(differences: Tensor) -> float:
    """The standard deviation of normally distributed values, from their absolute values."""
    found = float(torch.quantile(differences, _QUANTILE)) / _DEVIATIONS_OF_QUANTILE
    return max(_LEAST_NOISE, found)


def witnesses(
    maps: Sequence[CellMap], ignored: Sequence[Tensor], *, certain: bool = True
) -> list[Witnesses]:
    """What the other photos say about each cell of each map.

    A cell contradicts that of another view if its colour differs significantly from all colours
    around the place there. So an error of depth or pose of a cell is none, nor is detail that a
    photo resolves and another does not. The noise is that of such differences.

    Args:
        ignored: (h, w) bool for each map, cells that do not count in other views; on the device of
            the maps.
        certain: whether the noise is at least that of the residuals: where the scene is wrong, its
            depths are wrong, too, and other places are compared.
    """
    cells = _AllCells(maps, ignored)
    device = maps[0].residual.device
    noise = torch.full((len(maps),), math.inf)
    for i in range(len(maps)):
        seen = cells.seen_by(i, cells.nearest(i)[::_EVERY])
        if bool(seen.comparable.any()):
            least = maps[i].noise if certain else 0.0
            noise[i] = max(least, _deviation(seen.beyond[seen.comparable]))
    noise = noise.to(device)
    found = []
    for i, own in enumerate(maps):
        others = cells.nearest(i)
        seen = cells.seen_by(i, others)
        usual = torch.maximum(noise[i], noise[others])[:, None]
        explained = seen.visible & cells.explained[seen.row]
        different = seen.comparable & explained & (seen.beyond > _SIGNIFICANT * usual)
        known = own.places.inverse_depth > 0.0
        tables = seen.visible, explained, seen.comparable, different
        found.append(Witnesses(*(_counted(table, known) for table in tables)))
    return found


@dataclass(frozen=True)
class _Seen:
    """The cells with a depth of one view, (P), in each of N other views; all (N, P)."""

    row: Tensor  # int64, see `_AllCells`
    visible: Tensor  # bool
    comparable: Tensor  # bool: visible, and of the same size
    beyond: Tensor  # float32: by how much the colour is outside of those around the place


class _AllCells:
    """The cells of all maps, one after the other, in rows."""

    def __init__(self, maps: Sequence[CellMap], ignored: Sequence[Tensor]) -> None:
        self.maps = maps
        cameras = [cells.places.camera for cells in maps]
        self.device = device = maps[0].residual.device
        self.positions = torch.stack([camera.position for camera in cameras])
        to_image = torch.stack([camera.intrinsics @ camera.cam_from_world for camera in cameras])
        size = torch.tensor([[camera.width, camera.height] for camera in cameras])
        start = size.prod(1).cumsum(0) - size.prod(1)
        self.size, self.start = size.to(device), start.to(device)
        self.to_image = to_image.to(device, torch.float32)
        self.focal = torch.tensor([camera.fx for camera in cameras]).to(device, torch.float32)
        self.inverse_depth = _rows([cells.places.inverse_depth for cells in maps])
        around = [_extremes(cells.colors) for cells in maps]
        self.low = _rows([low for low, _ in around])
        self.high = _rows([high for _, high in around])
        self.counts = _rows([cells.usable for cells in maps]) & ~_rows(ignored)
        self.explained = _rows([cells.residual <= _SIGNIFICANT * cells.noise for cells in maps])

    def nearest(self, i: int) -> Tensor:
        """Indices of the other views whose cameras are nearest, the nearest one first."""
        distances = (self.positions - self.positions[i]).norm(dim=1)
        order = torch.argsort(distances, stable=True)
        return order[order != i][:_NEIGHBOURS].to(self.device)

    def seen_by(self, i: int, others: Tensor) -> _Seen:
        """The cells of view ``i`` in the other views."""
        own, to_image, size = self.maps[i], self.to_image[others], self.size[others, None]
        known = own.places.inverse_depth > 0.0
        points = own.places.points(known)
        x, y, z = (points @ to_image[:, :, :3].mT + to_image[:, None, :, 3]).unbind(2)
        pixel = (torch.stack([x, y], 2) / z[:, :, None]).nan_to_num(-1.0).clamp(-1.0, 1e6)
        place = pixel.floor().to(torch.int64)
        inside = (z > 0.0) & ((place >= 0) & (place < size)).all(2)
        row = self.start[others, None] + place[:, :, 1] * size[:, :, 0] + place[:, :, 0]
        row = row.where(inside, 0)
        # 0 if the depth is unknown there, which is none of the same place.
        same = (self.inverse_depth[row] * z - 1.0).abs() <= _SAME_DEPTH
        visible = inside & self.counts[row] & same
        width = z / self.focal[others, None] * (self.focal[i] * own.places.inverse_depth[known])
        comparable = visible & (width <= _SAME_SIZE) & (width * _SAME_SIZE >= 1.0)
        color = own.colors[:, None, known]
        outside = torch.maximum(self.low[:, row] - color, color - self.high[:, row])
        return _Seen(row, visible, comparable, outside.amax(0).clamp_min(0.0))


def _rows(values: Sequence[Tensor]) -> Tensor:
    """(…, all cells) of (…, h, w) for each map."""
    return torch.cat([value.flatten(-2) for value in values], -1)


def _extremes(colors: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest colours of the 3 × 3 cells around each cell, (3, h, w) each."""
    planes = pad(colors[None], (1, 1, 1, 1), mode="replicate")
    return -max_pool2d(-planes, 3, stride=1)[0], max_pool2d(planes, 3, stride=1)[0]


def _counted(table: Tensor, known: Tensor) -> Tensor:
    """(h, w): the number of views, in the rows of ``table``, at the known cells; elsewhere 0."""
    return torch.zeros_like(known, dtype=torch.int64).masked_scatter(known, table.sum(0))
