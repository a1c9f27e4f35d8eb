"""Interlaced video: finds it by its pixels, and makes whole frames from its fields.

A frame of interlaced video consists of two fields, the even and the odd rows, from two moments. A
moving camera shifts them against each other, so that edges look like combs. What the file says is
not sufficient: programs convert such video without separating the fields, and mark it as
progressive; other cameras store whole frames in a stream that is marked as interlaced.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.ingest.video.clip import Clip, decoded_frames, open_video, video_stream

if TYPE_CHECKING:
    from av import VideoFrame
    from av.filter import Graph

#: Which field of a frame is shown first: that of the even rows ("tff"), or that of the odd rows.
FieldOrder = Literal["tff", "bff"]

_PLACES = 6  # in the video where successive frames are compared
_FRAMES = 5  # at each place
_COLUMNS = 3  # every third column is sufficient
# The logarithm of the ratio that `field_order` measures. Of a hand-held video: −0.01 to 0.01 for
# each pair of frames; if it is interlaced, 0.56 to 1.3 (or negative, with the other order).
_DECISIVE = 0.1


def field_order(clip: Clip) -> FieldOrder | None:
    """The order of the fields of an interlaced video; None if its frames are whole.

    Few frames are decoded. If the camera does not move in them, the frames are whole: there are no
    combs.

    Raises:
        av.FFmpegError, ValueError: the video cannot be opened.
    """
    early = late = 0.0
    for place in range(_PLACES):
        lumas = [_luma(frame) for frame in _frames_at(clip, place / _PLACES)]
        for first, second in pairwise(lumas):
            if first.shape == second.shape and len(first) > 2:
                early += _difference(second, first)
                late += _difference(first, second)
    if min(early, late) <= 0 or abs(np.log(early / late)) < _DECISIVE:
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


def _luma(frame: VideoFrame) -> NDArray[np.float32]:
    grey = frame.reformat(format="gray").to_ndarray()
    return grey[:, ::_COLUMNS].astype(np.float32)


def _difference(odd: NDArray[np.float32], even: NDArray[np.float32]) -> float:
    """The mean difference between the odd rows of a frame and the even rows of another.

    Let two frames follow each other. If the even rows are earlier, the odd rows of the first frame
    are nearly of the same time as the even rows of the second; the odd rows of the second are three
    times as far from the even rows of the first. If both fields of a frame are of one moment, both
    differences are equal, whatever the frames show and however the camera moves.
    """
    odd_rows, even_rows = odd[1::2], even[0::2]
    count = min(len(odd_rows), len(even_rows) - 1)
    between = (even_rows[:count] + even_rows[1 : count + 1]) / 2
    return float(np.abs(odd_rows[:count] - between).mean())


def whole_frames(frames: Iterator[VideoFrame], order: FieldOrder) -> Iterator[VideoFrame]:
    """Frames of one moment: the rows of the first field, and between them interpolated rows.

    Raises:
        av.FFmpegError: the filter does not support the pixel format.
    """
    graph = None
    kind: tuple[object, ...] = ()
    for frame in frames:
        new = frame.width, frame.height, frame.format.name, frame.colorspace, frame.color_range
        if new != kind:
            yield from _filtered(graph, None)
            graph, kind = _filter(frame, order), new
        yield from _filtered(graph, frame)
    yield from _filtered(graph, None)


def _filter(frame: VideoFrame, order: FieldOrder) -> Graph:
    """FFmpeg's deinterlacer for frames like this one."""
    from av.filter import Graph

    graph = Graph()
    source = graph.add(
        "buffer",
        f"video_size={frame.width}x{frame.height}:pix_fmt={frame.format.name}:"
        f"time_base={frame.time_base or '1/25'}:colorspace={int(frame.colorspace)}:"
        f"range={int(frame.color_range)}",
    )
    deinterlacer = graph.add("bwdif", f"mode=send_frame:parity={order}:deint=all")
    source.link_to(deinterlacer)
    deinterlacer.link_to(graph.add("buffersink"))
    graph.configure()
    return graph


def _filtered(graph: Graph | None, frame: VideoFrame | None) -> Iterator[VideoFrame]:
    """What the filter returns for a frame; None: the frames that it has kept."""
    import av

    if graph is None:
        return
    graph.vpush(frame)
    with suppress(av.BlockingIOError, av.EOFError):  # it compares a frame with the next one
        while True:
            yield graph.vpull()
