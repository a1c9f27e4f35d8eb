"""Interlaced video: finds it by its pixels, and makes whole frames from its fields.

A frame of interlaced video consists of two fields, the even and the odd rows, from two moments. A
moving camera shifts them against each other, so that edges look like combs. What the file says is
not sufficient: programs convert such video without separating the fields, and mark it as
progressive; other cameras store whole frames in a stream that is marked as interlaced. FFmpeg's
filter idet looks for the combs, and its filter bwdif interpolates the rows of one field.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Literal

from snowsplat.sfm.ingest.video.clip import Clip, decoded_frames, open_video, video_stream

if TYPE_CHECKING:
    from av import VideoFrame
    from av.filter import Graph

#: Which field of a frame is shown first: that of the even rows ("tff"), or that of the odd rows.
FieldOrder = Literal["tff", "bff"]

_PLACES = 6  # in the video where successive frames are examined
_FRAMES = 5  # at each place
_FEWEST = 3  # frames with combs; a single one may be a cut


def field_order(clip: Clip) -> FieldOrder | None:
    """The order of the fields of an interlaced video; None if its frames are whole.

    Few frames are decoded. If the camera does not move in them, the frames are whole: there are no
    combs.

    Raises:
        av.FFmpegError, ValueError: the video cannot be opened.
    """
    kinds: Counter[str] = Counter()
    for place in range(_PLACES):
        examined = _filter_frames(_frames_at(clip, place / _PLACES), "idet")
        kinds.update(frame.metadata["lavfi.idet.single.current_frame"] for frame in examined)
    early, late, whole = kinds["tff"], kinds["bff"], kinds["progressive"]
    if max(early, late) < max(_FEWEST, whole + min(early, late)):
        return None
    return "tff" if early > late else "bff"


def _frames_at(clip: Clip, part: float) -> list[VideoFrame]:
    """Successive frames at a part of the duration; none if the file has no index for jumps."""
    import av

    with open_video(clip.path) as container:
        if part:
            try:
                stream = video_stream(container)
                seconds = clip.start + part * clip.seconds
                container.seek(round(seconds / float(stream.time_base or 1)), stream=stream)
            except (av.FFmpegError, OSError):
                return []
        return list(islice(decoded_frames(container), _FRAMES))


def whole_frames(frames: Iterable[VideoFrame], order: FieldOrder) -> Iterator[VideoFrame]:
    """Frames of one moment: the rows of the first field, and between them interpolated rows.

    Raises:
        av.FFmpegError: the filter does not support the pixel format.
    """
    return _filter_frames(frames, "bwdif", f"mode=send_frame:parity={order}:deint=all")


def _filter_frames(
    frames: Iterable[VideoFrame], name: str, options: str | None = None
) -> Iterator[VideoFrame]:
    """What a filter of FFmpeg makes of ``frames``, whose size and format may change."""
    graph = None
    kind: tuple[object, ...] = ()
    for frame in frames:
        new = frame.width, frame.height, frame.format.name, frame.colorspace, frame.color_range
        if new != kind:
            yield from _pull_frames(graph, None)
            graph, kind = _graph_for(frame, name, options), new
        yield from _pull_frames(graph, frame)
    yield from _pull_frames(graph, None)


def _graph_for(frame: VideoFrame, name: str, options: str | None) -> Graph:
    """A filter for frames like this one."""
    from av.filter import Graph

    graph = Graph()
    source = graph.add(
        "buffer",
        f"video_size={frame.width}x{frame.height}:pix_fmt={frame.format.name}:"
        f"time_base={frame.time_base or '1/25'}:colorspace={int(frame.colorspace)}:"
        f"range={int(frame.color_range)}",
    )
    middle = graph.add(name, options)
    source.link_to(middle)
    middle.link_to(graph.add("buffersink"))
    graph.configure()
    return graph


def _pull_frames(graph: Graph | None, frame: VideoFrame | None) -> Iterator[VideoFrame]:
    """What the filter returns for a frame; None: the frames that it has kept."""
    import av

    if graph is None:
        return
    graph.vpush(frame)
    with suppress(av.BlockingIOError, av.EOFError):  # it compares a frame with the next one
        while True:
            yield graph.vpull()
