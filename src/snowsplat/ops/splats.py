"""`Splats2D`: the interface between projection and rasterization.

One packed tensor contains everything that the rasterizer reads, with one row per splat. So the
gradient is one tensor, too, and a row is one or two cache lines. `project` creates the tensor from
3D Gaussians. A program that fits 2D Gaussians to an image creates it with `Splats2D.pack`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.ops.check import check_ids, check_tensor
from snowsplat.util.native_layout import PACKED_HEADER, PACKED_STRIDE

# Columns of a packed row. The C colours begin at COLORS. Zeros pad the row to a multiple of
# PACKED_STRIDE.
MEANS2D = slice(0, 2)
CONICS = slice(2, 5)
OPACITIES = 5
DEPTHS = 6
RADII = 7
COLORS = PACKED_HEADER


def packed_width(channels: int) -> int:
    """Number of columns of a packed row with `channels` colour or feature channels."""
    return -(-(COLORS + channels) // PACKED_STRIDE) * PACKED_STRIDE


@dataclass
class Splats2D:
    """2D Gaussians on the image plane, in pixels. Pixel (i, j) is centred at (i + 0.5, j + 0.5).

    The columns of a row of `packed`:

        0:2   means2d    x, y
        2:5   conics     a, b, c of the inverse covariance [[a, b], [b, c]]
        5     opacities  in [0, 1]
        6     depths     camera z; splats are ordered by it, nearest first, then by row
        7     radii      3 σ of the major axis (information only, without gradient)
        8:8+C colors     the rest is padding (zero)

    The properties are views of `packed`; autograd flows through them.

    Attributes:
        packed: (M, 16·ceil((8 + C) / 16)), one row per splat.
        ids: (M,) int32: the index of the Gaussian of each row, ascending. −1 marks an empty row,
            which is not drawn. On a GPU, `project` returns a row for every Gaussian, because the
            CPU would have to wait for the number of visible ones. On the CPU no row is empty.
            None: there are no 3D Gaussians (2D Gaussians fitted to an image).
        channels: C, at least 1.
        abs_grad: (M, 2), or None. The backward pass of `rasterize` adds to it, for x and y
            separately, Σ |g| over the 16×16 tiles of the image. g is the part of the gradient of
            `means2d` that comes from the pixels of the tile, so the gradient itself is Σ g. In
            |Σ g|, tiles that move a splat in opposite directions cancel. The homodirectional
            gradient of AbsGS (Ye et al. 2024, arXiv:2404.10484) is the same sum over pixels. The
            sum over tiles is cheap, because the gradients of the tiles are computed anyway.
    """

    packed: Tensor
    ids: Tensor | None
    channels: int
    abs_grad: Tensor | None = None

    def __post_init__(self) -> None:
        if self.channels < 1:
            raise ValueError(f"Splats2D: channels must be at least 1, got {self.channels}")
        width = packed_width(self.channels)
        if self.packed.dim() != 2 or self.packed.shape[1] != width:
            raise ValueError(
                f"Splats2D: packed must be (M, {width}) for {self.channels} channels, "
                f"got {tuple(self.packed.shape)}"
            )
        if self.ids is not None:
            if self.ids.shape != self.packed.shape[:1]:
                raise ValueError(
                    f"Splats2D: ids must be ({len(self.packed)},), got {tuple(self.ids.shape)}"
                )
            if self.ids.dtype != torch.int32:
                raise ValueError(f"Splats2D: ids must be int32, got {self.ids.dtype}")

    def __len__(self) -> int:
        return self.packed.shape[0]

    def without_empty_rows(self) -> Splats2D:
        """The same splats without the empty rows. Waits for a GPU."""
        if self.ids is None or self.packed.device.type == "cpu":
            return self
        rows = (self.ids >= 0).nonzero()[:, 0]
        return Splats2D(self.packed[rows], self.ids[rows], self.channels)

    @property
    def means2d(self) -> Tensor:
        """(M, 2) centres in pixels."""
        return self.packed[:, MEANS2D]

    @property
    def conics(self) -> Tensor:
        """(M, 3) a, b, c of the inverse covariance [[a, b], [b, c]], in 1/pixels²."""
        return self.packed[:, CONICS]

    @property
    def opacities(self) -> Tensor:
        """(M,) in [0, 1]."""
        return self.packed[:, OPACITIES]

    @property
    def depths(self) -> Tensor:
        """(M,) camera z in world units."""
        return self.packed[:, DEPTHS]

    @property
    def radii(self) -> Tensor:
        """(M,) 3 σ of the major axis in pixels; no gradient."""
        return self.packed[:, RADII].detach()

    @property
    def colors(self) -> Tensor:
        """(M, C) colours or features."""
        return self.packed[:, COLORS : COLORS + self.channels]

    @classmethod
    def pack(
        cls,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        depths: Tensor,
        colors: Tensor,
        radii: Tensor | None = None,
        ids: Tensor | None = None,
    ) -> Splats2D:
        """Packs separate tensors; gradients flow to every argument except `radii` and `ids`.

        means2d (M, 2), conics (M, 3), opacities (M,), depths (M,), colors (M, C), all of one
        floating dtype and device. `radii` (M,) defaults to 3 σ of the major axis of each conic.
        """
        if means2d.dim() != 2 or colors.dim() != 2:
            raise ValueError(
                "Splats2D.pack: means2d must be (M, 2) and colors (M, C), "
                f"got {tuple(means2d.shape)} and {tuple(colors.shape)}"
            )
        count, channels = colors.shape
        if radii is None:
            radii = radii_of_conics(conics)
        expected = {
            "means2d": (means2d, (count, 2)),
            "conics": (conics, (count, 3)),
            "opacities": (opacities, (count,)),
            "depths": (depths, (count,)),
            "radii": (radii, (count,)),
        }
        for name, (tensor, shape) in expected.items():
            if tuple(tensor.shape) != shape:
                raise ValueError(
                    f"Splats2D.pack: {name} must be {shape}, got {tuple(tensor.shape)}"
                )
            if tensor.dtype != colors.dtype or tensor.device != colors.device:
                raise ValueError(
                    f"Splats2D.pack: {name} is {tensor.dtype} on {tensor.device}, "
                    f"but colors is {colors.dtype} on {colors.device}"
                )
        padding = colors.new_zeros(count, packed_width(channels) - COLORS - channels)
        scalars = [opacities, depths, radii.detach()]
        columns = [means2d, conics, torch.stack(scalars, dim=1), colors, padding]
        return cls(torch.cat(columns, dim=1), ids, channels)


@dataclass(frozen=True, eq=False)
class SplatGradient:
    """The gradient of a loss with respect to the splats that `project` returned.

    Attributes:
        ids: (M,) int32, ascending: `splats.ids`. On a GPU, rows with id -1 may be present or
            removed.
        packed: (M, 16): `splats.packed.grad`. None: there is no gradient (for `adam_step`).
    """

    ids: Tensor
    packed: Tensor | None

    @classmethod
    def of(cls, splats: Splats2D) -> SplatGradient:
        """The gradient of splats, after the backward pass.

        Raises ValueError if the splats have no gradient, or are not those of 3D Gaussians.
        """
        if splats.ids is None or splats.packed.grad is None:
            raise ValueError("SplatGradient: the splats need ids, and packed.grad")
        return cls(splats.ids, splats.packed.grad)

    def checked(self, op: str, means: Tensor) -> Tensor:
        """`packed`, contiguous.

        Raises ValueError unless it is a gradient of splats of Gaussians with these means.
        """
        if self.packed is None:
            raise ValueError(f"{op}: gradient.packed must not be None")
        shape = (len(self.ids), packed_width(3))
        check_tensor(op, "gradient.packed", self.packed, shape, means)
        check_ids(op, self.ids, means)
        return self.packed.contiguous()


def radii_of_conics(conics: Tensor) -> Tensor:
    """3 σ of the major axis, (M,), of inverse covariances (M, 3); without gradient.

    σ² of the major axis is the larger eigenvalue of the covariance, which is the inverse of the
    smaller eigenvalue of the conic.
    """
    if conics.dim() != 2 or conics.shape[1] != 3:
        raise ValueError(f"conics must be (M, 3), got {tuple(conics.shape)}")
    a, b, c = conics.detach().unbind(dim=1)
    half_gap = torch.hypot((a - c) / 2, b)
    # The smaller eigenvalue is det / larger (Vieta); this has no cancellation for long thin splats.
    larger = (a + c) / 2 + half_gap
    smaller = (a * c - b * b) / larger
    return 3 * smaller.rsqrt()
