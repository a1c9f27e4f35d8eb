"""Images for training: decoded ahead in background threads and cached within a memory budget.

The result of `ImageLoader.get` depends only on the files, not on the order of threads or on the
content of the cache: after a cache miss, the same file is decoded again. On a GPU, each file is
decoded once if the memory permits: the photos stay there at full size, and are reduced there.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import torch

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import ImageSource, LoadedImage, box_downscale, load_views
from snowsplat.util.machine import available_memory_bytes

#: Default number of threads that decode ahead. A GPU waits for them, and leaves the processor free.
DECODERS = min(4, os.cpu_count() or 1)
_DECODERS_FOR_GPU = min(8, os.cpu_count() or 1)
_FACTORS = (1, 2, 4)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Key = tuple[ImageSource, ImageSource | None, int]  # image, mask, downscale factor


_after_photo: ContextVar[Callable[[], None]] = ContextVar("after_photo", default=lambda: None)


@contextmanager
def after_each_photo(call: Callable[[], None]) -> Iterator[None]:
    """A context in which `each_photo` calls ``call`` after each photo, to show its progress."""
    token = _after_photo.set(call)
    try:
        yield
    finally:
        _after_photo.reset(token)


def each_photo(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """The results of a function of photos, in the order of the items, by `DECODERS` threads."""
    results, finished = [], _after_photo.get()
    with ThreadPoolExecutor(DECODERS, thread_name_prefix="snowsplat-photos") as pool:
        for result in pool.map(function, items):
            results.append(result)
            finished()
    return results


class Photos(Protocol):
    """What loads the photos of views: an `ImageLoader`, or a changed version of its photos."""

    @property
    def budget_bytes(self) -> int:
        """Memory for decoded images."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the images are."""
        ...

    def prefetch(self, order: Iterable[View], downscale: int | None = None) -> None:
        """See `ImageLoader.prefetch`."""

    def get(self, view: View, downscale: int | None = None) -> LoadedImage:
        """See `ImageLoader.get`."""
        ...


