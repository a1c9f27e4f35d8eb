"""Recognises 360° panoramas: by their metadata, or by their pixels.

An equirectangular panorama shows all directions in an image that is twice as wide as high. A row is
a circle of latitude, so the left and the right border are neighbours, and the first and the last
row are one point each.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from snowsplat.sfm.ingest.video.clip import top_boxes
from snowsplat.util.messages import Message, message

# Reasons why a photo is unusable.
STITCHED = message("is a stitched panorama, not of all directions")
NOT_TWICE_AS_WIDE = message("is not twice as wide as high, as a 360° panorama is")
_TWO_EYES = "shows two pictures, for two eyes"

# XMP, as an attribute or as an element: https://developers.google.com/streetview/spherical-metadata
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)")
_PIXELS = re.compile(
    rb"GPano:(FullPano(?:Width|Height)Pixels|CroppedArea(?:ImageWidth|ImageHeight|Top)Pixels)"
    rb"\s*(?:=\s*[\"']|>)\s*(\d+)"
)
# Spherical video, version 1: XML in the header of an mp4 file.
_SPHERICAL = re.compile(rb"<GSpherical:Spherical>\s*true", re.IGNORECASE)
_STEREO = re.compile(rb"<GSpherical:StereoMode>\s*(?:top-bottom|left-right)", re.IGNORECASE)
# Version 2: a box sv3d that has a box proj with a box of the projection, and beside it a box st3d.
_LONGEST_BOX = 1024  # bytes between the names of these boxes
_LONGEST_HEADER = 64 << 20  # bytes; longer ones are not searched
# A track of video in an mp4 file: its width and height, 2 bytes each.
_TRACKS = re.compile(rb"stsd.{12}(?:avc[13]|hvc1|hev1|av01).{24}(.{4})", re.DOTALL)

_WIDTH = 256  # pixels of the copy that is tested
_RATIO_ERROR = 0.01  # relative difference of the aspect ratio from 2
# The difference between the left and the right border, divided by the median difference between
# neighbouring columns; and the variation along the first and the last row, divided by that of the
# median row. Measured: 0.4 to 1.7 and usually below 0.2 for panoramas of a room. Of 1,300 parts of
# ordinary photos, none has less than 0.8 in its rows and less than 2.5 at its borders.
_SEAM = 1.8
_POINT = 0.5
_MIN_CONTRAST = 4.0  # grey levels; in a border without structure, a seam is not visible


@dataclass(frozen=True)
class Panorama:
    """Which part of an equirectangular panorama a photo shows: all columns, and these rows.

    ``above``, ``below``: the rows that are missing, as shares of the height of the photo.
    """

    above: float = 0.0
    below: float = 0.0

    @property
    def cropped(self) -> bool:
        """Whether rows are missing."""
        return self.above > 0 or self.below > 0

    def rows(self, height: int) -> tuple[int, int]:
        """The missing rows above and below a photo of this height."""
        return round(self.above * height), round(self.below * height)


def panorama_in_xmp(xmp: bytes, width: int, height: int) -> Panorama | Message | None:
    """The panorama, or `STITCHED`, if the XMP packet of a photo says so.

    ``width``, ``height``: of the photo, which may be smaller than the XMP packet says.
    """
    found = _PROJECTION.search(xmp)
    if found is None or found[1].lower() not in (b"equirectangular", b"cylindrical"):
        return None
    sizes = {name: int(value[:9]) for name, value in _PIXELS.findall(xmp)}
    whole, whole_height = (sizes.get(b"FullPano%sPixels" % s, 0) for s in (b"Width", b"Height"))
    part = sizes.get(b"CroppedAreaImageWidthPixels", whole)
    rows = sizes.get(b"CroppedAreaImageHeightPixels", whole_height)
    if found[1].lower() == b"cylindrical" or part < whole:
        return STITCHED
    if is_twice_as_wide(width, height):  # of all directions, whatever the numbers are
        return Panorama()
    top = sizes.get(b"CroppedAreaTopPixels", 0)
    if not 0 < rows <= whole_height - top:
        return STITCHED
    panorama = Panorama(top / rows, (whole_height - top - rows) / rows)
    return panorama if is_twice_as_wide(width, height + sum(panorama.rows(height))) else STITCHED


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


def spherical_video(path: Path) -> str | None:
    """Whether the header of an mp4 file says that its frames show all directions.

    Returns: None: it is an ordinary video. Empty: its frames are panoramas of all directions.
    Otherwise, why they are not, as text for users.

    Raises: OSError: the file cannot be read.
    """
    header = b""
    for kind, start, end in top_boxes(path):
        if kind == b"moov" and end - start <= _LONGEST_HEADER:
            with open(path, "rb") as file:
                file.seek(start)
                header = file.read(end - start)
            break
    at = header.find(b"sv3d")
    if at < 0:
        if _SPHERICAL.search(header):
            return _TWO_EYES if _STEREO.search(header) else ""
        sizes = _TRACKS.findall(header)
        return "has the pictures of two lenses" if len(sizes) > len(set(sizes)) else None
    near = header[at : at + _LONGEST_BOX]
    stereo = header[max(0, at - _LONGEST_BOX) : at + _LONGEST_BOX].partition(b"st3d")[2]
    if len(stereo) > 4 and stereo[4]:
        return _TWO_EYES
    if b"cbmp" in near or b"mshp" in near:
        return "has the projection of a cube or a mesh"
    _, found, box = near.partition(b"equi")
    if not found:
        return None
    # Version and flags, then the parts cut off at the top, bottom, left and right.
    bounds = [int.from_bytes(box[i : i + 4], "big") for i in range(4, 20, 4)]
    return "shows only a part of all directions" if any(bounds) else ""
