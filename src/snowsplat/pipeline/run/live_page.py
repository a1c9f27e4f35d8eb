"""The page of a training: `LivePage`, and `Watchers`, with which `snowsplat watch` opens it later.

A training listens for watchers of the same user and computer. A file in its output folder, which
only its user can read, has the address and a key. A watcher sends the address that the page shall
have (`PageRequest`), and gets the URL of the page or an error (`PageReply`), both as JSON. The page
stays until the last watcher closes its connection. The address of a killed training is refused; the
next run replaces the file.

Threads wait for watchers, so that a training which nobody watches does nothing for them.
"""

from __future__ import annotations

import json
import os
import secrets
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import AuthenticationError
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.data import Dataset
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.run.processes import count
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.trainer import Trainer
from snowsplat.util.safe_json import from_json, parse_json, read_json
from snowsplat.viewer.hosts import LOCAL_HOST, KnownHosts, listen

if TYPE_CHECKING:  # most trainings have no page; importing its server takes 0.1 s
    from multiprocessing.connection import Connection, Listener

    from snowsplat.viewer.live.training import TrainingViewer
    from snowsplat.viewer.live.viewer import NetworkViewer

#: The file with the address, in the output folder.
ADDRESS = ".snowsplat.watch"
MOST = 1 << 16  # bytes of a message


@dataclass(frozen=True)
class PageRequest:
    """The address of the page; see `LivePage`."""

    port: int | None = None
    host: str | None = None
    allow_host: tuple[str, ...] = ()


@dataclass(frozen=True)
class Place:
    """Where a training listens: the content of the file."""

    address: str
    key: str  # hexadecimal

    @classmethod
    def of(cls, output: Path) -> Place:
        """That of the training in a folder. Raises: OSError, ValueError: there is none."""
        if (output / ADDRESS).stat().st_uid != os.getuid():
            raise PermissionError(f"{output / ADDRESS} is that of another user")
        return from_json(Place, read_json(output / ADDRESS))

    def connect(self) -> Connection:
        """A connection to the training. Raises: OSError, EOFError, ValueError,
        AuthenticationError: it has ended, or runs on another computer."""
        from multiprocessing.connection import Client

        return Client(self.address, authkey=bytes.fromhex(self.key))


@dataclass(frozen=True)
class PageReply:
    """Where the page is, or why there is none."""

    url: str = ""
    others: list[str] = field(default_factory=list)
    error: str = ""


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
        self._listener: Listener | None = None
        # What follows is shared with the threads.
        self._lock = threading.Lock()
        self._asking: list[tuple[Connection, PageRequest]] = []
        self._watching: list[Connection] = []
        self._deserted = self._ended = False  # the last watcher has left the page; the training

    def __enter__(self) -> Watchers:
        # The page needs one process. Some file systems have no files that only their user can read.
        if count() == 1 and sys.platform != "win32":
            with suppress(OSError):  # then nobody can watch
                self._listen()
        return self

    def __exit__(self, *_: object) -> None:
        if self._listener is None:
            return
        self._ended = True
        with suppress(OSError, EOFError, AuthenticationError):
            self._place.connect().close()  # wakes the thread that accepts connections
        self._listener.close()
        with self._lock:
            for connection in [*self._watching, *(each for each, _ in self._asking)]:
                _send(connection, None)
        self._close_page()
        with suppress(OSError):  # the output folder was removed
            os.unlink(ADDRESS, dir_fd=self._folder)
        os.close(self._folder)

    def _listen(self) -> None:
        """Raises OSError: the file cannot be written, or there are no local sockets."""
        from multiprocessing.connection import Listener

        key = secrets.token_bytes(32)
        listener = Listener(authkey=key)
        file = self._output / ADDRESS
        file.unlink(missing_ok=True)  # of a killed training
        self._place = Place(str(listener.address), key.hex())
        with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as place:
            json.dump(asdict(self._place), place)
        self._folder = os.open(self._output, os.O_RDONLY)  # it may be moved
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def after_step(self, step: int, steps: int, loss: float, gaussians: Gaussians) -> float:
        """Update the page after a step; returns the seconds for which the training waited.

        See `TrainingViewer.after_step`.
        """
        waited = 0.0
        if self._asking or self._deserted:
            started = time.monotonic()
            with self._lock:
                self._deserted = False
                asking, self._asking = self._asking, []
                for connection, request in asking:
                    self._answer(connection, request)
                if not self._watching:
                    self._close_page()
            waited = time.monotonic() - started
        if self._page is not None and (training := self._page.training) is not None:
            waited += training.after_step(step, steps, loss, gaussians)
        return waited

    def _answer(self, connection: Connection, request: PageRequest) -> None:
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
        self._watching.append(connection)

    def _close_page(self) -> None:
        page = self._page
        if page is not None and not self._given:
            self._page = None
            page.close()

    # The following methods run in the threads.

    def _accept(self, listener: Listener) -> None:
        while not self._ended:
            try:
                connection = listener.accept()
            except (OSError, EOFError, AuthenticationError):  # the watcher has already gone
                continue
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: Connection) -> None:
        with connection:
            try:
                request = from_json(PageRequest, parse_json(connection.recv_bytes(MOST)))
                with self._lock:
                    if self._page is None:
                        self._asking.append((connection, request))
                    else:
                        self._answer(connection, request)
                connection.recv_bytes(MOST)  # returns when the watcher leaves
            except (OSError, EOFError, ValueError):
                self._leave(connection)

    def _leave(self, connection: Connection) -> None:
        with self._lock:
            self._watching = [each for each in self._watching if each is not connection]
            self._asking = [each for each in self._asking if each[0] is not connection]
            viewer = None if self._page is None else self._page.viewer
            if not self._watching and viewer is not None and not self._given:
                viewer.session.resume()  # nobody else could
                self._deserted = True


def _send(connection: Connection, reply: PageReply | None) -> None:
    """Send a reply; None: the training has ended."""
    with suppress(OSError):  # its thread notices that the watcher has gone
        connection.send_bytes(json.dumps(reply and asdict(reply)).encode())


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
