"""A video file: its properties, read from its packets, and its decoded frames, in order."""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.util.errors import Problem, UserError
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message

# Container formats that cameras, phones and programs write, as FFmpeg names them.
_FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,flv,asf,gif,mpeg,mpegts,mpegvideo,m4v,h264,hevc,"
    "vc1,av1,obu,ivf,ogg,mjpeg,dv,mxf"
)
_MAX_PIXELS = 1 << 26  # maximum number of pixels of a frame: 8192×8192

# Codecs of cover pictures and previews, if there are other streams.
_PICTURE_CODECS = ("mjpeg", "png", "bmp", "webp", "gif")

# An mp4 file consists of nested boxes. A box is a header (its length and its kind) and content.
_BOX_HEADER = 8  # bytes
_KIND = re.compile(rb"[ -~\xa9]{4}")
_NO_COUNTS = (b"mdat", b"free", b"skip", b"wide")  # boxes of frame data and padding
# Boxes that begin with a count: of frames, of frames in a fragment (trun), or of edits (elst). A
# compressed header (cmov) could contain such boxes.
_COUNTS = re.compile(rb"stsz|stz2|trun|elst|cmov")
# Each edit may repeat all frames. Valid files have only a few edits, so every 16 edits count as one
# repetition.
_FEW_EDITS = 16
_ALWAYS_ALLOWED = 1 << 16  # frames that a file of any size may declare

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream


@dataclass(frozen=True)
class Clip:
    """Properties of a video, as `read_clip` reads them from its packets and its first frame."""

    path: Path
    packets: int  # number of frames that the file contains
    declared_frames: int  # number of frames that the header declares, at least `packets`
    start: float  # time of the first frame, seconds
    seconds: float  # from the first frame to the end of the last
    width: int  # pixels, in the upright orientation
    height: int
    aspect: float = 1.0  # width / height of a stored pixel; differs from 1 for some camcorders


def top_boxes(path: Path) -> Iterator[tuple[bytes, int, int]]:
    """Kind, begin and end of each box of an mp4 file that is in no other box.

    Ends at the first bytes that are no box: at the beginning if it is not an mp4 file.
    """
    size, start = path.stat().st_size, 0
    with open(path, "rb") as file:
        while start + _BOX_HEADER <= size:
            file.seek(start)
            head = file.read(2 * _BOX_HEADER)
            length, kind = struct.unpack_from(">I4s", head)
            if length == 1 and len(head) == 2 * _BOX_HEADER:
                (length,) = struct.unpack_from(">Q", head, _BOX_HEADER)
            end = min(size, start + length) if length else size
            if end < start + _BOX_HEADER or not _KIND.fullmatch(kind):
                return
            yield kind, start, end
            start = end


