"""`.ksplat` files of the viewer GaussianSplats3D; they can be read, not written.

The file has a header of 4096 bytes, a header of 1024 bytes per section, and the sections. A section
contains the sizes of its partly filled buckets, the centres of all its buckets, and one row per
Gaussian, bucket by bucket:

==================  ===========================  ==========================================
level 0             levels 1 and 2
==================  ===========================  ==========================================
3 floats            3 uint16                     position; uint16 relative to the bucket centre
3 floats            3 halves                     standard deviations, not their logarithms
4 floats            4 halves                     quaternion wxyz
4 bytes             4 bytes                      RGBA
0, 9, 24 floats     as many halves (level 1)     SH degree by degree; in each all coefficients of
                    or bytes between two bounds  red, then of green, then of blue
                    (level 2)
==================  ===========================  ==========================================

Values are little-endian, in the frame of the PLY files. The layout was taken from
github.com/mkkellogg/GaussianSplats3D (MIT).
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snowsplat.formats import packing
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.scene.sh_constants import SH_REST_COUNTS

_HEADER_BYTES = 4096
_SECTION_HEADER_BYTES = 1024
_DEFAULT_RANGE = 32767
_DEFAULT_SH_BOUND = 1.5
#: Types of position, of scales and rotation, and of SH, by compression level.
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))


@dataclass
class _Section:
    """A section of the file."""

    rows: np.ndarray  # (N,) structured: means, scales, quats, rgba, sh
    sh_degree: int
    step: float  # world units of one step of a uint16 position
    offset: int  # the uint16 value of the position 0
    centers: np.ndarray  # (buckets, 3)
    ends: np.ndarray  # for each bucket with Gaussians, the index after its last one


@reads
def read_ksplat(path: Path) -> GaussianArrays:
    """Read a scene of SH degree 0 to 3; the SH of sections of a lower degree are padded with zeros.

    Raises: UserError: the file cannot be read, has another version, or is damaged or truncated.
    """
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES:
        raise Damaged("too short for a .ksplat file")
    major, minor, section_count, level = struct.unpack_from("<BB2xI12xH", data)
    if major != 0 or minor < 1 or level >= len(_TYPES):
        raise Unsupported(
            "not a supported .ksplat file (version {major}.{minor}, compression level "
            "{level}); supported is version 0.1 with levels 0 to 2",
            major=major,
            minor=minor,
            level=level,
        )
    low, high = struct.unpack_from("<2f", data, 36)
    bounds = low or -_DEFAULT_SH_BOUND, high or _DEFAULT_SH_BOUND
    sections = _sections(data, section_count, level)
    degree = max((section.sh_degree for section in sections), default=0)
    # The first part is empty, so that a file without sections gives an empty scene.
    parts = [GaussianArrays.empty(SH_REST_COUNTS[degree])]
    for section in sections:
        parts.append(_unpack(section, level, bounds, SH_REST_COUNTS[degree]))
    return usable_gaussians(path, *(np.concatenate(c) for c in zip(*parts, strict=True)))


def _sections(data: bytes, section_count: int, level: int) -> list[_Section]:
    """The sections; each of them is completely inside the file."""
    start = _HEADER_BYTES + section_count * _SECTION_HEADER_BYTES
    if start > len(data):
        raise _mismatch()
    sections = []
    for i in range(section_count):
        head = _HEADER_BYTES + i * _SECTION_HEADER_BYTES
        count, capacity, bucket_size, bucket_count, block, bucket_bytes, span, full, partial, sh = (
            struct.unpack_from("<4IfH2xI4x2IH", data, head)
        )
        if count > capacity or sh >= len(SH_REST_COUNTS):
            raise _mismatch()
        if level and (bucket_bytes != 12 or full + partial > bucket_count):
            raise _mismatch()
        position, other, harmonic = _TYPES[level]
        row = np.dtype(
            [
                ("means", position, 3),
                ("scales", other, 3),
                ("quats", other, 4),
                ("rgba", "u1", 4),
                ("sh", harmonic, 3 * SH_REST_COUNTS[sh]),
            ]
        )
        centers_start = start + 4 * partial
        rows_start = centers_start + bucket_bytes * bucket_count
        end = rows_start + row.itemsize * capacity
        if end > len(data):
            raise _mismatch()
        centers, ends = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
        if level:
            centers = np.frombuffer(data, "<f4", 3 * bucket_count, centers_start).reshape(-1, 3)
            # The full buckets come first, then the others.
            ends = bucket_size * np.arange(1, full + 1, dtype=np.int64)
            sizes = np.frombuffer(data, "<u4", partial, start)
            others = bucket_size * full + np.cumsum(sizes, dtype=np.int64)
            ends = np.concatenate([ends, others])
            if count > (ends[-1] if len(ends) else 0):
                raise _mismatch()
        rows = np.frombuffer(data, row, count, rows_start)
        span = span or _DEFAULT_RANGE
        sections.append(_Section(rows, sh, block / 2 / span, span, centers, ends))
        start = end
    return sections


def _unpack(
    section: _Section, level: int, bounds: tuple[float, float], rest: int
) -> GaussianArrays:
    rows = section.rows
    means: np.ndarray = rows["means"].astype(np.float32)
    if level:
        bucket = np.searchsorted(section.ends, np.arange(len(rows)), side="right")
        means = (means - section.offset) * np.float32(section.step) + section.centers[bucket]
    harmonics = rows["sh"].astype(np.float32)
    if level == 2:
        low, high = bounds
        harmonics = np.float32(low) + harmonics / 255 * np.float32(high - low)
    sh_rest = np.zeros((len(rows), rest, 3), np.float32)
    first = 0
    for degree in range(1, section.sh_degree + 1):
        width = 2 * degree + 1
        band = harmonics[:, 3 * first : 3 * (first + width)].reshape(-1, 3, width)
        sh_rest[:, first : first + width] = band.transpose(0, 2, 1)
        first += width
    return GaussianArrays(
        means,
        packing.log_scales(rows["scales"].astype(np.float32)),
        packing.unit_quats(rows["quats"].astype(np.float32)),
        packing.opacity_logits(rows["rgba"][:, 3]),
        packing.color_sh(rows["rgba"][:, :3]),
        sh_rest,
    )


def _mismatch() -> Damaged:
    return Damaged("damaged .ksplat file: its sections do not match its size")
