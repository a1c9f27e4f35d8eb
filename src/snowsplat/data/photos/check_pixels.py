"""Whether the pixels of an image file are damaged.

For damaged data of a JPEG, libjpeg only has a warning, which Pillow drops: the rest of the photo is
grey or has other colours. FFmpeg has an error. Neither notices a changed byte that gives other
valid codes. PNG and TIFF by deflate have checksums. In WebP, AVIF and HEIC nearly all codes are
valid, and in formats without compression all of them.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snowsplat.data.photos.decode import open_photo
from snowsplat.data.photos.image_file import check_jpeg
from snowsplat.util.errors import Problem

# Tags of a TIFF: the compression, its values for deflate, places and sizes of strips and tiles.
_COMPRESSION, _DEFLATE, _PARTS = 259, (8, 32946), ((273, 279), (324, 325))
_BLOCK = 1 << 20  # bytes that are unpacked at once


def check_pixels(path: Path) -> None:
    """Raises UserError: the image file is missing, or its data are damaged."""
    with open_photo(path) as image:
        if image.format == "PNG":
            image.verify()  # by its checksums
            return
        if image.format in ("JPEG", "MPO"):
            check_jpeg(path)
            image.draft(None, (1, 1))
        tags = getattr(image, "tag_v2", {})
        if tags.get(_COMPRESSION) in _DEFLATE:
            _check_deflate(path, tags)
        image.load()


def _check_deflate(path: Path, tags: Mapping[int, Any]) -> None:
    """Raises zlib.error, Problem: a part of a TIFF file does not have its checksum."""
    with open(path, "rb") as file:
        for places, sizes in _PARTS:
            for place, size in zip(tags.get(places, ()), tags.get(sizes, ()), strict=False):
                file.seek(place)
                packed, part = file.read(size), zlib.decompressobj()
                while packed and not part.eof:
                    part.decompress(packed, _BLOCK)
                    packed = part.unconsumed_tail
                if not part.eof:
                    raise Problem("its data are damaged")
