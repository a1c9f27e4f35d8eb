"""Metadata of 360° videos and photos, by which programs show them as a sphere.

Of a video, both versions of Google's specification are written, because players read one or the
other: a box ``uuid`` with XML in the track, and the boxes ``st3d`` and ``sv3d`` beside the
description of the codec. https://github.com/google/spatial-media/tree/master/docs

Photos have GPano in XMP. https://developers.google.com/streetview/spherical-metadata
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import BinaryIO

_UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
_XML = b"""<?xml version="1.0"?>\
<rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" \
xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">\
<GSpherical:Spherical>true</GSpherical:Spherical>\
<GSpherical:Stitched>true</GSpherical:Stitched>\
<GSpherical:StitchingSoftware>snowsplat</GSpherical:StitchingSoftware>\
<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType>\
</rdf:SphericalVideo>"""
_GPANO = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"
   GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True"
   GPano:FullPanoWidthPixels="{width}" GPano:FullPanoHeightPixels="{height}"
   GPano:CroppedAreaImageWidthPixels="{width}" GPano:CroppedAreaImageHeightPixels="{height}"
   GPano:CroppedAreaLeftPixels="0" GPano:CroppedAreaTopPixels="0"/>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""
# The boxes on the way to the description of the codec, and the bytes before their first child.
_CONTAINERS = {b"moov": 8, b"trak": 8, b"mdia": 8, b"minf": 8, b"stbl": 8, b"stsd": 16}
_ENTRIES = (b"avc1", b"mp4v", b"hvc1", b"hev1")

_OFFSETS = {b"stco": 4, b"co64": 8}  # bytes of a position in the file


def panorama_xmp(width: int, height: int) -> bytes:
    """The XMP packet of an equirectangular panorama of all directions; its size in pixels."""
    return _GPANO.format(width=width, height=height).encode()


def mark_as_spherical(path: Path) -> None:
    """Insert the metadata into an mp4 file of one video track, as `video_writer` writes it.

    Raises:
        ValueError: the file has no box "moov".
        OSError: the file cannot be read or written.
    """
    marked = path.with_name(f"{path.name}.marked")
    try:
        with open(path, "rb") as source, open(marked, "wb") as target:
            while len(head := source.read(8)) == 8:
                size, name = int.from_bytes(head[:4], "big"), head[4:]
                if name != b"moov":
                    target.write(head)
                    if size == 1:
                        target.write(large := source.read(8))
                        size = int.from_bytes(large, "big") - 8
                    _copy(source, target, size - 8)
                    continue
                moov, start = head + source.read(size - 8), target.tell()
                # What follows moves by the size of the metadata.
                grown = len(_mark_box(moov, start, 0)) - len(moov)
                target.write(_mark_box(moov, start, grown))
                shutil.copyfileobj(source, target)
                break
            else:
                raise ValueError(f"{path}: no box moov")
        marked.replace(path)
    finally:
        marked.unlink(missing_ok=True)


def _copy(source: BinaryIO, target: BinaryIO, count: int) -> None:
    while count > 0 and (block := source.read(min(count, 1 << 20))):
        target.write(block)
        count -= len(block)


def _mark_box(box: bytes, start: int, shift: int) -> bytes:
    """The box with the metadata in it; file positions from ``start`` on are larger by ``shift``."""
    name = box[4:8]
    if name in _OFFSETS:
        return _shift_positions(box, _OFFSETS[name], start, shift)
    if name in _ENTRIES:
        return _box(name, box[8:] + _projection())
    if name not in _CONTAINERS:
        return box
    head = _CONTAINERS[name]
    made, at = box[8:head], head
    while at + 8 <= len(box):
        size = int.from_bytes(box[at : at + 4], "big")
        if size < 8:
            break
        made += _mark_box(box[at : at + size], start, shift)
        at += size
    if name == b"trak":
        made += _box(b"uuid", _UUID + _XML)
    return _box(name, made)


def _shift_positions(box: bytes, size: int, start: int, shift: int) -> bytes:
    """A box of positions in the file, each of ``size`` bytes."""
    positions = (int.from_bytes(box[i : i + size], "big") for i in range(16, len(box), size))
    moved = (value + shift if value >= start else value for value in positions)
    return box[:16] + b"".join(value.to_bytes(size, "big") for value in moved)


def _projection() -> bytes:
    """The boxes st3d and sv3d: one picture for both eyes, equirectangular, of all directions."""
    version = bytes(4)
    stereo = _box(b"st3d", version + b"\0")
    header = _box(b"svhd", version + b"snowsplat\0")
    pose = _box(b"prhd", version + bytes(12))
    bounds = _box(b"equi", version + bytes(16))
    return stereo + _box(b"sv3d", header + _box(b"proj", pose + bounds))


def _box(name: bytes, content: bytes) -> bytes:
    return (8 + len(content)).to_bytes(4, "big") + name + content
