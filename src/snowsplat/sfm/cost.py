"""Predicts the time of structure from motion, from the number and the size of the photos.

The work is a sum of steps. Each step has a cost in seconds of one core of a reference machine:

    step      is proportional to                                                   threads
    photos    pixels of the originals (decoding) and of the copies (writing)       up to 4
              pixels of all frames of videos (decoding)                            1
    features  pixels of the photos in which features are detected; features        all
    pairs     pairs of photos, times the square of the number of features          all
    verified  pairs of photos, times the number of features                        all
    poses     photos, times the square root of the number of features; the time    1
              for a photo grows with the number of photos (bundle adjustment)
    images    pixels of the copies, from which the lens distortion is removed      up to 4
    start     constant

The constants were measured in a run with 100 photos of 12 megapixels and in some smaller ones.
`measure_speed` compares this machine, under its present load, with the reference machine. The
number of matches differs between scenes, so the time of a step may differ by 40% from its
prediction; the error of the sum is smaller.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.colmap.options import EFFORTS, EffortName
from snowsplat.sfm.colmap.sift import new_detector

# Seconds of one core of the reference machine: a virtual x86-64 server with two cores and AVX-512.
_PHOTO = 0.02
_DECODED_MEGAPIXEL = 0.016  # of an original photo
_WRITTEN_MEGAPIXEL = 0.1  # of a resized photo: resizing and saving
_FRAME_MEGAPIXEL = 0.02  # of each frame of a video, also of those that are not used
_SIFT_MEGAPIXEL = 0.33
_SIFT_THOUSAND = 0.06  # features
_MATCHED_PAIR = 0.0011  # of photos with 1000 features each
_VERIFIED_PAIR = 0.011  # of photos with 1000 features each
_POSE = 0.2  # of a photo with 1000 features
_POSE_GROWTH = 60.0  # with this number of photos, a photo takes twice as long as the first ones
_IMAGE_MEGAPIXEL = 0.24
_START = 8.0  # loading libraries in two processes; the report

# Two photos often choose each other as neighbours, so there are fewer pairs than neighbours.
_PAIRS_PER_NEIGHBOUR = 0.57
_MOST_READERS = 4  # threads that read and write photos

# The sample with which the speed is measured.
_SAMPLE_SIDE = 320
_SAMPLE_SECONDS = 0.1  # of one core of the reference machine
_SAMPLE_REPEATS = 3
_MOST_THREADS = 16


@dataclass(frozen=True)
class Speed:
    """The speed of this machine.

    Attributes:
        slowness: seconds of one thread here for a second of the reference machine.
        cores: how many times as much work all threads do as one.
    """

    slowness: float = 1.0
    cores: float = 1.0

    def seconds(self, work: float, threads: float) -> float:
        """Seconds for ``work`` seconds of one reference core, with at most ``threads``."""
        return work * self.slowness / max(1.0, min(threads, self.cores))


@dataclass(frozen=True)
class Photos:
    """The input of structure from motion.

    Attributes:
        stills: number of photos.
        frames: number of used frames of all videos.
        longest: the longer side of an original photo, in pixels.
        decoded: number of frames of all videos, which are decoded to choose the used ones.
        video: the longer side of the frames, in pixels.
    """

    stills: int
    frames: int = 0
    longest: int = 0
    decoded: int = 0
    video: int = 0

    @property
    def count(self) -> int:
        return self.stills + self.frames


def predicted_seconds(
    photos: Photos, size: int, effort: EffortName, speed: Speed
) -> dict[str, float]:
    """Seconds of each step of the table above, and of "start".

    Args:
        size: the longer side to which photos are reduced, in pixels.
    """
    parameters = EFFORTS[effort]
    count, largest = photos.count, max(photos.longest, photos.video)
    original, frame = _megapixels(photos.longest), _megapixels(photos.video)
    copy = _megapixels(min(size, largest))
    features = parameters.features / 1000
    pairs = expected_pairs(count, effort)
    detected = _megapixels(min(size, largest, parameters.image_size))
    reading = photos.stills * (_PHOTO + _DECODED_MEGAPIXEL * original)
    writing = (photos.stills if size < photos.longest else 0) * _WRITTEN_MEGAPIXEL * copy
    decoding = photos.decoded * _FRAME_MEGAPIXEL * frame
    all_threads = speed.cores
    return {
        "photos": speed.seconds(reading + writing, _MOST_READERS) + speed.seconds(decoding, 1),
        "features": speed.seconds(
            count * (_SIFT_MEGAPIXEL * detected + _SIFT_THOUSAND * features), all_threads
        ),
        "pairs": speed.seconds(_MATCHED_PAIR * pairs * features**2, all_threads),
        "verified": speed.seconds(_VERIFIED_PAIR * pairs * features, all_threads),
        "poses": speed.seconds(_POSE * math.sqrt(features) * count * (1 + count / _POSE_GROWTH), 1),
        "images": speed.seconds(_IMAGE_MEGAPIXEL * copy * count, _MOST_READERS),
        "start": speed.seconds(_START, 1),
    }


def expected_pairs(count: int, effort: EffortName) -> float:
    """About how many pairs of ``count`` photos are matched; see `pairs.choose_pairs`."""
    parameters = EFFORTS[effort]
    if count <= parameters.exhaustive:
        return count * (count - 1) / 2
    return _PAIRS_PER_NEIGHBOUR * parameters.neighbours * count


def measure_speed(threads: int) -> Speed:
    """Measure the speed of this machine with ``threads`` threads; takes about a second."""
    threads = max(1, min(threads, _MOST_THREADS))
    cv2.setNumThreads(1)
    sample = _sample()

    def run(_: int = 0) -> None:
        new_detector().detectAndCompute(sample, None)

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
    """A grey picture (320, 320) with blobs of several sizes, the same in each call."""
    random = np.random.default_rng(0)
    total = np.zeros((_SAMPLE_SIDE, _SAMPLE_SIDE), np.float32)
    for cells in (8, 16, 32, 64):
        blobs = random.random((cells, cells), np.float32)
        total += cv2.resize(blobs, total.shape, interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def _megapixels(side: float) -> float:
    """Of a photo with this longer side in pixels, and an aspect ratio of 4:3."""
    return 0.75e-6 * side**2
