"""Predicts the time of structure from motion, from the number and the size of the photos.

`survey` counts the photos and the frames of videos, before they are read.

The work is a sum of steps. Each step has a cost in seconds of one core of a reference machine:

    step      is proportional to                                                   threads
    start     constant                                                             1
    videos    pixels of all frames of videos (decoding)                            1
    photos    pixels of the originals (decoding) and of the copies (writing)       up to 4
    features  pixels of the photos in which features are detected; features        all
    pairs     pairs of photos, times the square of the number of features          all
    verified  pairs of photos, times the square root of the number of features     all
    poses     photos; those that are registered with bundle adjustment cost more   1
    load      constant                                                             1
    images    pixels of the copies, from which the lens distortion is removed      up to 4
    report    constant                                                             1

The constants were measured with 100 photos of 12 megapixels and with 50 photos of 0.9 megapixels,
those of the features later, beside the ones before.
`measure_speed` compares this machine, under its present load, with the reference machine. The
number of matches differs between scenes, so the time of a step may differ by 40% from its
prediction; the error of the sum is smaller.
"""

import math
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.colmap.features.sift import detect_in_grey
from snowsplat.sfm.colmap.options import EFFORTS, photos_with_adjustment
from snowsplat.sfm.ingest.photos.photo_files import Unusable, read_header
from snowsplat.sfm.ingest.search.sources import Sources
from snowsplat.sfm.ingest.video.clip import max_frame_count, read_clip
from snowsplat.sfm.options import EffortName, GatherOptions

# Seconds of one core of the reference machine: a virtual x86-64 server with two cores and AVX-512.
_PHOTO = 0.02
_DECODED_MEGAPIXEL = 0.016  # of an original photo
_WRITTEN_MEGAPIXEL = 0.1  # of a resized photo: resizing and saving
_FRAME_MEGAPIXEL = 0.02  # of each frame of a video, also of those that are not used
_SIFT_MEGAPIXEL = 0.09
_SIFT_THOUSAND = 0.03  # for each thousand features
_MATCHED_PAIR = 0.001  # a pair of photos with 1000 features each
_VERIFIED_PAIR = 0.006  # a pair of photos with 1000 features each
# The costs of a photo in the step "poses".
_REGISTERED = 0.27  # with bundle adjustment (`photos_with_adjustment`)
_ADDED = 0.1  # registered without bundle adjustment
_REFINED = 0.3  # check of the poses, alignment of features, final bundle adjustment
_IMAGE_MEGAPIXEL = 0.24
_START = 2.5  # loading libraries
_LOAD = 3.0  # loading more libraries, for the images
_REPORT = 3.0

# Two photos often choose each other as neighbours, so there are fewer pairs than neighbours.
_PAIRS_PER_NEIGHBOUR = 0.57
_MOST_READERS = 4  # threads that read and write photos

# The sample with which the speed is measured.
_SAMPLE_SIDE = 320
_SAMPLE_FEATURES = 5000  # more than it has
_SAMPLE_SECONDS = 0.036  # of one core of the reference machine
_SAMPLE_REPEATS = 8
_MOST_THREADS = 16

#: The sizes of about this number of photos are read.
_HEADERS = 10


@dataclass(frozen=True)
class Photos:
    """The properties of the input that determine the time of structure from motion.

    Attributes:
        stills: number of photos.
        frames: number of used frames of all videos.
        longest: the longer side of an original photo, in pixels (median).
        videos: number of videos.
        decoded: number of frames of all videos. All of them are decoded, to choose the used ones.
        video: the longer side of the frames, in pixels (maximum of all videos).
    """

    stills: int
    frames: int = 0
    longest: int = 0
    videos: int = 0
    decoded: int = 0
    video: int = 0

    @property
    def count(self) -> int:
        """Number of photos and used frames."""
        return self.stills + self.frames


