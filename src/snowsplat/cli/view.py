"""`snowsplat view`: a finished scene in the browser."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.scene import cameras_of, folder_around, training_folder
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians


@dataclass
class View:
    """Fly through a finished scene in the browser; Ctrl-C ends it.

    Examples:
      snowsplat view out/garden
      snowsplat view garden.spz
      snowsplat view out/garden --no-browser --port 8080

    The page is on this machine alone, at an address that nobody can guess. It starts at the first
    photo of a training. Drag to turn, scroll to come near, W A S D to fly; the page has the rest.
    """

    path: Annotated[Path | None, tyro.conf.Positional, flag("FILE|OUT")] = None
    """A scene file of any format, or the output folder of train or make."""
    iteration: Annotated[int | None, flag("N", default="the last")] = None
    """Which of the scenes in OUT."""
    host: Annotated[str, flag("ADDRESS", default="127.0.0.1, this machine alone")] = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other computers in."""
    port: Annotated[int, flag("N", default="a free one")] = 0
    """Port to listen on."""
    no_browser: Annotated[bool, switch()] = False
    """Only print the address."""

    def run(self) -> int:
        """Gives the exit code: 0, after Ctrl-C too, which is how one leaves."""
        from snowsplat.viewer.hosts import ANY_HOST
        from snowsplat.viewer.web.scene import site
        from snowsplat.viewer.web.server import StaticServer

        if self.path is None:
            raise UserError("view needs a scene; name a file or the output folder of a training")
        name, gaussians, cameras, background = self._load(self.path)
        if not len(gaussians):
            raise UserError(f"{name}: holds no Gaussians; there is nothing to see")
        files, headers = site(
            f"{self.path.resolve().name} - snowsplat", gaussians, cameras, background
        )
        with StaticServer(files, headers, self.host, self.port) as server:
            print(f"{name}: {len(gaussians):,} Gaussians")
            print(server.url, flush=True)
            if self.host in ANY_HOST:
                print(f"from other computers: {server.url_at(socket.gethostname())}", flush=True)
            elif over_ssh():
                print(f"from your computer: {forwarding(server.port)}", flush=True)
            if not self.no_browser and has_screen():
                open_browser(server.url)
            wait_for_interrupt()
        return 0

    def _load(self, path: Path) -> tuple[Path, Gaussians, list[Camera], tuple[float, float, float]]:
        """The scene's file, the scene, the cameras of its photos, the background colour."""
        from snowsplat.formats import read_gaussians

        if not path.exists():
            raise UserError(f"{path}: no such file or folder")
        if path.is_dir():
            folder = training_folder(path)
            iteration, gaussians = folder.read_scene(self.iteration)
            scene = folder.scene_path(iteration)
        else:
            if self.iteration is not None:
                raise UserError("--iteration chooses a scene of an output folder, not of a file")
            scene, gaussians = path, read_gaussians(path)
            folder = folder_around(path)
        cameras = cameras_of(folder)
        background = folder.settings()[1] if folder.is_one() else (0.0, 0.0, 0.0)
        return scene, gaussians, cameras, background


def over_ssh() -> bool:
    """Whether this shell is on another computer than the one that the user sits at."""
    return any(name in os.environ for name in ("SSH_CONNECTION", "SSH_TTY"))


def forwarding(port: int) -> str:
    """The command that makes a port of this machine one of the user's own."""
    import getpass

    return f"ssh -L {port}:127.0.0.1:{port} {getpass.getuser()}@{socket.gethostname()}"


def has_screen() -> bool:
    """Whether a browser that is opened here can be seen: else one of text would take the shell."""
    if sys.platform in ("win32", "darwin"):
        return not over_ssh()
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_browser(url: str) -> None:
    """In the background: some browsers hold the program that opens them."""
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


def wait_for_interrupt() -> None:
    """Returns at Ctrl-C, or when the process is asked to end."""
    ended = threading.Event()
    before = signal.signal(signal.SIGTERM, lambda *_: ended.set())
    try:
        while not ended.wait(1.0):  # Windows lets Ctrl-C through between two waits only
            pass
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)
