"""Photos and videos as inputs of the tests: a textured wall, seen from positions side by side."""

import functools
from fractions import Fraction

import av
import numpy as np
from PIL import Image, ImageFilter

from snowsplat.sfm.ingest.content.sharpness import CONTENT_SIDE, grey_copy
from snowsplat.sfm.ingest.inputs import gather
from snowsplat.sfm.options import GatherOptions
from snowsplat.sfm.progress import silent

WIDTH, HEIGHT = 320, 240


@functools.lru_cache(8)
def _blobs(width: int, height: int, seed: int) -> np.ndarray:
    """(height, 3 width, 3) float64: blobs of many sizes and colours; read-only."""
    random = np.random.default_rng(seed)
    total = np.zeros((height, 3 * width, 3))
    for cells in (4, 12, 40, 120):
        noise = random.integers(0, 256, (cells * height // width + 1, 3 * cells, 3))
        layer = Image.fromarray(noise.astype(np.uint8)).resize((3 * width, height), 3)
        total += np.asarray(layer) / 4
    total = np.clip(128 + 1.6 * (total - 128), 0, 255)
    total.setflags(write=False)
    return total


def wall(offset=0, width=WIDTH, height=HEIGHT, seed=0) -> np.ndarray:
    """(height, width, 3) uint8: blobs of many sizes and colours, shifted left by ``offset``.

    The upper left corner has a white square and the rest of the left edge is dark, so that
    rotations and reflections are detected.
    """
    picture = _blobs(width, height, seed)[:, offset : offset + width].copy()
    picture[:, : width // 10] *= 0.2
    picture[: height // 6, : width // 8] = 255
    return picture.astype(np.uint8)


def photo(offset=0, **options) -> Image.Image:
    """`wall` as an image."""
    return Image.fromarray(wall(offset, **options))


def blurred(picture: np.ndarray, radius: float) -> np.ndarray:
    """``picture`` blurred by a Gaussian of this radius in pixels."""
    return np.asarray(Image.fromarray(picture).filter(ImageFilter.GaussianBlur(radius)))


def exif(tags=None, details=None, gps=None) -> Image.Exif:
    """EXIF data of a photo, by tag: main tags, exposure details, GPS."""
    data = Image.Exif()
    data.update(tags or {})
    data.get_ifd(0x8769).update(details or {})
    data.get_ifd(0x8825).update(gps or {})
    return data


def gathered(inputs, dataset, report=silent, **options):
    """`gather` one or several inputs for a dataset."""
    dataset.mkdir(exist_ok=True)
    inputs = inputs if isinstance(inputs, list) else [inputs]
    return gather(inputs, dataset, GatherOptions(**options), report)


def grey(picture: np.ndarray) -> np.ndarray:
    """The copy of a picture that is tested for content and for motion."""
    return grey_copy(Image.fromarray(picture), CONTENT_SIDE)


def noisy(picture: np.ndarray, level: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, level, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def write_photos(folder, count=3, ending="jpg", start=0):
    """Write ``0.jpg`` … to a new folder; returns the folder. ``start`` > 0: of other places."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        photo(20 * (start + i)).save(folder / f"{i}.{ending}", quality=95)
    return folder


def write_video(path, pictures, rate=10, rotation=None, codec="libx264", times=None, aspect=None):
    """Encode (H, W, 3) uint8 images; with ``times`` (in 1/1000 s) the frame rate is variable."""
    with av.open(str(path), "w") as container:
        fast = {"preset": "ultrafast", "threads": "1"} if codec == "libx264" else {}
        stream = container.add_stream(codec, rate=rate, options=fast)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if aspect:
            stream.codec_context.sample_aspect_ratio = aspect
        stream.bit_rate = 4_000_000
        if rotation:
            stream.set_display_rotation(rotation)
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for i, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[i], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def pan(count, step=8, **options) -> list[np.ndarray]:
    """Images of a camera that moves sideways by ``step`` pixels per image."""
    large = np.asarray(wall(0, width=WIDTH + step * count, **options))
    return [np.ascontiguousarray(large[:, step * i : step * i + WIDTH]) for i in range(count)]