def survey(sources: Sources, options: GatherOptions | None = None) -> Photos:
    """The photos and frames that `gather` will use, if none of them is unusable.

    Raises: UserError: a video is not readable.
    """
    options = options or GatherOptions()
    photos = [source.path for source in sources.photos]
    clips = [read_clip(source.path) for source in sources.videos]
    longest = []
    for path in photos[:: max(1, len(photos) // _HEADERS)]:
        with suppress(Unusable):
            header = read_header(path)
            longest.append(max(header.width, header.height))
    return Photos(
        stills=min(len(photos), options.photos or len(photos)),
        frames=sum(max_frame_count(clip, options.fps, options.frames) for clip in clips),
        longest=round(statistics.median(longest)) if longest else 0,
        videos=len(clips),
        decoded=sum(clip.packets for clip in clips),
        video=max((max(clip.width, clip.height) for clip in clips), default=0),
    )


@dataclass(frozen=True)
class Speed:
    """The speed of this machine."""

    # Time of one thread on this machine, divided by that on the reference machine.
    slowness: float = 1.0
    cores: float = 1.0  # the work that all threads do in a second, divided by that of one thread


@dataclass(frozen=True)
class Step:
    """The work of a step."""

    work: float  # seconds of one core of the reference machine
    threads: float = math.inf  # maximum number of threads

    def seconds(self, speed: Speed) -> float:
        """Predicted seconds on a machine with this speed."""
        return self.work * speed.slowness / max(1.0, min(self.threads, speed.cores))


def steps_of(photos: Photos, size: int | None, effort: EffortName) -> dict[str, Step]:
    """The steps of the table above, in their order.

    ``size``: the longer side to which photos are reduced, in pixels; None: they are not reduced.
    """
    parameters = EFFORTS[effort]
    largest = max(photos.longest, photos.video)
    size = min(size or largest, largest)
    count = photos.count
    copy = _megapixels(size)
    reading = photos.stills * (_PHOTO + _DECODED_MEGAPIXEL * _megapixels(photos.longest))
    if size < photos.longest:
        reading += photos.stills * _WRITTEN_MEGAPIXEL * copy
    detecting = _SIFT_MEGAPIXEL * _megapixels(min(size, parameters.image_size))
    return {
        "start": Step(_START, 1),
        "videos": Step(photos.decoded * _FRAME_MEGAPIXEL * _megapixels(photos.video), 1),
        "photos": Step(reading, _MOST_READERS),
        "features": Step(count * (detecting + _SIFT_THOUSAND * parameters.features / 1000)),
        **steps_of_pairs(_expected_pairs(count, effort), effort),
        "poses": Step(_registration(count, count) + _REFINED * count, 1),
        "load": Step(_LOAD, 1),
        "images": Step(_IMAGE_MEGAPIXEL * copy * count, _MOST_READERS),
        "report": Step(_REPORT, 1),
    }


def predicted_seconds(photos: Photos, size: int | None, effort: EffortName, speed: Speed) -> float:
    """The time of all `steps_of` structure from motion on a machine with this speed."""
    return sum(step.seconds(speed) for step in steps_of(photos, size, effort).values())


def steps_of_pairs(pairs: float, effort: EffortName) -> dict[str, Step]:
    """The steps "pairs" and "verified" for this number of pairs."""
    thousands = EFFORTS[effort].features / 1000
    return {
        "pairs": Step(_MATCHED_PAIR * pairs * thousands**2),
        "verified": Step(_VERIFIED_PAIR * pairs * math.sqrt(thousands)),
    }


def share_of_poses(registered: int, photos: int) -> float:
    """The share of the step "poses" that is finished with ``registered`` of ``photos`` photos."""
    done = _registration(registered, photos)
    return done / (_registration(photos, photos) + _REFINED * photos) if photos else 0.0


def _registration(registered: int, photos: int) -> float:
    """The work of registering ``registered`` of ``photos`` photos."""
    first = min(registered, photos_with_adjustment(photos))
    return _REGISTERED * first + _ADDED * (registered - first)


def _expected_pairs(count: int, effort: EffortName) -> float:
    """About how many pairs of ``count`` photos are matched; see `pairs.choose_pairs`."""
    parameters = EFFORTS[effort]
    if count <= parameters.exhaustive:
        return count * (count - 1) / 2
    return _PAIRS_PER_NEIGHBOUR * parameters.neighbours * count


def measure_speed(threads: int) -> Speed:
    """Measure the speed of this machine with ``threads`` threads; takes about a second."""
    threads = max(1, min(threads, _MOST_THREADS))
    sample = _sample()

    def run(_: int = 0) -> None:
        detect_in_grey(sample, None, _SAMPLE_FEATURES)

    run()  # the first run also loads code
    start = time.monotonic()
    for _ in range(_SAMPLE_REPEATS):
        run()
    one = (time.monotonic() - start) / _SAMPLE_REPEATS
    with ThreadPoolExecutor(threads) as pool:
        start = time.monotonic()
        list(pool.map(run, range(_SAMPLE_REPEATS * threads)))
        each = (time.monotonic() - start) / (_SAMPLE_REPEATS * threads)
    return Speed(one / _SAMPLE_SECONDS, max(1.0, one / each))


def _sample() -> NDArray[np.uint8]:
    """A grey image (320, 320) with blobs of several sizes, the same in each call."""
    random = np.random.default_rng(0)
    total = np.zeros((_SAMPLE_SIDE, _SAMPLE_SIDE), np.float32)
    for cells in (8, 16, 32, 64):
        blobs = random.random((cells, cells), np.float32)
        total += cv2.resize(blobs, total.shape, interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def _megapixels(side: float) -> float:
    """The megapixels of a photo with this longer side in pixels and an aspect ratio of 4:3."""
    return 0.75e-6 * side**2
