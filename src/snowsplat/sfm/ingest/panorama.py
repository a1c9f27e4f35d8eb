"""Recognises 360° panoramas: by their metadata, or by their pixels.

An equirectangular panorama shows all directions in an image that is twice as wide as high. A row is
a circle of latitude, so the left and the right border are neighbours, and the first and the last
row are one point each. No pinhole camera takes such a picture: its poses would be wrong.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from snowsplat.util.errors import UserError
from snowsplat.util.files import shown

# Reasons why a photo is unusable.
PANORAMA = "is a 360° panorama"
STITCHED = "is a stitched panorama"
#: What to do, for the end of an error about panoramas.
CUT_INTO_VIEWS = (
    "cut each into ordinary views first, e.g. the six sides of a cube with a field of view of 90°"
)

# XMP, as an attribute or as an element: https://developers.google.com/streetview/spherical-metadata
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)")
_PIXELS = re.compile(
    rb"GPano:(FullPanoWidthPixels|CroppedAreaImageWidthPixels)\s*(?:=\s*[\"']|>)\s*(\d+)"
)
_XMP_KEYS = ("xmp", "XML:com.adobe.xmp")  # in `Image.info`: JPEG, WebP and HEIF; PNG
# Spherical video, version 1 (XML) and 2 (a box with an "equi" box inside), in the header of an mp4.
_SPHERICAL = re.compile(
    rb"<GSpherical:Spherical>\s*true|sv3d.{1,400}?(?:equi|cbmp)", re.DOTALL | re.IGNORECASE
)
_LONGEST_HEADER = 64 << 20  # bytes; longer ones are not searched

_WIDTH = 256  # pixels of the copy that is tested
_RATIO_ERROR = 0.01  # relative difference of the aspect ratio from 2
# The difference between the left and the right border, divided by the median difference between
# neighbouring columns; and the variation along the first and the last row, divided by that of the
# median row. Measured: 0.4 to 1.7 and usually below 0.2 for panoramas of a room. Of 1,300 parts of
# ordinary photos, none has less than 0.8 in its rows and less than 2.5 at its borders.
_SEAM = 1.8
_POINT = 0.5
_MIN_CONTRAST = 4.0  # grey levels; in a border without structure, a seam is not visible


def panorama_in_metadata(info: Mapping[str, Any]) -> str | None:
    """`PANORAMA` or `STITCHED`, if the XMP of a photo says so; ``info`` is that of Pillow."""
    for key in _XMP_KEYS:
        xmp = info.get(key, b"")
        xmp = xmp.encode() if isinstance(xmp, str) else xmp
        if not isinstance(xmp, bytes):
            continue
        found = _PROJECTION.search(xmp)
        if found and found[1].lower() in (b"equirectangular", b"cylindrical"):
            widths = {name: int(value[:9]) for name, value in _PIXELS.findall(xmp)}
            whole = widths.get(b"FullPanoWidthPixels", 0)
            part = widths.get(b"CroppedAreaImageWidthPixels", whole)
            all_around = found[1].lower() == b"equirectangular" and part >= whole
            return PANORAMA if all_around else STITCHED
    return None


def is_twice_as_wide(width: int, height: int) -> bool:
    """Whether an image has the size of a panorama of all directions."""
    return abs(width / max(1, height) / 2 - 1) <= _RATIO_ERROR


def shows_all_around(image: Image.Image) -> bool:
    """Whether the pixels are those of an equirectangular panorama of all directions."""
    if not is_twice_as_wide(*image.size) or image.width < _WIDTH:
        return False
    narrow = image.convert("L").resize((_WIDTH, image.height), Image.Resampling.BOX)
    rows = np.asarray(narrow, np.float32).std(axis=1)
    if max(rows[0], rows[-1]) > _POINT * float(np.median(rows)):
        return False
    small = narrow.resize((_WIDTH, _WIDTH // 2), Image.Resampling.BOX)
    grey = np.asarray(small, np.float32)
    if min(grey[:, 0].std(), grey[:, -1].std()) < _MIN_CONTRAST:
        return False
    steps = _difference(grey[:, 1:], grey[:, :-1])
    seam = float(_difference(grey[:, :1], grey[:, -1:])[0])
    return seam <= _SEAM * float(np.median(steps))


def _difference(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """(W,): the mean difference between the columns of two images."""
    return np.asarray(np.abs(first - second).mean(axis=0))


def spherical_video(path: Path) -> UserError:
    """The error to raise for a 360° video."""
    return UserError(
        f"{shown(path)}: is a 360° video, but poses are estimated for lenses that show a part of "
        "the surroundings; export a flat video of one direction, or frames as panoramas and "
        f"{CUT_INTO_VIEWS}"
    )


def is_spherical_video(path: Path) -> bool:
    """Whether the header of an mp4 file says that the video shows all directions.

    Raises:
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        start = 0
        while start + 16 <= size:
            file.seek(start)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:], "big")
            if head[4:8] == b"moov" and length <= _LONGEST_HEADER:
                file.seek(start)
                return _SPHERICAL.search(file.read(length)) is not None
            if length < 8 or not head[4:8].isalpha():
                return False
            start += length
    return False