def _check_boxes(path: Path) -> None:
    """Check that an mp4 file does not declare more frames than it can contain.

    FFmpeg allocates an entry for each declared frame, so a file of a few bytes could make it
    allocate millions. The counts are in boxes at any depth. Boxes of frame data are skipped.

    Raises: ValueError: the file declares more frames than it has bytes.
    """
    size = path.stat().st_size
    if not size:
        return
    frames = edits = 0
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for kind, start, end in top_boxes(path):
            for tag in () if kind in _NO_COUNTS else _COUNTS.finditer(data, start, end):
                at = tag.end() + (8 if tag[0] in (b"stsz", b"stz2") else 4)
                if tag[0] == b"cmov":
                    raise Problem("compressed mp4 header")
                if at + 4 <= end:
                    (count,) = struct.unpack_from(">I", data, at)
                    frames += 0 if tag[0] == b"elst" else count
                    edits += count if tag[0] == b"elst" else 0
                if frames * max(1, edits // _FEW_EDITS) > max(size, _ALWAYS_ALLOWED):
                    raise Problem("declares more frames than it has bytes")


#: Why a recording of sound, perhaps with a cover picture, is no video.
ONLY_SOUND = message("has only sound, no video")


class NoVideoError(Problem):
    """A file has sound or pictures, but no video; the message says so."""


def why_no_video(path: Path) -> Message | None:
    """Why a file is no readable video, e.g. "has only sound"; None if it is one."""
    import av

    try:
        open_video(path).close()
    except NoVideoError as error:
        return error.message
    except (av.FFmpegError, OSError, ValueError):
        return message("is not a readable video, it may be truncated or damaged")
    return None


def film_size(path: Path) -> tuple[int, int] | None:
    """Width and height of the stored frames, as the header says; None if it is not a video."""
    import av

    try:
        with open_video(path) as container:
            codec = video_stream(container).codec_context
            return codec.width, codec.height
    except (av.FFmpegError, OSError, ValueError):
        return None


def read_clip(path: Path) -> Clip:
    """Read the properties of a video; reads the whole file, but decodes the first frame only.

    Raises: UserError: no frame can be decoded.
    """
    import av

    times: list[float] = []
    declared_frames = 0
    try:
        with open_video(path) as container:
            stream = video_stream(container)
            rate = float(stream.average_rate or 30)
            # This number is used only to report how much of a damaged file is missing.
            declared_frames = stream.frames
            aspect = float(stream.sample_aspect_ratio or 1)
            with suppress(av.FFmpegError):
                for packet in container.demux(stream):
                    stamp = packet.pts if packet.pts is not None else packet.dts
                    if packet.size:
                        known = stamp is not None and bool(packet.time_base)
                        times.append(float(stamp * packet.time_base) if known else -1.0)
        with open_video(path) as container:
            first = next(decoded_frames(container), None)
    except NoVideoError as error:
        raise UserError(
            "{path}: {error}; use a video or photos", path=shown(path), error=error
        ) from None
    except (av.FFmpegError, OSError, ValueError) as error:
        raise undecodable(path, error) from None
    if first is None or not times:
        raise undecodable(path, None)
    if min(times) < 0 and -1.0 in times:  # a raw stream without timestamps
        times = [i / rate for i in range(len(times))]
    length = max(times) - min(times)
    width, height = upright_size(first, aspect)
    return Clip(
        path=path,
        packets=len(times),
        declared_frames=max(declared_frames, len(times)),
        start=min(times),
        seconds=length + length / max(1, len(times) - 1) if length > 0 else len(times) / rate,
        width=width,
        height=height,
        aspect=aspect,
    )


def max_frame_count(clip: Clip, fps: float | None, frames: int | None) -> int:
    """The maximum number of frames to use of a video, for the options ``fps`` and ``frames``.

    The default is 2.5 frames per second. Walking around an object takes 20 to 40 s, so adjacent
    frames are a few degrees apart; SIFT matches such frames reliably. For a short video it is at
    least 60 frames, because a short video may show as much as a long one. For a long video it is
    150 frames, or one per second (up to 300) if that is more, because the later stages take about
    2 s per frame on two cores.
    """
    if frames is not None:
        wanted = float(frames)
    elif fps is not None:
        wanted = clip.seconds * fps
    else:
        wanted = max(min(max(2.5 * clip.seconds, 60), 150), min(clip.seconds, 300))
        wanted = min(wanted, clip.packets / 2)  # at least two frames to choose each one from
    return max(1, min(round(wanted), clip.packets))


def upright_size(frame: VideoFrame, aspect: float) -> tuple[int, int]:
    """Width and height at which a frame is displayed: rotated, with square pixels."""
    width, height = round(frame.width * aspect), frame.height
    return (height, width) if round(frame.rotation / 90) % 2 else (width, height)


def open_video(path: Path) -> InputContainer:
    """Open a video file of a format that cameras write; raises the errors of `av.open`.

    FFmpeg also reads other formats, for example playlists of other files and URLs; they are
    disabled. Frames larger than those of any camera are rejected before memory is allocated.
    """
    import av

    options = {
        "format_whitelist": _FORMATS,
        "protocol_whitelist": "file",
        "max_pixels": str(_MAX_PIXELS),
    }
    _check_boxes(path)
    # The prefix "file:" is needed because a file name may look like a URL. The metadata are not
    # used, but those of some cameras are not UTF-8, which must not raise an error.
    container = av.open(f"file:{path.absolute()}", options=options, metadata_errors="replace")
    try:
        codec = video_stream(container).codec_context
        if codec is None:  # PyAV has no decoder
            raise Problem("unknown codec")
    except BaseException:
        container.close()
        raise
    codec.options = {"max_pixels": str(_MAX_PIXELS)}
    return container


def video_stream(container: InputContainer) -> VideoStream:
    """The film in a file: of the streams that are not much smaller than the largest, the default.

    Drones and cameras add a cover picture, thumbnails or a small preview as further streams. Some
    programs mark the first stream as the default one, whatever it is.

    Raises: NoVideoError: there is only sound, or only pictures beside it.
    """
    from av.stream import Disposition

    pictures = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
    films = [stream for stream in container.streams.video if not stream.disposition & pictures]
    if not films:
        raise NoVideoError(ONLY_SOUND if container.streams.audio else message("has no video"))

    def moves(stream: VideoStream) -> tuple[bool, bool]:
        codec = stream.codec_context
        return stream.frames != 1, codec is not None and codec.name not in _PICTURE_CODECS

    def pixels(stream: VideoStream) -> int:
        codec = stream.codec_context
        return codec.width * codec.height if codec is not None else 0

    films = [stream for stream in films if moves(stream) == max(map(moves, films))]
    enough = max(map(pixels, films)) / 2
    return max(
        (stream for stream in films if pixels(stream) >= enough),
        key=lambda stream: (bool(stream.disposition & Disposition.default), pixels(stream)),
    )


def decoded_frames(container: InputContainer) -> Iterator[VideoFrame]:
    """All frames that can be decoded. Damaged frames are skipped; the file may be truncated."""
    import av

    stream = video_stream(container)
    stream.thread_type = "AUTO"
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.FFmpegError:  # truncated
            packet = None
        decoded: list[VideoFrame] = []
        with suppress(av.FFmpegError):
            decoded = stream.codec_context.decode(packet)
        yield from (frame for frame in decoded if not frame.is_corrupt)
        if packet is None:
            return


def undecodable(path: Path, error: Exception | None) -> UserError:
    """The error to raise if no frame of a video can be decoded."""
    reason = f" ({getattr(error, 'strerror', None) or error})" if error else ""
    return UserError(
        "{path}: no frame of this video can be decoded{reason}; if it is truncated or damaged, "
        "copy it again; if it has more than {max_pixels} million pixels or an unknown codec, "
        "convert it to mp4 (H.264)",
        path=shown(path),
        reason=reason,
        max_pixels=_MAX_PIXELS // 1000000,
    )
