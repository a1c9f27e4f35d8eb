"""SOG files: the parameters of a scene as pixels of lossless images, in a zip file (`.sog`).

`meta.json` lists the images and describes how their bytes are decoded. In each image except the
palette, the i-th pixel, row by row, belongs to the i-th Gaussian. `write_sog` writes version 2,
which has these images:

- means_l, means_u: the low and the high byte of a 16-bit integer for each coordinate x. The integer
  encodes sign(x) · log(1 + |x|): 0 is the minimum (`mins` in `meta.json`), 65,535 the maximum
  (`maxs`);
- scales: logarithms of the standard deviations, as indices into a codebook of 256 values;
- quats: the three entries that are not the largest, from −1/√2 to 1/√2 in one byte each; alpha is
  252 + the index (wxyz) of the largest entry;
- sh0: the constant SH coefficients, as indices into a codebook; alpha is the opacity;
- shN_labels (above SH degree 0): the 16-bit index of a palette entry;
- shN_centroids: the palette: 64 entries per row, one pixel per SH coefficient, as indices into a
  codebook.

The entry "model" of `meta.json` is "antialiased" for an antialiased scene; other scenes have none.
Older versions of the format have the entry "antialias" instead, as the types of Spark show.
Two entries of "asset" are ours: "origin" is the `scene.origin` of a scene that is far away from 0,
"metres_per_unit" its true scale.

Version 1 has evenly spaced levels between mins and maxs instead of codebooks. A scene of version 1
is usually a folder; `read_sog` takes the path of its `meta.json`. The coordinate frame is that of
the PLY files. Specification: developer.playcanvas.com, "The SOG Format".
"""

import io
import json
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from snowsplat.formats import packing
from snowsplat.formats.codebooks import LEVELS, levels_for, palette_for
from snowsplat.formats.damage import Damaged, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, float32_gaussians, without_unusable
from snowsplat.formats.sog_container import Bundle
from snowsplat.scene.length import stored_metres
from snowsplat.scene.origin import HERE, add_origins, stored_origin
from snowsplat.scene.sh_constants import SH_REST_COUNTS
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_bytes

#: The name of the description of a scene, in a zip file or a folder.
META = "meta.json"
_PALETTE_LIMIT = 1 << 16  # labels have 16 bits
_PALETTE_COLUMNS = 64
_SH_LIMIT = np.float32(1e6)
_SIDE_LIMIT = 16_383  # pixels, of a WebP image
_STEPS = np.arange(256) / 255


