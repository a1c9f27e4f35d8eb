"""A video's file: what it says of itself, and its frames one after the other."""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.util.errors import UserError
from snowsplat.util.files import shown

# Containers that cameras, phones and programs make, by FFmpeg's names.
_FORMATS = ",".join(
    [
        *("mov", "mp4", "m4a", "3gp", "3g2", "mj2", "matroska", "webm", "avi", "flv", "asf", "gif"),
        *("mpeg", "mpegts", "mpegvideo", "m4v", "h264", "hevc", "vc1", "av1", "obu", "ivf", "ogg"),
        *("mjpeg", "dv", "mxf"),
    ]
)
_MOST_PIXELS = 1 << 26  # of a frame: 8192×8192
# Of the boxes that an mp4 file is made of: a head, kinds, those of frames and of nothing, and what
# is counted: frames, of parts of a film too, and edits, each of which may repeat all frames.
_BOX, _KIND = 8, re.compile(rb"[ -~\xa9]{4}")
_NO_COUNTS = (b"mdat", b"free", b"skip", b"wide")
_COUNTS = re.compile(rb"stsz|stz2|trun|elst|cmov")
_FEW_EDITS, _ALWAYS_ALLOWED = 16, 1 << 16

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer


@dataclass(frozen=True)
class Clip:
    """What a video's packets tell, before anything is decoded."""

    path: Path
    packets: int  # frames, as far as the file is whole
    promised: int  # frames that the file says it has, at least `packets`
    start: float  # seconds
    seconds: float  # from the first frame to the end of the last
    width: int  # pixels, upright
    height: int
    aspect: float = 1.0  # width over height of a stored pixel; some camcorders' are not square


def _check_boxes(path: Path) -> None:
    """Whether an mp4 file has the frames that it promises.

    FFmpeg makes an entry of each before it looks for any: a few bytes can promise millions. Counts
    stand in boxes within boxes, of any depth; frames in boxes of their own, which are passed over.

    Raises:
        ValueError: more frames than bytes.
    """
    size = path.stat().st_size
    if size < _BOX:
        return
    frames = edits = 0
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = 0
        while start + _BOX <= size:
            length, kind = struct.unpack_from(">I4s", data, start)
            if length == 1 and start + 2 * _BOX <= size:
                (length,) = struct.unpack_from(">Q", data, start + _BOX)
            end = min(size, start + length) if length else size
            if end < start + _BOX or not _KIND.fullmatch(kind):
                return  # another kind of file, or its end
            for tag in () if kind in _NO_COUNTS else _COUNTS.finditer(data, start, end):
                at = tag.end() + (8 if tag[0] in (b"stsz", b"stz2") else 4)
                if tag[0] == b"cmov":
                    raise ValueError("a header that is packed")
                if at + 4 <= end:
                    (count,) = struct.unpack_from(">I", data, at)
                    frames += 0 if tag[0] == b"elst" else count
                    edits += count if tag[0] == b"elst" else 0
                if frames * max(1, edits // _FEW_EDITS) > max(size, _ALWAYS_ALLOWED):
                    raise ValueError("promises more frames than it has bytes")
            start = end


def is_video(path: Path) -> bool:
    """Whether a file has moving pictures in it, by its content."""
    import av

    try:
        with open_video(path) as container:
            return bool(container.streams.video)
    except (av.FFmpegError, OSError, ValueError):
        return False


def read_clip(path: Path) -> Clip:
    """Length and size of a video; reads the file, but decodes the first frame only.

    Raises:
        UserError: nothing in it can be decoded.
    """
    import av

    times: list[float] = []
    promised = 0
    try:
        with open_video(path) as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or 30)
            # The header is trusted for this alone: to say how much of a damaged file is absent.
            promised = stream.frames
            aspect = float(stream.sample_aspect_ratio or 1)
            with suppress(av.FFmpegError):
                for packet in container.demux(stream):
                    stamp = packet.pts if packet.pts is not None else packet.dts
                    if packet.size:
                        known = stamp is not None and bool(packet.time_base)
                        times.append(float(stamp * packet.time_base) if known else -1.0)
        with open_video(path) as container:
            first = next(decoded_frames(container), None)
    except (av.FFmpegError, OSError, ValueError, IndexError) as error:
        raise nothing_decodes(path, error) from None
    if first is None or not times:
        raise nothing_decodes(path, None)
    if min(times) < 0 and -1.0 in times:  # a raw stream, without times
        times = [i / rate for i in range(len(times))]
    length = max(times) - min(times)
    width, height = upright_size(first, aspect)
    return Clip(
        path=path,
        packets=len(times),
        promised=max(promised, len(times)),
        start=min(times),
        seconds=length + length / max(1, len(times) - 1) if length > 0 else len(times) / rate,
        width=width,
        height=height,
        aspect=aspect,
    )


def frames_wanted(clip: Clip, fps: float | None, frames: int | None) -> int:
    """Into how many windows a video is divided.

    By default 2.5 a second: whoever films an object walks around it in 20 to 40 s, so neighbours
    are some degrees apart, which SIFT matches safely. Of a short one at least 60, since it covers
    as much; of a long one no more than 150, or one a second up to 300 if that is more: all that
    follows costs time for each, on two cores about 2 s.
    """
    if frames is not None:
        wanted = float(frames)
    elif fps is not None:
        wanted = clip.seconds * fps
    else:
        wanted = max(min(max(2.5 * clip.seconds, 60), 150), min(clip.seconds, 300))
        wanted = min(wanted, clip.packets / 2)  # something to choose from
    return max(1, min(round(wanted), clip.packets))


def upright_size(frame: VideoFrame, aspect: float) -> tuple[int, int]:
    """Width and height that a frame is shown with: turned, and with square pixels."""
    width, height = round(frame.width * aspect), frame.height
    return (height, width) if round(frame.rotation / 90) % 2 else (width, height)


def open_video(path: Path) -> InputContainer:
    """Open a file of a kind that cameras make; raises what `av.open` does.

    FFmpeg knows many more kinds of files, among them lists of other files and addresses to play. Of
    what is left, frames larger than any camera's are refused before memory is taken for them.
    """
    import av

    options = {
        "format_whitelist": _FORMATS,
        "protocol_whitelist": "file",
        "max_pixels": str(_MOST_PIXELS),
    }
    _check_boxes(path)
    # A name may look like an address. Some tags of cameras are no UTF-8; they do not matter here.
    container = av.open(f"file:{path.absolute()}", options=options, metadata_errors="replace")
    for stream in container.streams.video:
        if stream.codec_context is None:  # so PyAV says that nobody can decode it
            raise ValueError("a codec that is not known")
        stream.codec_context.options = {"max_pixels": str(_MOST_PIXELS)}
    return container


def decoded_frames(container: InputContainer) -> Iterator[VideoFrame]:
    """All frames that can be decoded: what is damaged is left out, and the file may just end."""
    import av

    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.FFmpegError:  # cut off
            packet = None
        decoded: list[VideoFrame] = []
        with suppress(av.FFmpegError):
            decoded = stream.codec_context.decode(packet)
        yield from (frame for frame in decoded if not frame.is_corrupt)
        if packet is None:
            return


def nothing_decodes(path: Path, error: Exception | None) -> UserError:
    reason = f" ({getattr(error, 'strerror', None) or error})" if error else ""
    return UserError(
        f"{shown(path)}: no frame of this video can be decoded{reason}; it may be cut off, "
        f"damaged, or larger than {_MOST_PIXELS // 1_000_000} million pixels: copy it again, or "
        "save it as mp4 (H.264)"
    )
