"""The page of a training: `LivePage`, and `Watchers`, with which `snowsplat watch` opens it later.

A training listens at a local socket in its output folder, in a folder that only its owner can
enter. A watcher sends one line of JSON, the address that the page shall have (`PageRequest`), and
gets one, the URL of the page or an error (`PageReply`). The page stays until the last watcher
closes its connection. The socket of a killed training refuses connections; the next run removes it.

A thread waits at the socket, so that a training which nobody watches does nothing for it.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import stat
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from snowsplat.data import Dataset
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.run.processes import count
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.trainer import Trainer
from snowsplat.util.safe_json import from_json, parse_json
from snowsplat.viewer.hosts import LOCAL_HOST, KnownHosts, listen

if TYPE_CHECKING:  # most trainings have no page; importing its server takes 0.1 s
    from snowsplat.viewer.live.training import TrainingViewer
    from snowsplat.viewer.live.viewer import NetworkViewer

#: The folder of the socket, in the output folder.
FOLDER = ".snowsplat.watch"
_SOCKET = "socket"
_MOST = 1 << 16  # bytes of a line
_OPEN_FILES = "/proc/self/fd"  # on Linux
_MOST_PATH = 100  # bytes of the path of a socket; 103 on macOS, 107 on Linux
_SEND_SECONDS = 1.0  # a watcher that does not read its reply is not waited for


@dataclass(frozen=True)
class PageRequest:
    """The address of the page; see `LivePage`."""

    port: int | None = None
    host: str | None = None
    allow_host: tuple[str, ...] = ()


@dataclass(frozen=True)
class PageReply:
    """Where the page is, or why there is none."""

    url: str = ""
    others: list[str] = field(default_factory=list)
    error: str = ""


@contextmanager
def socket_in(output: Path, create: bool = False) -> Iterator[str]:
    """The path of the socket of a training, valid inside the context.

    Paths of sockets have at most about 100 bytes. On Linux, a short name of the open folder takes
    the place of a longer path, and elsewhere a link in a private folder for temporary files.
    Raises: OSError: there is no such folder, or other users can enter it or own it.
    """
    if create:
        with suppress(FileExistsError):
            (output / FOLDER).mkdir(mode=0o700)
    folder = os.open(output / FOLDER, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if create:  # it may have been copied from elsewhere
            os.fchmod(folder, 0o700)
        status = os.fstat(folder)
        if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise PermissionError(f"{output / FOLDER} is not that of this user only")
        path, own = output / FOLDER / _SOCKET, Path(f"{_OPEN_FILES}/{folder}")
        if own.exists():
            yield str(own / _SOCKET)
        elif len(os.fsencode(path)) <= _MOST_PATH:
            yield str(path)
        else:
            with TemporaryDirectory(prefix="snow") as short:
                link = Path(short) / "f"
                link.symlink_to((output / FOLDER).absolute())
                yield str(link / _SOCKET)
    finally:
        os.close(folder)


class Watchers:
    """The page of a training run: the given one, or one for as long as somebody watches.

    As a context manager, it listens. Call `after_step` after each step.
    """

    def __init__(self, output: Path, trainer: Trainer, page: LivePage | None = None) -> None:
        """
        ``page``: the page that is open from the beginning; None: there is none yet.
        """
        self._output, self._trainer = output, trainer
        self._page, self._given = page, page is not None
        self._listener: socket.socket | None = None
        # What follows is shared with the thread.
        self._lock = threading.Lock()
        self._asking: list[tuple[socket.socket, PageRequest]] = []
        self._watching: set[socket.socket] = set()
        self._deserted = False  # the last watcher has left the page

    def __enter__(self) -> Watchers:
        # The page needs one process; Python has no such sockets on Windows, some file systems, too.
        if count() == 1 and sys.platform != "win32":
            with suppress(OSError):  # then nobody can watch
                self._listen()
        if self._listener is not None:
            self._stop, self._stopped = socket.socketpair()
            self._thread = threading.Thread(target=self._serve, daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._listener is None:
            return
        self._stop.close()
        self._thread.join()
        self._close_page()
        for end in (self._listener, self._stopped):
            end.close()
        self._remove_socket()

    def _listen(self) -> None:
        """Raises OSError: there is no folder, or the file system has no sockets."""
        # The folder may be moved while the training runs.
        self._place = os.open(self._output, os.O_RDONLY | os.O_DIRECTORY)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with socket_in(self._output, create=True) as path:
                Path(path).unlink(missing_ok=True)
                listener.bind(path)
                listener.listen()
        except OSError:
            listener.close()
            self._remove_socket()
            raise
        self._listener = listener

    def _remove_socket(self) -> None:
        with suppress(OSError):  # the output folder was removed
            os.unlink(f"{FOLDER}/{_SOCKET}", dir_fd=self._place)
        with suppress(OSError):
            os.rmdir(FOLDER, dir_fd=self._place)
        os.close(self._place)

    def after_step(self, step: int, steps: int, loss: float, gaussians: Gaussians) -> float:
        """Update the page after a step; returns the seconds for which the training waited.

        See `TrainingViewer.after_step`.
        """
        waited = 0.0
        if self._asking or self._deserted:
            started = time.monotonic()
            self._open_or_close()
            waited = time.monotonic() - started
        if self._page is not None and (training := self._page.training) is not None:
            waited += training.after_step(step, steps, loss, gaussians)
        return waited

    def _open_or_close(self) -> None:
        with self._lock:
            self._deserted = False
            asking, self._asking = self._asking, []
            for connection, request in asking:
                self._answer(connection, request)
            if not self._watching:
                self._close_page()

    def _answer(self, connection: socket.socket, request: PageRequest) -> None:
        viewer = None if self._page is None else self._page.viewer
        if viewer is None:
            try:
                page = LivePage(request.port, request.host, request.allow_host)
                try:
                    label = self._output.absolute().name
                    viewer = page.open_training(self._trainer, label).viewer
                except BaseException:
                    page.close()
                    raise
            except Exception as error:  # the training goes on without a page
                _send(connection, PageReply(error=str(error) or type(error).__name__))
                return
            self._page = page
        _send(connection, PageReply(viewer.url, viewer.others))
        self._watching.add(connection)

    def _close_page(self) -> None:
        page = self._page
        if page is not None and not self._given:
            self._page = None
            page.close()

    # The following methods run in the thread.

    def _serve(self) -> None:
        assert self._listener is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            selector.register(self._stopped, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    found: Any = key.fileobj
                    if found is self._stopped:
                        for each in list(selector.get_map().values()):
                            if each.data is not None:
                                each.fileobj.close()  # type: ignore[union-attr]
                        return
                    if found is self._listener:
                        with suppress(OSError):  # the watcher has already gone
                            connection, _ = self._listener.accept()
                            connection.settimeout(_SEND_SECONDS)
                            selector.register(connection, selectors.EVENT_READ, bytearray())
                    elif not self._read(found, key.data):
                        selector.unregister(found)
                        self._leave(found)

    def _read(self, connection: socket.socket, line: bytearray) -> bool:
        """Read a part of the line of a watcher; False at the end of the connection."""
        try:
            received = connection.recv(_MOST)
        except OSError:
            return False
        line += received
        if not received or len(line) > _MOST:
            return False
        if line.endswith(b"\n"):
            try:
                request = from_json(PageRequest, parse_json(bytes(line)))
            except ValueError:
                return False
            line.clear()
            with self._lock:
                if self._page is None:
                    self._asking.append((connection, request))
                else:
                    self._answer(connection, request)
        return True

    def _leave(self, connection: socket.socket) -> None:
        with self._lock:
            connection.close()
            self._watching.discard(connection)
            self._asking = [each for each in self._asking if each[0] is not connection]
            viewer = None if self._page is None else self._page.viewer
            if not self._watching and viewer is not None and not self._given:
                viewer.session.resume()  # nobody else could
                self._deserted = True


def _send(connection: socket.socket, reply: PageReply) -> None:
    with suppress(OSError):  # the thread notices that the watcher has gone
        connection.sendall(json.dumps(asdict(reply)).encode() + b"\n")


class LivePage:
    """A page at ``port`` of this machine; as a context manager, it closes the page at the end.

        with LivePage() as page:
            train("garden", "out/garden", page=page)
            page.show_result()

    Attributes:
        viewer: the page while it is open.
        training: shows a training run there, if one has begun.
    """

    def __init__(
        self, port: int | None = None, host: str | None = None, allow_host: Sequence[str] = ()
    ) -> None:
        """
        Args:
            port: None: 8080, or the next free one.
            host: address at which to listen; None: accept connections from this machine only.
            allow_host: names of proxies; see `KnownHosts`.

        Raises: UserError: the port is in use, this machine cannot listen at ``host``, or an allowed
        name is none.
        """
        self.port, self.host, self.allow_host = port, host or LOCAL_HOST, allow_host
        KnownHosts(self.host, allow_host)
        self.viewer: NetworkViewer | None = None
        self.training: TrainingViewer | None = None
        self._trainer: Trainer | None = None
        listen(self.host, port).close()

    def __enter__(self) -> LivePage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(
        self,
        dataset: Dataset,
        background: tuple[float, float, float],
        label: str,
        observer: Observer = SILENT,
    ) -> NetworkViewer:
        """Open the page, and report its address to the observer.

        ``background``: red, green, blue in 0..1. ``label``: the title of the page.
        Raises: UserError: another process has opened the port since the constructor checked it.
        """
        from snowsplat.viewer.live.viewer import NetworkViewer

        viewer = NetworkViewer(
            dataset,
            background,
            host=self.host,
            port=self.port,
            label=label,
            allow_host=self.allow_host,
        )
        self.viewer = viewer
        observer.page_opened(viewer)
        return viewer

    def open_training(
        self, trainer: Trainer, label: str, observer: Observer = SILENT
    ) -> TrainingViewer:
        """Open the page for a training run, as `open`; call `after_step` of the returned object."""
        from snowsplat.viewer.live.training import SampledPsnr, TrainingViewer

        white = trainer.config.background == "white"
        background = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
        viewer = self.open(trainer.dataset, background, label, observer)
        views = trainer.dataset.test or trainer.dataset.train
        self.training = TrainingViewer(viewer, SampledPsnr(views, viewer.background))
        self._trainer = trainer
        return self.training

    @property
    def url(self) -> str:
        assert self.viewer is not None
        return self.viewer.url

    def show_result(self, gaussians: Gaussians | None = None) -> None:
        """Show a scene until Ctrl-C: by default, that of the finished training run."""
        assert self.training is not None
        assert self._trainer is not None
        with suppress(KeyboardInterrupt):
            shown = self._trainer.gaussians if gaussians is None else gaussians
            self.training.show(self._trainer.step, shown)

    def close(self) -> None:
        """Close the page if it is open, and release the trainer."""
        viewer, self.viewer = self.viewer, None
        self.training = self._trainer = None
        if viewer is not None:
            viewer.close()
