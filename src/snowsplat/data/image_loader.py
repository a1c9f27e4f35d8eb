"""Images for training: decoded ahead in background threads, kept as far as a memory budget goes.

What `ImageLoader.get` returns depends on the files alone, never on which thread was first or on
what was kept: a cache miss decodes the same bytes again.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import torch

from snowsplat.data.dataset import View
from snowsplat.data.decode import ImageSource, LoadedImage, box_downscale, load_image, load_mask

#: Threads that decode ahead.
DECODERS = min(4, os.cpu_count() or 1)

_Key = tuple[ImageSource, ImageSource | None, int]


class ImageLoader:
    """Decoded images of views, least recently used ones dropped when the budget is full.

        loader = ImageLoader(capture.train, background=(1, 1, 1))
        loader.prefetch(order)              # the views in the order in which they will be asked for
        for view in order:
            target = loader.get(view).rgb   # (H, W, 3) uint8

    Args:
        views: those that will be asked for; any other view is served too.
        level: the downscale (1, 2 or 4) that is meant where a call names none.
        background: colour in 0..1 to compose transparent images over; None keeps their alpha.
        budget_bytes: memory for decoded images; None takes half of what is available now.
        device: where they are kept, and what `get` gives them on.
        threads: that decode ahead; None takes `DECODERS`.
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
        self._device = device or torch.device("cpu")
        if budget_bytes is None:
            budget_bytes = available_memory(self._device) // 2
        self.budget_bytes = budget_bytes
        self._background = None if background is None else tuple(float(c) for c in background)
        self._threads = threads or DECODERS
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="snowsplat-images")
        self._lock = threading.RLock()
        self._cache: OrderedDict[_Key, LoadedImage] = OrderedDict()  # oldest use first
        self._cached_bytes = 0
        self._queue: deque[_Key] = deque()  # to be decoded ahead
        self._running: dict[_Key, Future[LoadedImage]] = {}
        self._ahead: dict[_Key, int] = {}  # decoded or being decoded, not yet asked for: bytes
        self._pumping = False

    def prefetch(self, order: Iterable[View], downscale: int | None = None) -> None:
        """Decode in the background what is asked for next, in this order; replaces the last.

        Only as far ahead as half of the budget, so that nothing is dropped before its use. A file
        that cannot be decoded is reported by the `get` that asks for it.
        """
        with self._lock:
            self._queue = deque(self._key(view, downscale) for view in order)
            wanted = set(self._queue)
            self._ahead = {key: size for key, size in self._ahead.items() if key in wanted}
            self._pump()

    def get(self, view: View, downscale: int | None = None) -> LoadedImage:
        """The image of a view, its sizes divided by ``downscale`` and rounded down.

        Raises:
            UserError: the file is absent, damaged, or not an image.
        """
        key = self._key(view, downscale)
        with self._lock:
            self._ahead.pop(key, None)
            if self._queue and self._queue[0] == key:
                self._queue.popleft()
            image = self._cache.get(key)
            if image is not None:
                self._cache.move_to_end(key)
                self._pump()
                return image
            running = self._running.get(key)
        # In the caller's own thread unless it is under way already: not behind others in the queue.
        image = running.result() if running is not None else self._decode(key)
        with self._lock:
            self._keep(key, image)
            self._pump()
        return image

    @property
    def cached_bytes(self) -> int:
        """Bytes of decoded images held now."""
        with self._lock:  # not between an image that comes and those that go for it
            return self._cached_bytes

    def close(self) -> None:
        """Stop decoding ahead and forget the images."""
        with self._lock:
            self._queue.clear()
            self._cache.clear()
            self._cached_bytes = 0
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> ImageLoader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _key(self, view: View, factor: int | None) -> _Key:
        factor = self.level if factor is None else factor
        if factor not in (1, 2, 4):
            raise ValueError(f"downscale is 1, 2 or 4, not {factor}")
        return view.image, view.mask, factor

    def _decode(self, key: _Key) -> LoadedImage:
        source, mask, factor = key
        with self._lock:
            image = self._cache.get((source, mask, 1))
        if image is None or image.planes.device.type != "cpu":
            planes = load_image(source, self._background)
            image = LoadedImage(planes, None if mask is None else load_mask(mask))
        return box_downscale(image, factor).to(self._device)

    def _keep(self, key: _Key, image: LoadedImage) -> None:
        if key not in self._cache:
            self._cached_bytes += image.nbytes
        self._cache[key] = image
        self._cache.move_to_end(key)
        while self._cached_bytes > self.budget_bytes and len(self._cache) > 1:
            oldest = next((k for k in self._cache if k not in self._ahead), next(iter(self._cache)))
            self._cached_bytes -= self._cache.pop(oldest).nbytes

    def _pump(self) -> None:
        """Start decoding as much of the queue as threads and budget allow. Holds the lock."""
        if self._pumping:  # called back by an image that was ready at once
            return
        self._pumping = True
        while self._queue and len(self._running) < 2 * self._threads:
            key = self._queue[0]
            if key not in self._cache and key not in self._running:
                size = _estimated_bytes(key)
                if self._ahead and sum(self._ahead.values()) + size > self.budget_bytes // 2:
                    break
                try:
                    future = self._pool.submit(self._decode, key)
                except RuntimeError:  # closed, or the program is ending: nothing will be asked for
                    self._queue.clear()
                    break
                self._ahead[key] = size
                self._running[key] = future
                future.add_done_callback(partial(self._finished, key))
            self._queue.popleft()
        self._pumping = False

    def _finished(self, key: _Key, future: Future[LoadedImage]) -> None:
        with self._lock:
            self._running.pop(key, None)
            if not future.cancelled() and future.exception() is None:
                self._keep(key, future.result())
            self._pump()


def _estimated_bytes(key: _Key) -> int:
    source, mask, factor = key
    planes = 4 if mask is None else 5
    return planes * (source.width // factor) * (source.height // factor)


def available_memory(device: torch.device | None = None) -> int:
    """Bytes that this process may still take: of a GPU, or (default) of the computer.

    There without swapping; the container's limit counts.
    """
    if device is not None and device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    available = 4 << 30  # where nothing tells
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        available = next(int(s.split()[1]) for s in lines if s.startswith("MemAvailable:")) << 10
    except (OSError, StopIteration, ValueError, IndexError):
        if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
            available = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        (
            "/sys/fs/cgroup/memory/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/memory.usage_in_bytes",
        ),
    ):
        try:
            left = int(Path(limit).read_text()) - int(Path(used).read_text())
        except (OSError, ValueError):  # no such limit ("max")
            continue
        available = min(available, max(left, 0))
    return available
