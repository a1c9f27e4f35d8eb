"""The compact file: quantised Gaussians, entropy coded. Its suffix is `SUFFIX`.

    4 bytes    "GIMG"
    B B        version 1; blending: 0 additive, 1 front-to-back
    H H I      width, height, number of Gaussians
    3 f        background
    C · 2 f    for each of the C columns: the value of level 0, and the step between levels
    LZMA2      the levels: for each column, the low bytes and then the high bytes of 16-bit numbers
    I          CRC-32 of everything before

All numbers are little-endian. The value of level q is low + step · q, in float32, so that reading a
file always gives the same Gaussians. The order of additive Gaussians has no effect: they are sorted
along a Z-order curve, and the levels of x and y are stored as differences modulo 2¹⁶.

`write_svg` writes them as a picture in the format SVG: one ellipse with a radial gradient for each.
"""

import lzma
import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from snowsplat.extras.image.fit import (
    ANGLE,
    COLORS,
    LOG_SIGMAS,
    MEANS,
    OPACITY_LOGIT,
    ImageGaussians,
    column_count,
)
from snowsplat.extras.image.options import MOST_GAUSSIANS, Blending
from snowsplat.util.errors import Problem, UserError
from snowsplat.util.files import reading, write_bytes, write_text

SUFFIX = ".gimg"
_MAGIC = b"GIMG"
_VERSION = 1
_HEADER = struct.Struct("<4sBBHHI3f")
_CHECKSUM = struct.Struct("<I")
_BLENDINGS: tuple[Blending, ...] = get_args(Blending)
_MOST_LEVELS = 1 << 16
# The finest step of each column: pixels, log σ, radians, colour, logit. docs/guides/image.md has
# the loss of PSNR.
_STEPS = (1 / 12, 1 / 12, 1 / 24, 1 / 24, np.pi / 224, 1 / 64, 1 / 64, 1 / 64, 1 / 8)
_LARGEST_LOGIT = 6.0  # opacity 0.9975; the rasterizer limits α to 0.99
# The settings for the smallest files that were measured. Raw data: the checksum is our own.
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": 1 << 22, "lc": 0, "lp": 0, "pb": 0}]
_MOST_PIXELS = 1 << 26
# The ellipse ends where the opacity of a Gaussian with opacity 1 is 1/255, as in the rasterizer.
_CUTOFF = math.sqrt(2 * math.log(255))  # σ
# Stops of a gradient. Between two of them, the opacity is linear.
_STOPS = 9


def write_compact(path: Path, gaussians: ImageGaussians) -> ImageGaussians:
    """Write the Gaussians as a compact file, atomically; returns what `read_compact` reads from it.

    Raises:
        ValueError: there are no Gaussians, or a value is not finite.
        OSError: the file cannot be written.
    """
    data = encode(gaussians)
    write_bytes(path, data)
    return decode(data)


def read_compact(path: Path) -> ImageGaussians:
    """Read a compact file. Raises: UserError: it is missing or damaged, or of another kind."""
    with reading(path):
        data = path.read_bytes()
    try:
        return decode(data)
    except ValueError as error:
        raise UserError(
            "{path}: {error}; write it again with snowsplat image", path=path, error=error
        ) from None


def encode(gaussians: ImageGaussians) -> bytes:
    """The content of a compact file. Raises ValueError as `write_compact`."""
    rows = gaussians.rows.detach().cpu().double().numpy().copy()
    if not (len(rows) and np.isfinite(rows).all()):
        raise Problem("there are no Gaussians, or a value is not finite")
    rows[:, ANGLE] %= np.pi  # an ellipse that is rotated by 180° is the same
    if gaussians.blending == "front-to-back":
        rows[:, OPACITY_LOGIT] = rows[:, OPACITY_LOGIT].clip(-_LARGEST_LOGIT, _LARGEST_LOGIT)
    low = rows.min(axis=0)
    spread = rows.max(axis=0) - low
    steps = np.maximum(np.array(_STEPS[: rows.shape[1]]), spread / (_MOST_LEVELS - 1))
    levels = np.rint((rows - low) / steps).astype(np.uint16)
    if gaussians.blending == "additive":
        levels = levels[np.argsort(_z_order(levels[:, 0], levels[:, 1]), kind="stable")]
        levels[1:, :2] -= levels[:-1, :2].copy()
    scales = np.stack([low, steps], axis=1).astype("<f4")
    # For each column, the low bytes and then the high bytes.
    payload = levels.astype("<u2").view(np.uint8).reshape(len(levels), -1).T.tobytes()
    head = _HEADER.pack(
        _MAGIC,
        _VERSION,
        _BLENDINGS.index(gaussians.blending),
        gaussians.width,
        gaussians.height,
        len(rows),
        *gaussians.background.tolist(),
    )
    body = head + scales.tobytes() + lzma.compress(payload, lzma.FORMAT_RAW, filters=_FILTERS)
    return body + _CHECKSUM.pack(zlib.crc32(body))


