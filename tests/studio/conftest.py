"""A library, and a studio that serves it."""

import base64
import http.client
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.formats import write_gaussians
from snowsplat.pipeline.publish import publish
from snowsplat.project.studio_scene import StudioScene
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.studio import job, worker
from snowsplat.studio.app import POLICY, studio_app
from snowsplat.studio.library import Library
from snowsplat.util.errors import UserError
from snowsplat.util.messages import as_message
from snowsplat.viewer.http.server import WebServer

from .. import fork_server
from ..browser import Page

#: A worker that only holds the lock of a job, and saves when it is asked to end.
HOLDER = """
import os, signal, socket, sys, time
from pathlib import Path
from snowsplat.project.studio_scene import StudioScene
from snowsplat.util.run_lock import InUse, locked
task, scene = sys.argv[1], StudioScene(Path(sys.argv[2]))
def end(*_):
    scene.write_state({"outcome": "stopped"}, task)
    sys.exit(130)
signal.signal(signal.SIGTERM, end)
try:
    with locked(scene.lock(task), "", wait=0.0):
        scene.write_state({"process": os.getpid(), "host": socket.gethostname()}, task)
        time.sleep(60)
except InUse:
    sys.exit(2)
"""


def of_the_command_line(folder: Path, step: int = 5) -> Path:
    """An output folder of training; returns its scene."""
    folder.mkdir(exist_ok=True)
    settings = "eval=True, images='images', resolution=-1, sh_degree=1, source_path='photos'"
    (folder / "cfg_args").write_text(f"Namespace({settings}, white_background=False)")
    file = TrainingFolder(folder).scene_path(step)
    file.parent.mkdir(parents=True)
    box = torch.tensor([[-2.0, -1.0, -0.1], [2.0, 1.0, 0.1]])
    write_gaussians(file, gaussians_in_box(box, 50, torch.Generator().manual_seed(0), 1))
    return file


N = 301  # Gaussians of the scene `finished`


def edit_of(removed: np.ndarray, **more) -> dict:
    """What a page sends: ``removed`` has a value for each of its Gaussians."""
    bits = np.packbits(removed, bitorder="little").tobytes()
    return {"count": len(removed), "removed": base64.b64encode(bits).decode(), **more}


def press(page: Page, text: str) -> None:
    page.evaluate(
        f"[...document.querySelectorAll('.snow-panel button')]"
        f".find(each => each.textContent === {text!r}).click()"
    )


@dataclass
class Studio:
    library: Library
    server: WebServer

    def ask(
        self, path: str, method: str = "GET", body: Any = None, **headers: str
    ) -> tuple[int, Any]:
        """Status and answer; an object is sent and received as JSON. A path may have a token."""
        data = json.dumps(body) if isinstance(body, dict) else body
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=60)
        base = "" if path.startswith("/") else urlsplit(self.server.url).path
        connection.request(method, base + path, data, headers)
        response = connection.getresponse()
        answer = response.read()
        connection.close()
        if response.headers.get("Content-Type") != "application/json":
            return response.status, answer
        value = json.loads(answer)
        if isinstance(value, dict) and isinstance(value.get("error"), dict):
            value["error"] = value["error"]["en"]
        return response.status, value


@pytest.fixture
def library(tmp_path, monkeypatch) -> Library:
    monkeypatch.setattr(job, "_started", {})
    return Library(tmp_path / "library")


@pytest.fixture
def studio(library) -> Iterator[Studio]:
    policy = {"Content-Security-Policy": POLICY}
    app = studio_app(library, lambda: ["http://192.168.1.7:80/token/"])
    with WebServer(app, headers=policy) as server:
        yield Studio(library, server)


@pytest.fixture
def in_process(monkeypatch) -> None:
    """Short tasks of the worker run in this process: a new one needs seconds to import torch."""

    def work(scene: StudioScene, verb: str, **settings: Any) -> dict[str, Any]:
        printed = io.StringIO()
        with redirect_stdout(printed):
            worker.main([verb, str(scene.folder), json.dumps(settings)])
        answer = json.loads(printed.getvalue().splitlines()[-1])
        if "error" in answer:
            raise UserError(as_message(answer["error"]))
        return answer

    monkeypatch.setattr(job, "work", work)


@pytest.fixture
def forked(monkeypatch) -> None:
    """The processes of the worker are forks of one that has imported torch."""

    def start(command: list[str], stdout: IO[bytes], **_: Any) -> fork_server.Process:
        return fork_server.popen(*command[1:], stdout=stdout.fileno(), stderr=subprocess.STDOUT)

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[bytes]:
        done = fork_server.run(*command[1:])
        out, err = done.stdout.encode(), done.stderr.encode()
        return subprocess.CompletedProcess(command, done.returncode, out, err)

    of_forks = SimpleNamespace(Popen=start, run=run, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr(job, "subprocess", of_forks)


@pytest.fixture
def holder(monkeypatch, tmp_path) -> None:
    """Replaces the worker: jobs hold their lock until they are stopped."""
    script = tmp_path / "holder.py"
    script.write_text(HOLDER)
    monkeypatch.setattr(job, "_WORKER", [sys.executable, str(script)])


@pytest.fixture
def finished(library) -> StudioScene:
    """A scene of Gaussians in a flat box, as a job leaves it."""
    scene = library.new("Box", [])
    box = torch.tensor([[-2.0, -1.0, -0.1], [2.0, 1.0, 0.1]])
    gaussians = gaussians_in_box(box, N, torch.Generator().manual_seed(0), 1)
    file = scene.made / "box.ply"
    file.parent.mkdir()
    write_gaussians(file, gaussians)
    publish(file, scene.site)
    scene.change(quality="draft")
    facts = {"gaussians": N, "bytes": 1, "psnr": None, "seconds": 1.0}
    result = {"file": file.name, "aligned": False, "reports": {}, **facts}
    result["shown"] = [str(file.stat().st_mtime_ns), scene.job.title]
    scene.write_state({"outcome": "done", "result": result})
    return scene
