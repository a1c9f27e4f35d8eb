"""A HEIC photo of 200 million pixels, as phones take: 3 s, and less than 2 GB of memory.

The file has a grid of two tiles, each used 96 times, so that it is written in a second.
"""

import io
import struct

import pytest
from PIL import Image
from pillow_heif import register_heif_opener

from snowsplat.sfm.ingest.photos import photo_files

from ....fuzz.limits import measured

TILE, COLUMNS, ROWS = 1020, 16, 12
COLOURS = (20, 60, 200), (200, 120, 60)


def heic() -> bytes:
    """A HEIC file whose grid has its two tiles in turn (ISO/IEC 23008-12, 6.6.2.3)."""
    pair = Image.new("RGB", (2 * TILE, TILE), COLOURS[1])
    pair.paste(COLOURS[0], (0, 0, TILE, TILE))
    file = io.BytesIO()
    pair.save(file, "HEIF", tile_size=TILE)
    data = bytearray(file.getvalue())
    links = struct.pack(">HH", 2, 3) * (COLUMNS * ROWS // 2)
    size = COLUMNS * TILE, ROWS * TILE
    grid = struct.pack(">BBHH", 0, 1, *pair.size)
    data[:] = data.replace(grid, struct.pack(">BBHH", ROWS - 1, COLUMNS - 1, *size), 1)
    data[:] = data.replace(struct.pack(">II", *pair.size), struct.pack(">II", *size), 1)
    at = data.index(b"dimg")
    data[at + 6 : at + 12] = struct.pack(">H", COLUMNS * ROWS) + links
    tiles = [data.index(b"iloc") + 12 + 20 * tile + 6 for tile in (1, 2)]  # where they are stored
    for place in [*tiles, *(data.index(box) - 4 for box in (b"meta", b"iref", b"dimg"))]:
        (value,) = struct.unpack_from(">I", data, place)
        struct.pack_into(">I", data, place, value + len(links) - 4)
    return bytes(data)


@pytest.mark.nightly
def test_a_photo_of_200_million_pixels(tmp_path):
    register_heif_opener()
    path = tmp_path / "a.heic"
    path.write_bytes(heic())
    header = photo_files.read_header(path)
    assert header.size(None) == (COLUMNS * TILE // 2, ROWS * TILE // 2)
    photo, memory = measured(lambda: photo_files.decode(path, header, COLUMNS * TILE // 10))
    for place, colour in zip((50, 152), COLOURS, strict=True):
        found = photo.getpixel((place, 50))
        assert all(abs(a - b) < 16 for a, b in zip(found, colour, strict=True)), found
    assert memory < 2e9