class ImageLoader:
    """A cache of decoded images; the least recently used images are removed when it is full.

        loader = ImageLoader(dataset.train, background=(1, 1, 1))
        loader.prefetch(order)              # the views in the order of the following calls of get
        for view in order:
            target = loader.get(view).rgb   # (H, W, 3) uint8

    Args:
        views: the views that are expected; `get` also accepts other views.
        level: the default downscale factor: 1, 2 or 4.
        background: RGB in 0..1. Transparent images are composited over it; None keeps their alpha.
        budget_bytes: memory for decoded images; None uses half of the memory available now.
        device: where images are stored and returned; None is the CPU.
        threads: number of threads that decode ahead; None uses `DECODERS`, or more for a GPU.

    Attributes:
        decodes_once: whether all images stay on a GPU, at full size and reduced.
    """

    def __init__(
        self,
        views: Sequence[View],
        *,
        level: int = 1,
        background: Sequence[float] | None = None,
        budget_bytes: int | None = None,
        device: torch.device | None = None,
        threads: int | None = None,
    ) -> None:
        self.views = list(views)
        self.level = level
        self.device = device or torch.device("cpu")
        if budget_bytes is None:
            budget_bytes = available_memory(self.device) // 2
        self.budget_bytes = budget_bytes
        on_gpu = self.device.type == "cuda"
        self.decodes_once = on_gpu and self._fits(*_FACTORS)
        self._background = None if background is None else tuple(float(c) for c in background)
        self._threads = threads or (_DECODERS_FOR_GPU if on_gpu else DECODERS)
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="snowsplat-images")
        self._lock = threading.RLock()
        self._cache: OrderedDict[_Key, LoadedImage] = OrderedDict()  # least recently used first
        self._cached_bytes = 0
        self._queue: deque[_Key] = deque()  # to decode ahead
        self._running: dict[_Key, Future[LoadedImage]] = {}
        self._ahead: dict[_Key, int] = {}  # bytes of images decoded ahead and not yet requested
        self._submitting = False
        # The views of each photo that has several, and a lock: only one thread decodes the photo.
        photos: dict[Path, dict[tuple[ImageSource, ImageSource | None], None]] = {}
        for view in views:
            photos.setdefault(view.image.path, {})[view.image, view.mask] = None
        self._photos = {
            path: (threading.Lock(), list(found))
            for path, found in photos.items()
            if len(found) > 1
        }

    def prefetch(self, order: Iterable[View], downscale: int | None = None) -> None:
        """Start decoding these views in the background, in this order.

        It replaces the order of the last call. Images that are decoded ahead use at most half of
        the budget, so that none is removed before its use. If a file cannot be decoded, the `get`
        that requests it raises the error.
        """
        with self._lock:
            factor = 1 if self.decodes_once else downscale
            self._queue = deque(self._key(view, factor) for view in order)
            wanted = set(self._queue)
            self._ahead = {key: size for key, size in self._ahead.items() if key in wanted}
            self._submit_queued()

    def get(self, view: View, downscale: int | None = None) -> LoadedImage:
        """The image of a view; its size is divided by ``downscale`` and rounded down.

        Args:
            view: the view.
            downscale: 1, 2 or 4; None uses ``level``.

        Raises:
            UserError: the file is missing, damaged, or not an image.
            ValueError: ``downscale`` is not 1, 2 or 4.
        """
        key = self._key(view, downscale)
        with self._lock:
            self._ahead.pop(key, None)
            if self._queue and self._queue[0] == key:
                self._queue.popleft()
            image = self._cache.get(key)
            if image is not None:
                self._cache.move_to_end(key)
                self._submit_queued()
                return image
            running = self._running.get(key)
        if self.decodes_once and key[2] > 1:
            image = box_downscale(self.get(view, 1), key[2])
            with self._lock:
                self._store(key, image)
            return image
        # If no thread decodes it yet, decode it in this thread instead of waiting for the queue.
        image = running.result() if running is not None else self._decode(key)
        with self._lock:
            self._store(key, image)
            self._submit_queued()
        return image

    @property
    def cached_bytes(self) -> int:
        """Bytes of decoded images in the cache."""
        with self._lock:  # `_store` exceeds the budget for a moment
            return self._cached_bytes

    def close(self) -> None:
        """Stop decoding ahead and empty the cache."""
        with self._lock:
            self._queue.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)
        with self._lock:  # after the last thread has added its image
            self._cache.clear()
            self._cached_bytes = 0

    def __enter__(self) -> ImageLoader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _key(self, view: View, factor: int | None) -> _Key:
        factor = self.level if factor is None else factor
        if factor not in _FACTORS:
            raise ValueError(f"downscale must be 1, 2 or 4, not {factor}")
        return view.image, view.mask, factor

    def _decode(self, key: _Key) -> LoadedImage:
        source, _, factor = key
        if source.path not in self._photos:
            return self._load([key])[0]
        lock, views = self._photos[source.path]
        with lock:
            with self._lock:
                if key in self._cache:  # another thread has decoded the photo
                    return self._cache[key]
                all_of_it = [(*view, factor) for view in views]
                more = all_of_it if self._fits(factor) else self._next_of(key)
                keys = [one for one in dict.fromkeys([key, *more]) if one not in self._cache]
            images = self._load(keys)
            with self._lock:
                for one, image in zip(keys, images, strict=True):
                    self._store(one, image)
        return images[0]

    def _load(self, keys: Sequence[_Key]) -> list[LoadedImage]:
        """Images of views of one photo, at one downscale factor."""
        with self._lock:
            whole = [self._cache.get((source, mask, 1)) for source, mask, _ in keys]
        if any(image is None or image.planes.device.type != "cpu" for image in whole):
            sources = [(source, mask) for source, mask, _ in keys]
            whole = [*load_views(sources, self._background)]
        factor = keys[0][2]
        return [box_downscale(image, factor).to(self.device) for image in whole if image]

    def _fits(self, *factors: int) -> bool:
        """Whether all views stay in the cache at these sizes, so that no work is done in vain."""
        keys = ((view.image, view.mask, factor) for view in self.views for factor in factors)
        return sum(map(_estimated_bytes, keys)) <= self.budget_bytes

    def _next_of(self, key: _Key) -> list[_Key]:
        """The views of the same photo that directly follow in the order, as many as may be decoded
        ahead. Needs the lock."""
        order = [*self._ahead, *self._queue]
        found = []
        for one in order[order.index(key) + 1 :] if key in order else order:
            same = (one[0].path, one[2]) == (key[0].path, key[2])
            if not same or not (one in self._ahead or self._may_decode_ahead(one)):
                break
            self._ahead[one] = _estimated_bytes(one)
            found.append(one)
        return found

    def _may_decode_ahead(self, key: _Key) -> bool:
        size = _estimated_bytes(key)
        return not self._ahead or sum(self._ahead.values()) + size <= self.budget_bytes // 2

    def _store(self, key: _Key, image: LoadedImage) -> None:
        """Add an image to the cache and remove others until the budget holds. Needs the lock.
        Images that were decoded ahead and not yet requested are removed last."""
        if key not in self._cache:
            self._cached_bytes += image.nbytes
        self._cache[key] = image
        self._cache.move_to_end(key)
        while self._cached_bytes > self.budget_bytes and len(self._cache) > 1:
            oldest = next((k for k in self._cache if k not in self._ahead), next(iter(self._cache)))
            self._cached_bytes -= self._cache.pop(oldest).nbytes

    def _submit_queued(self) -> None:
        """Start decoding as much of the queue as threads and budget allow. Needs the lock."""
        if self._submitting:  # if an image is ready, add_done_callback calls `_finished` at once
            return
        self._submitting = True
        while self._queue and len(self._running) < 2 * self._threads:
            key = self._queue[0]
            if key not in self._cache and key not in self._running:
                if not self._may_decode_ahead(key):
                    break
                try:
                    future = self._pool.submit(self._decode, key)
                except RuntimeError:  # the loader is closed, or the program is ending
                    self._queue.clear()
                    break
                self._ahead[key] = _estimated_bytes(key)
                self._running[key] = future
                future.add_done_callback(partial(self._finished, key))
            self._queue.popleft()
        self._submitting = False

    def _finished(self, key: _Key, future: Future[LoadedImage]) -> None:
        with self._lock:
            self._running.pop(key, None)
            if not future.cancelled() and future.exception() is None:
                self._store(key, future.result())
            self._submit_queued()


def _estimated_bytes(key: _Key) -> int:
    source, mask, factor = key
    planes = 4 if mask is None else 5
    return planes * (source.width // factor) * (source.height // factor)


def available_memory(device: torch.device | None = None) -> int:
    """Bytes of memory that this process can still allocate.

    ``device``: the device. For a CUDA device, the result is its free memory; otherwise the free
    memory of the computer without swap space, limited by the control group (container) of the
    process.
    """
    if device is not None and device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return available_memory_bytes()
