"""Writes images as the frames of an mp4 file: `video_writer`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np

from snowsplat.trajectory.spherical_metadata import mark_as_spherical
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
