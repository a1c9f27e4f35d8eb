"""`film`: pictures, one after the other, into an mp4 file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np

from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path

# The best one that this build of FFmpeg has. The first two make H.264, which everything plays.
_ENCODERS = ("libx264", "libopenh264", "mpeg4")
_CRF = "18"  # hardly to be told from the pictures by eye
_BITS_A_PIXEL = 0.25  # for those that know no such scale
_BT709 = 1  # the colours of HD: primaries, curve and matrix have this number each
_LIMITED_RANGE = 1


@contextmanager
def film(path: Path, width: int, height: int, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Gives the function that adds a picture, (height, width, 3) uint8, to a new film.

        with film(Path("walk.mp4"), 640, 480, 30) as add:
            add(pixels)

    The file appears under its name when the block ends well; if it raises (Ctrl-C), there is none.
    Some pictures are in memory at a time, however many there are. The index lies at the beginning,
    so that a browser plays the file while it loads it.

    Args:
        path: its folder is there.
        width, height: even, as colours are stored for 2×2 pixels.

    Raises:
        ValueError: an odd size, no positive rate, or a picture of another size.
        UserError: the film cannot be encoded or written.
    """
    import av
    from av.video.reformatter import ColorRange, Colorspace

    if width < 2 or height < 2 or width % 2 or height % 2:
        raise ValueError(f"a film has an even width and height, not {width}x{height}")
    if not 0 < fps < float("inf"):
        raise ValueError(f"a film has a positive number of frames a second, not {fps}")
    rate = Fraction(fps).limit_denominator(1001)
    count = 0

    def add(pixels: np.ndarray) -> None:
        nonlocal count
        if pixels.shape != (height, width, 3):
            raise ValueError(f"a picture of {pixels.shape} does not fit a film {width}x{height}")
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
        with (
            atomic_path(path) as temporary,
            av.open(
                str(temporary), "w", format="mp4", options={"movflags": "+faststart"}
            ) as container,
        ):
            stream = container.add_stream(encoder, rate=rate)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            codec = stream.codec_context
            codec.color_primaries = codec.color_trc = codec.colorspace = _BT709
            codec.color_range = _LIMITED_RANGE
            if encoder == "libx264":
                stream.options = {"crf": _CRF}
            else:
                stream.bit_rate = round(_BITS_A_PIXEL * width * height * rate)
            yield add
            container.mux(stream.encode(None))
    except av.FFmpegError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"{path}: the film cannot be written ({reason}); is the disk full?"
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
    raise UserError("this build of PyAV writes no films; install av from PyPI (pip install av)")