def is_sog(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a zip file or the `meta.json` of a folder."""
    return head.startswith(b"PK\x03\x04") or (
        head.lstrip().startswith(b"{") and b'"means"' in head and b'"quats"' in head
    )


def read_sog(path: Path | str) -> GaussianArrays:
    """Read a zip file, or the `meta.json` of a folder, of version 1 or 2.

    Raises: UserError: the file cannot be read, is damaged, or declares an implausible number of
    Gaussians.
    """
    return without_unusable(Path(path), read_stored(path))


@reads
def read_stored(path: Path) -> GaussianArrays:
    """The same as `read_sog`, but with the Gaussians that are not finite, in their stored order."""
    with Bundle(path) as files:
        meta = files.meta()
        layout = _layout(meta)
        packing.check_count(layout.count, files.bytes_with(layout.files.values()))
        arrays = _decode(files, layout)
    antialiased = meta.get("model") == "antialiased" or meta.get("antialias") is True
    scene = float32_gaussians(*arrays, antialiased=antialiased)
    asset = meta.get("asset")
    asset = asset if isinstance(asset, dict) else {}
    stored = stored_origin(asset.get("origin"))
    return replace(
        scene,
        origin=add_origins(scene.origin, stored or HERE),
        metres_per_unit=stored_metres(asset.get("metres_per_unit")),
    )


@reads
def sog_files(path: Path) -> list[Path]:
    """The files of a scene: the zip file, or `meta.json` and the images beside it.

    Raises: UserError: the file cannot be read or is damaged.
    """
    with Bundle(path) as files:
        return [path, *files.beside(_layout(files.meta()).files.values())]


def sog_version(path: Path) -> str:
    """The version of a file that `read_sog` accepts."""
    with Bundle(path) as files:
        return "2" if files.meta().get("version") == 2 else "1"


@dataclass(frozen=True)
class _Layout:
    """`meta.json` of either version. Row i of an array with 256 rows is the value of the byte i."""

    count: int
    files: dict[str, str]
    low: np.ndarray  # (3,) `mins` of the means, as sign(x) · log(1 + |x|)
    high: np.ndarray  # (3,) `maxs`
    scales: np.ndarray  # (256, 3) logarithms
    colors: np.ndarray  # (256, 3)
    opacity_logits: np.ndarray  # (256,)
    rest: np.ndarray | None  # (256,)


def _layout(meta: dict[str, Any]) -> _Layout:
    try:
        version_1 = "version" not in meta or meta["version"] == 1
        if not version_1 and meta["version"] != 2:
            raise Damaged(
                "SOG version {meta}; supported are 1 and 2", meta=str(meta["version"])[:20]
            )
        means, scales, sh0, rest = meta["means"], meta["scales"], meta["sh0"], meta.get("shN")
        count = means["shape"][0] if version_1 else meta["count"]
        if type(count) is not int or count < 0:  # true is an int, too
            raise Damaged("its meta.json has no valid count")
        files = dict(zip(("means_l", "means_u"), means["files"], strict=True))
        files |= {"scales": scales["files"][0], "quats": meta["quats"]["files"][0]}
        files |= {"sh0": sh0["files"][0]}
        if rest is not None:
            files |= dict(zip(("centroids", "labels"), rest["files"], strict=True))
        if not all(isinstance(name, str) for name in files.values()):
            raise TypeError
        if version_1:
            color = _even_levels(sh0, 4)
            tables = _even_levels(scales, 3), color[:, :3], color[:, 3]
            rest_table = None if rest is None else _even_levels(rest, 1)[:, 0]
        else:
            tables = _codebook(scales), _codebook(sh0), packing.opacity_logits(np.arange(256))
            rest_table = None if rest is None else _codebook(rest)[:, 0]
        low, high = _numbers(means["mins"], 3), _numbers(means["maxs"], 3)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        raise Damaged("its meta.json does not describe a SOG scene") from None
    return _Layout(count, files, low, high, *tables, rest_table)


def _numbers(values: Any, count: int) -> np.ndarray:
    numbers = np.array(values, np.float64).reshape(-1)
    if len(numbers) != count:
        raise ValueError
    return numbers


def _even_levels(entry: dict[str, Any], channels: int) -> np.ndarray:
    """(256, channels) evenly spaced levels between mins and maxs."""
    low, high = _numbers(entry["mins"], channels), _numbers(entry["maxs"], channels)
    return low + (high - low) * _STEPS[:, None]


def _codebook(entry: dict[str, Any]) -> np.ndarray:
    """(256, 3) the codebook, repeated for each channel; missing entries are NaN."""
    book = np.full(LEVELS, np.nan)
    values = np.array(entry["codebook"], np.float64)  # null becomes NaN
    book[: len(values)] = values
    if np.isnan(book[0]):  # some writers omit the first level; it is extrapolated from the others
        book[0] = book[1] + (book[1] - book[-1]) / (LEVELS - 1)
    return np.repeat(book[:, None], 3, axis=1)


def _decode(files: Bundle, layout: _Layout) -> tuple[np.ndarray, ...]:
    """The six arrays of `GaussianArrays`, some of them float64."""
    n, channel = layout.count, np.arange(3)

    def pixels(name: str) -> np.ndarray:
        # The last row is usually not full, and some writers add rows.
        return files.image(layout.files[name], n, 4 * n + (1 << 16)).reshape(-1, 4)[:n]

    steps = pixels("means_l")[:, :3] + 256.0 * pixels("means_u")[:, :3]
    logs = layout.low + (layout.high - layout.low) * (steps / 65535)
    quats = pixels("quats")
    others = (quats[:, :3] / 255.0 - 0.5) * 2**0.5
    unit = packing.from_largest_of_four(np.maximum(quats[:, 3], 252) - 252, others)
    unit[quats[:, 3] < 252] = 1, 0, 0, 0
    colors = pixels("sh0")
    return (
        np.sign(logs) * np.expm1(np.abs(logs)),
        layout.scales[pixels("scales")[:, :3], channel],
        unit,
        layout.opacity_logits[colors[:, 3]],
        layout.colors[colors[:, :3], channel][:, None],
        _decode_rest(files, layout, None if layout.rest is None else pixels("labels")),
    )


def _decode_rest(files: Bundle, layout: _Layout, labels: np.ndarray | None) -> np.ndarray:
    """(N, K, 3) float32 SH coefficients of degree 1 and higher."""
    if labels is None or layout.rest is None:
        return np.zeros((layout.count, 0, 3), np.float32)
    index = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
    used = int(index.max(initial=0)) // _PALETTE_COLUMNS + 1  # rows of the palette
    image = files.image(layout.files["centroids"], 1, _PALETTE_LIMIT * SH_REST_COUNTS[-1])
    k, remainder = divmod(image.shape[1], _PALETTE_COLUMNS)  # the width determines the degree
    if remainder or k not in SH_REST_COUNTS[1:] or len(image) < used:
        raise Damaged(
            "its palette of {shape}×{image} pixels does not match an SH degree",
            shape=image.shape[1],
            image=len(image),
        )
    table = layout.rest.astype(np.float32)
    return table[image.reshape(-1, k, 4)[index, :, :3]]


def write_sog(path: Path | str, gaussians: GaussianArrays) -> None:
    """Write a zip file of version 2 with the Gaussians in Morton order, atomically.

    Raises:
        UserError: more Gaussians than an image can have pixels.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    write_bytes(path, sog_bytes(Path(path), gaussians))


def sog_bytes(path: Path, gaussians: GaussianArrays) -> bytes:
    """The content of the file that `write_sog` writes; errors name ``path``.

    Raises: UserError: see `write_sog`.
    """
    packable = packing.packable(path, gaussians)
    if len(packable.means) > (_SIDE_LIMIT - 3) ** 2:
        count = len(packable.means)
        raise UserError(
            "{path}: {count} Gaussians are too many for SOG; write .ply or .spz",
            path=path,
            count=count,
        )
    members = encode_sog(packable.select(packing.spatial_order(packable.means)))
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as bundle:
        # Not compressed again, because WebP is compressed. ZipInfo has a fixed date, so that equal
        # scenes result in equal files.
        for name, content in members.items():
            bundle.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


def order_in_sog(path: Path, gaussians: GaussianArrays) -> np.ndarray:
    """(M,) the rows of ``gaussians`` that `write_sog` stores, in the order of the file."""
    order = packing.spatial_order(packing.packable(path, gaussians).means)
    return np.flatnonzero(gaussians.usable_rows())[order]


def encode_sog(gaussians: GaussianArrays) -> dict[str, bytes]:
    """The members of a scene of version 2 by name; `meta.json` is the first one.

    The Gaussians keep their order. They must be finite, with unit quaternions (`packing.packable`).
    """
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = gaussians
    n = len(means)
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = (logs.min(0), logs.max(0)) if n else (np.zeros(3), np.zeros(3))
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    largest, others = packing.largest_of_four(quats)
    scale_levels, scales = levels_for(log_scales)
    color_levels, colors = levels_for(sh_dc[:, 0])
    images = {
        "means_l": _image(steps & 255),
        "means_u": _image(steps >> 8),
        "quats": _image(packing.to_bytes(255 * (others / 2**0.5 + 0.5)), 252 + largest),
        "scales": _image(scales),
        "sh0": _image(colors, packing.opacity_bytes(opacity_logits)),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {
            "generator": "snowsplat",
            **({"origin": list(gaussians.origin)} if any(gaussians.origin) else {}),
            **({"metres_per_unit": metres} if (metres := gaussians.metres_per_unit) else {}),
        },
        "count": n,
        **({"model": "antialiased"} if gaussians.antialiased else {}),
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            **_files_entry("means_l", "means_u"),
        },
        "scales": {"codebook": scale_levels.tolist(), **_files_entry("scales")},
        "quats": _files_entry("quats"),
        "sh0": {"codebook": color_levels.tolist(), **_files_entry("sh0")},
    }
    if n and sh_rest.shape[1]:
        sh_rest = np.clip(sh_rest, -_SH_LIMIT, _SH_LIMIT)  # so that squares fit in float32
        size = min(_PALETTE_LIMIT, max(64, n // 4))
        palette, labels = palette_for(sh_rest.reshape(n, -1), size)
        levels, codes = levels_for(palette)
        images["shN_centroids"] = _palette_image(codes, sh_rest.shape[1])
        images["shN_labels"] = _image(np.stack([labels & 255, labels >> 8, 0 * labels], 1))
        meta["shN"] = {
            "count": len(palette),
            "bands": SH_REST_COUNTS.index(sh_rest.shape[1]),
            "codebook": levels.tolist(),
            **_files_entry("shN_centroids", "shN_labels"),
        }
    encoded = {f"{name}.webp": _webp(pixels) for name, pixels in images.items()}
    return {"meta.json": json.dumps(meta).encode(), **encoded}


def _files_entry(*names: str) -> dict[str, list[str]]:
    """The entry of `meta.json` that lists the files of these images."""
    return {"files": [f"{name}.webp" for name in names]}


def _image(rgb: np.ndarray, alpha: np.ndarray | int = 255) -> np.ndarray:
    """(H, W, 4) uint8: one pixel per row of ``rgb`` (N, 3), about square, sides multiples of 4."""
    n = len(rgb)
    width = max(4, int(np.ceil(n**0.5 / 4)) * 4)
    height = max(4, int(np.ceil(n / width / 4)) * 4)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:n, :3] = rgb
    pixels[:n, 3] = alpha
    return pixels.reshape(height, width, 4)


def _palette_image(codes: np.ndarray, coefficients: int) -> np.ndarray:
    """(H, 64 K, 4) uint8 of the codes (P, 3 K) of P palette entries."""
    rows = -(-len(codes) // _PALETTE_COLUMNS)
    pixels = np.zeros((rows * _PALETTE_COLUMNS, coefficients, 4), np.uint8)
    pixels[:, :, 3] = 255
    pixels[: len(codes), :, :3] = codes.reshape(len(codes), coefficients, 3)
    return pixels.reshape(rows, _PALETTE_COLUMNS * coefficients, 4)


def _webp(pixels: np.ndarray) -> bytes:
    data = io.BytesIO()
    # `exact=True` preserves the colours of pixels whose alpha is 0.
    Image.fromarray(pixels).save(data, format="WEBP", lossless=True, exact=True)
    return data.getvalue()