def decode(data: bytes) -> ImageGaussians:
    """The Gaussians in the content of a compact file. Raises ValueError if it is damaged."""
    if data[:4] != _MAGIC:
        raise Problem("not a compact file of Gaussians")
    if len(data) < _HEADER.size + _CHECKSUM.size:
        raise Problem("the file is truncated")
    body, (checksum,) = data[: -_CHECKSUM.size], _CHECKSUM.unpack(data[-_CHECKSUM.size :])
    _, version, blending, width, height, count, *background = _HEADER.unpack_from(body)
    if version != _VERSION:
        raise Problem("version {version} of the format is unknown", version=version)
    if zlib.crc32(body) != checksum:
        raise Problem("the file is damaged or truncated")
    if blending >= len(_BLENDINGS) or not 0 < width * height <= _MOST_PIXELS:
        raise Problem("the header of the file is damaged")
    columns = column_count(_BLENDINGS[blending])
    scales_end = _HEADER.size + 8 * columns
    scales = np.frombuffer(body[_HEADER.size : scales_end], "<f4")
    valid = len(scales) == 2 * columns and np.isfinite([*scales, *background]).all()
    if not (valid and 1 <= count <= MOST_GAUSSIANS):
        raise Problem("the header of the file is damaged")
    levels = _levels(body[scales_end:], count, columns)
    if _BLENDINGS[blending] == "additive":
        levels[:, :2] = np.cumsum(levels[:, :2], axis=0, dtype=np.uint16)
    low, step = scales.reshape(columns, 2).T
    with np.errstate(over="ignore"):
        rows = low + step * levels.astype(np.float32)
    if not np.isfinite(rows).all():
        raise Problem("the values of the file are too large")
    return ImageGaussians(
        width=width,
        height=height,
        blending=_BLENDINGS[blending],
        rows=torch.from_numpy(rows),
        background=torch.tensor(background, dtype=torch.float32),
    )


def _levels(payload: bytes, count: int, columns: int) -> np.ndarray:
    """(count, columns) uint16 from the compressed byte planes."""
    size = 2 * count * columns
    try:
        decoder = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS)
        planes = decoder.decompress(payload, max_length=size + 1)
    except (lzma.LZMAError, EOFError):
        raise Problem("the compressed data are damaged") from None
    if len(planes) != size:
        raise Problem("the number of Gaussians is wrong")
    pairs = np.frombuffer(planes, np.uint8).reshape(2 * columns, count).T
    return np.ascontiguousarray(pairs).view("<u2").astype(np.uint16)


def _z_order(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(N,) uint64: the bits of two 16-bit numbers, alternating."""
    code = np.zeros(len(x), np.uint64)
    one = np.uint64(1)
    for bit in range(16):
        for shift, values in enumerate((x, y)):
            code |= (values.astype(np.uint64) >> np.uint64(bit) & one) << np.uint64(2 * bit + shift)
    return code


def write_svg(path: Path, gaussians: ImageGaussians) -> None:
    """Write the Gaussians as an SVG file, atomically.

    SVG composites shapes from back to front, which is front-to-back blending in the opposite order.
    Colours are limited to 0..1 and rounded to 8 bits, and a gradient is piecewise linear, so the
    picture differs slightly from `ImageGaussians.render`.

    Raises:
        UserError: the Gaussians are additive. SVG has no negative colours.
        OSError: the file cannot be written.
    """
    if gaussians.blending == "additive":
        raise UserError("additive Gaussians have no SVG; fit the photo with blending front-to-back")
    write_text(path, "".join(_lines(gaussians)))


@torch.no_grad()
def _lines(gaussians: ImageGaussians) -> Iterator[str]:
    width, height = gaussians.width, gaussians.height
    yield (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}">\n'
        # A gradient inherits its colour from the attribute `color`.
        "<style>stop{stop-color:currentColor}</style>\n"
        f'<rect width="{width}" height="{height}" fill="{_hex(gaussians.background.numpy())}"/>\n'
    )
    rows = gaussians.rows.flip(0).double()
    means, angles = rows[:, MEANS].numpy(), rows[:, ANGLE].rad2deg().numpy()
    radii = _CUTOFF * rows[:, LOG_SIGMAS].exp().numpy()
    colors = rows[:, COLORS].numpy()
    opacities = torch.sigmoid(rows[:, OPACITY_LOGIT]).numpy()
    offsets = np.linspace(0, 1, _STOPS)
    falloff = np.exp(-0.5 * (_CUTOFF * offsets) ** 2)
    falloff[-1] = 0.0
    for i in range(len(rows)):
        stops = "".join(
            f'<stop offset="{offset:.3g}" stop-opacity="{opacities[i] * weight:.3g}"/>'
            for offset, weight in zip(offsets, falloff, strict=True)
        )
        (x, y), (rx, ry) = means[i], radii[i]
        yield (
            f'<radialGradient id="g{i}" color="{_hex(colors[i])}">{stops}</radialGradient>\n'
            f'<ellipse rx="{rx:.2f}" ry="{ry:.2f}" fill="url(#g{i})" '
            f'transform="translate({x:.2f} {y:.2f}) rotate({angles[i] % 180:.1f})"/>\n'
        )
    yield "</svg>\n"


def _hex(color: np.ndarray) -> str:
    """(3,) in 0..1 as #rrggbb."""
    return "#" + bytes(np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)).hex()
