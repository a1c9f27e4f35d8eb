"""Writes images as the frames of an mp4 file: `video_writer`.

Metadata of 360° videos and photos, by which programs show them as a sphere: of a video, both
versions of Google's specification are written, because players read one or the other: a box
``uuid`` with XML in the track, and the boxes ``st3d`` and ``sv3d`` beside the description of the
codec. https://github.com/google/spatial-media/tree/master/docs

Photos have GPano in XMP. https://developers.google.com/streetview/spherical-metadata
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import numpy as np

from snowsplat.util.errors import UserError, cause_of
from snowsplat.util.files import atomic_path
from snowsplat.util.native_library import available_isas

# Encoders in the order of preference. The first one that this build of FFmpeg contains is used. The
# first two write H.264, which all players support.
_ENCODERS = ("libx264", "libopenh264", "mpeg4")
# Quality of libx264. The compression is hardly visible.
_CRF = "18"
# The number of frames that are encoded at the same time. The bytes of a file depend on it, so it is
# not the number of processors.
_THREADS = 4
# Bit rate of the other encoders, which have no such quality setting.
_BITS_PER_PIXEL = 0.25
# FFmpeg's number for the primaries, the transfer curve and the colour matrix of HD video.
_BT709 = 1
# FFmpeg's number for the usual range of video, 16 to 235.
_LIMITED_RANGE = 1
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


@contextmanager
def video_writer(
    path: Path, width: int, height: int, fps: float, *, panorama: bool = False
) -> Iterator[Callable[[np.ndarray], None]]:
    """Write a video: the context is a function that adds a frame, (height, width, 3) uint8 RGB.

        with video_writer(Path("walk.mp4"), 640, 480, 30) as add:
            add(pixels)

    The file appears under its name when the block ends. If the block raises (also on Ctrl-C), an
    existing file stays unchanged. The same frames give the same bytes. Memory does not grow with
    the number of frames. The index is at the start of the file, so that browsers can play it while
    loading it.

    Args:
        path: the mp4 file, in an existing folder.
        width: pixels, even, because colours are stored per 2×2 pixels.
        height: pixels, even.
        fps: frames per second.
        panorama: each frame is an equirectangular image of all directions; the file says so.

    Raises:
        ValueError: the size is odd, the rate is not positive, or a frame has another size.
        UserError: the video cannot be encoded or written.
    """
    import av
    from av.video.reformatter import ColorRange, Colorspace

    if width < 2 or height < 2 or width % 2 or height % 2:
        raise ValueError(f"a video needs an even width and height, not {width}x{height}")
    if not 0 < fps < float("inf"):
        raise ValueError(f"a video needs a positive number of frames per second, not {fps}")
    rate = Fraction(fps).limit_denominator(1001)
    count = 0

    def add(pixels: np.ndarray) -> None:
        nonlocal count
        if pixels.shape != (height, width, 3):
            raise ValueError(f"a frame of {pixels.shape} does not fit a video {width}x{height}")
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
        )
        frame.pts, frame.time_base = count, 1 / rate
        count += 1
        container.mux(stream.encode(frame))

    encoder = _encoder()
    try:
        with atomic_path(path) as temporary:
            with av.open(
                str(temporary), "w", format="mp4", options={"movflags": "+faststart"}
            ) as container:
                stream = container.add_stream(encoder, rate=rate)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                codec = stream.codec_context
                codec.color_primaries = codec.color_trc = codec.colorspace = _BT709
                codec.color_range = _LIMITED_RANGE
                codec.thread_count, codec.thread_type = _THREADS, "FRAME"
                if encoder == "libx264":
                    options = {"crf": _CRF}
                    if "avx512" in available_isas():
                        # The AVX-512 code of x264 (mb-tree) reads memory that was never written if
                        # the width is not a multiple of 128 pixels.
                        options["x264-params"] = "asm=AVX2"
                    stream.options = options
                else:
                    stream.bit_rate = round(_BITS_PER_PIXEL * width * height * rate)
                yield add
                container.mux(stream.encode(None))
            if panorama:
                mark_as_spherical(temporary)
    except av.FFmpegError as error:
        raise UserError(
            "{path}: the video cannot be written ({reason}); check the free disk space",
            path=path,
            reason=cause_of(error),
        ) from None


def _encoder() -> str:
    from av.codec import Codec
    from av.codec.codec import UnknownCodecError

    for name in _ENCODERS:
        try:
            Codec(name, "w")
        except UnknownCodecError:
            continue
        return name
    raise UserError("this build of PyAV cannot encode videos; run pip install av")


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
