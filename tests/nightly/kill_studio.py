"""Kills the studio, its jobs and its browser at random moments, and checks that nothing is lost.

    PYTHONPATH=src python tests/nightly/kill_studio.py --kills 50 --photos FOLDER

FOLDER has about 20 photos; without it, they are rendered. The real `snowsplat studio` runs in a
new library: a scene is uploaded, looked at, made, edited, filmed and handed on. In each of these
stages, a random process (the server, a process of the worker, the browser) gets SIGKILL at a
random moment. Then the studio is started again, what was interrupted is continued, and everything
that was there before the kill must be there: photos, finished stages, edits, the film and its
plan. At no time do two processes make one scene. The last line counts the kills; the exit code is
1 if something was lost or done twice.
"""

import argparse
import base64
import collections
import contextlib
import http.client
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.browser import Browser, BrowserError, chromium
from tests.kill.harness import names_in

from snowsplat.formats import read_gaussians
from snowsplat.formats.sog import read_sog
from snowsplat.pipeline.edit import moved_film, page_frames
from snowsplat.project.edit_record import read_record
from snowsplat.project.page_film import PageFilm
from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio.changes import _written_at
from snowsplat.studio.library import Library
from snowsplat.synthetic import write_synthetic_photos
from snowsplat.util.safe_json import from_json

SHARES = {"upload": 8, "survey": 4, "make": 16, "edit": 9, "film": 5, "export": 5, "browser": 3}
KEYS = [[0.0, 1.0, -6.0, 0.0, 0.0, 0.0, 40.0, 1.5], [1.0, 1.0, -6.0, 0.0, 0.0, 0.0, 40.0, 1.5]]
PART = 16 << 10  # bytes


class Lost(AssertionError):
    """Something is lost, or was done twice."""


def check(true: object, what: str) -> None:
    if not true:
        raise Lost(what)


def wait_for(true: Callable[[], object], seconds: float = 900.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        check(time.monotonic() < end, "not done in time")
        time.sleep(0.2)


class Server:
    """The process of the studio of a library; `ask` starts it again if it was killed."""

    def __init__(self, library: Path) -> None:
        self.library, self.process = library, None
        self.url = ""

    def start(self) -> None:
        command = [sys.executable, "-m", "snowsplat", "studio", self.library, "--no-browser"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        lines = self.process.stdout.readline() + self.process.stdout.readline()
        found = re.search(r"http://\S+", lines)
        check(found, f"the studio did not start: {lines}")
        check(self.url != found[0], "the studio has the same token after a kill")
        self.url = found[0]

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def ask(self, path: str, method: str = "GET", body: Any = None) -> tuple[int, Any]:
        if self.process is None or self.process.poll() is not None:
            self.start()
        base = urlsplit(self.url)
        connection = http.client.HTTPConnection(base.hostname, base.port, timeout=900)
        data = json.dumps(body) if isinstance(body, dict) else body
        with contextlib.closing(connection):
            connection.request(method, base.path + path, data)
            response = connection.getresponse()
            answer = response.read()
        if response.headers.get("Content-Type") == "application/json":
            return response.status, json.loads(answer)
        return response.status, answer


def workers(folder: Path, task: str = "") -> list[int]:
    """The processes of the worker for a scene; without a task, all."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (process / "cmdline").read_bytes().split(b"\0")
            ours = b"snowsplat.studio" in words and str(folder).encode() in words
            if ours and (not task or task.encode() in words):
                found.append(int(process.name))
    return found


class Kills:
    def __init__(self, photos: Path, folder: Path, seed: int) -> None:
        self.photos = {path.name: path.read_bytes() for path in sorted(photos.iterdir())}
        self.random = random.Random(seed)
        self.server = Server(folder / "library")
        self.counts: collections.Counter[str] = collections.Counter()
        self.name = self.server.ask("scenes", "POST", {"title": "Fox"})[1]["name"]
        self.address = f"scenes/{self.name}"
        self.files = folder / "photos"
        self.files.mkdir()
        for name, data in self.photos.items():
            (self.files / name).write_bytes(data)

    @property
    def scene(self) -> StudioScene:
        return Library(self.server.library).find(self.name)

    def ask(self, path: str = "", method: str = "GET", body: Any = None) -> Any:
        status, answer = self.server.ask(self.address + path, method, body)
        check(status == 200, f"{method} {path}: {status} {answer}")
        return answer

    def kill_during(self, stage: str, seconds: float, *, work: Callable[[], Any]) -> None:
        """Run a request, and kill the server or the worker, or both, at a random moment of it."""
        failures: list[BaseException] = []

        def run() -> None:
            try:
                work()
            except (OSError, http.client.HTTPException, Lost) as error:
                failures.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        self.pause(seconds)
        victim = self.random.choice(["server", "worker", "both"])
        hit = victim != "server" and self.kill_workers()
        if victim != "worker":
            self.server.kill()
        elif not hit:
            victim = "nothing: it had ended"
        thread.join(900)
        self.note(stage, victim)

    def pause(self, seconds: float) -> None:
        time.sleep(self.random.uniform(0, seconds))

    def kill_workers(self, task: str = "") -> list[int]:
        found = workers(self.scene.folder, task)
        for process in found:
            with contextlib.suppress(ProcessLookupError):
                # A job has its own group, with its children; other work belongs to the server's.
                group = os.getpgid(process)
                os.killpg(process, signal.SIGKILL) if group == process else os.kill(
                    process, signal.SIGKILL
                )
        return found

    def note(self, stage: str, what: str) -> None:
        self.counts[stage] += not what.startswith("nothing")
        print(f"{sum(self.counts.values()):3} {stage}: killed {what}", flush=True)

    def check_photos(self) -> None:
        files = {path.name: path.read_bytes() for path in self.scene.photos.iterdir()}
        check(files == self.photos, "the photos are others than those that were uploaded")

    def check_one_job(self) -> None:
        """A second process of the worker, and a second studio, are refused."""
        check(len(workers(self.scene.folder, "make")) <= 1, "two processes make one scene")

    # The stages

    def upload(self, kills: int) -> None:
        """By two clients at once, which continue where the other one was."""
        done = threading.Event()

        def client() -> None:
            for name, data in self.photos.items():
                start = 0
                while start < len(data):
                    query = f"?path={name}&size={len(data)}&modified=7000&start={start}"
                    try:
                        part = data[start : start + PART]
                        base = urlsplit(self.server.url)
                        connection = http.client.HTTPConnection(base.hostname, base.port, timeout=9)
                        with contextlib.closing(connection):
                            path = f"{base.path}{self.address}/uploads{query}"
                            connection.request("PUT", path, part)
                            answer = json.loads(connection.getresponse().read())
                        start = answer["received"]
                        time.sleep(0.1)
                    except (OSError, http.client.HTTPException, ValueError):
                        time.sleep(0.1)  # the studio is away

        def both() -> None:
            threads = [threading.Thread(target=client) for _ in range(2)]
            for each in threads:
                each.start()
            for each in threads:
                each.join()
            done.set()

        threading.Thread(target=both).start()
        for _ in range(kills):
            self.pause(2.0)
            arrived = {f["path"]: f["received"] for f in self.ask("/uploads")}
            self.server.kill()
            self.note("upload", f"server, {sum(arrived.values())} bytes had arrived")
            for file in self.ask("/uploads"):
                before = arrived.get(file["path"], 0)
                check(file["received"] >= before, f"bytes of {file['path']} are lost")
        check(done.wait(900), "the upload did not end")
        self.check_photos()

    def survey(self, kills: int) -> None:
        def look() -> Any:
            answer = self.ask("/survey", "POST")
            del answer["seconds"], answer["facts"]["camera_poses"]  # the speed of the machine
            return answer

        facts = look()
        check(facts["count"] == len(self.photos), "photos are not seen")
        for _ in range(kills):
            self.kill_during("survey", 25.0, work=look)
            check(look() == facts, "the survey has another answer")
            self.check_photos()

    def make(self, kills: int) -> None:
        """Kills the job, or the server; or the job while the server is away."""
        begun, made = False, 0
        left = kills
        while True:
            status = self.ask()["status"]
            if status == "running" and left:
                self.pause(60.0)
                state = self.ask()["state"]
                stages = [each["stage"] for each in state.get("stages", [])]
                now = (state.get("now") or {}).get("stage", "begin")
                step = (state.get("steps") or {}).get("step", 0)
                victim = self.random.choice(["job", "job", "server", "both"])
                if victim in ("server", "both"):
                    self.server.kill()
                if victim in ("job", "both") and not self.kill_workers("make"):
                    continue  # it has just ended
                self.note("make", f"{victim} at {now}, step {step}")
                left -= 1
                if victim != "server":  # a process that is killed takes a moment to end
                    wait_for(lambda: self.status() != "running", 20)
                after = self.ask()
                # "opening": killed before its first state, so the old one is there without files.
                ended = ("done", "opening")
                expected = (*ended, "running" if victim == "server" else "interrupted")
                check(after["status"] in expected, f"after a kill of {victim}: {after['status']}")
                if after["status"] in ended:
                    continue
                if victim == "server":
                    answer = self.server.ask(f"{self.address}/start", "POST", {"quality": "draft"})
                    check(answer[0] == 400, "a second job was started")
                    command = [sys.executable, "-m", "snowsplat.studio", "make", self.scene.folder]
                    second = subprocess.run(command, capture_output=True, timeout=300)
                    check(second.returncode == 2, "a second worker was not refused")
                else:
                    self.ask("/start", "POST", {"quality": "draft", "minutes": 0.4})
                    begun = True
                    old = after["state"].get("started")
                    wait_for(lambda old=old: self.began() != old or self.status() != "running")
                    self.check_stages(stages)
                self.check_one_job()
                self.check_photos()
            elif status == "running":
                time.sleep(0.5)
            elif status == "done":
                made += 1
                if not left:
                    break
                shutil.rmtree(self.scene.made)  # all of it again
                self.ask("/start", "POST", {"quality": "draft", "minutes": 0.4})
            else:
                check(not begun or status != "failed", f"{status}: {self.ask()['state']}")
                self.ask("/start", "POST", {"quality": "draft", "minutes": 0.4})
                begun = True
        self.check_shown()
        print(f"    made {made} times", flush=True)

    def began(self) -> float | None:
        """When the job began whose state is there."""
        return self.ask()["state"].get("started")

    def status(self) -> str:
        return str(self.ask()["status"])

    def check_stages(self, before: list[str]) -> None:
        """The stages that were finished are not done again."""
        stages = {"photos", "poses", "images"} & set(before)
        if not stages:
            return

        def told() -> bool:
            state = self.ask()["state"]
            again = {each["stage"] for each in state.get("stages", []) if each["again"]}
            done = {each["stage"] for each in state.get("stages", [])}
            check(not (done & stages) - again, f"done twice: {(done & stages) - again}")
            return stages <= again or self.status() != "running"

        wait_for(told)

    def check_shown(self) -> None:
        """The site, the record and the figures are those of the scene file."""
        about = self.ask()
        if about["status"] == "opening":
            self.ask("/open", "POST", {})
            about = self.ask()
        check(about["status"] == "done", f"the scene is {about['status']}")
        file, scene = self.scene.scene_file(), self.scene
        count = len(read_gaussians(file))
        check(
            len(read_sog(SiteFolder(scene.site).scene()).means) == count, "the site is another one"
        )
        check(about["state"]["result"]["gaussians"] == count, "the figures are others")
        record = read_record(file)
        original = read_gaussians(scene.made / about["state"]["result"]["file"])
        removed = record.removed if record else 0
        check(count + removed == len(original), "the record is that of another edit")
        if scene.begun.exists():  # killed before the edit; the next one removes it
            begun = json.loads(scene.begun.read_text())
            check(
                begun["time"] == _written_at(scene.folder / begun["file"]), "half an edit is done"
            )

    def edit(self, kills: int) -> None:
        for number in range(kills):
            before = self.scene.scene_file()
            record = read_record(before)
            removed, scale = (record.removed, record.scale) if record else (0, 1.0)
            count = len(read_sog(SiteFolder(self.scene.site).scene()).means)
            gone = np.packbits(np.arange(count) < 5, bitorder="little").tobytes()
            changes = {"count": count, "removed": base64.b64encode(gone).decode(), "scale": 1.25}
            changes["title"] = title = f"Fox {number}"
            version = self.version()
            self.scene.plan.write_text(json.dumps({"keys": KEYS}))
            places = self.places()
            self.kill_during(
                "edit",
                40.0,
                work=lambda version=version, changes=changes: self.ask(
                    f"/edit?version={version}", "POST", changes
                ),
            )
            # A process of the server that was killed may still store it.
            wait_for(lambda: not workers(self.scene.folder, "edit"))
            self.check_shown()
            now = read_record(self.scene.scene_file())
            after = (now.removed, now.scale, self.ask()["title"] == title) if now else (0, 1, False)
            old, new = (removed, scale, False), (removed + 5, scale * 1.25, True)
            check(after in (old, new), f"{after} is neither {old} nor {new}")
            check(np.allclose(self.places(), places, atol=1e-4), "the film has lost its place")
            print(f"    the edit is {'stored' if after == new else 'not stored'}", flush=True)

    def places(self) -> list[list[float]]:
        """The keys of the film in the world of the scene before all edits."""
        plan = from_json(PageFilm, json.loads(self.scene.plan.read_text()))
        return [*moved_film(plan, page_frames(self.scene.scene_file()), []).keys]

    def version(self) -> str:
        page = self.ask("/site/index.html").decode()
        return re.search(r'data-version="(\d+)"', page)[1]

    def film(self, kills: int) -> None:
        plan = {"keys": KEYS, "seconds": 1.0, "size": "1080x1080"}
        for _ in range(kills):
            before = self.scene.film.read_bytes() if self.scene.film.is_file() else b""
            self.ask(f"/film?version={self.version()}", "POST", plan)
            self.pause(60.0)
            victim = self.random.choice(["film", "server", "both"])
            if victim != "server":
                self.kill_workers("film")
            if victim != "film":
                self.server.kill()
            self.note("film", victim)
            running = self.ask("/film")["running"]
            check(len(workers(self.scene.folder, "film")) <= 1, "two processes render one film")
            if not running and victim != "server":
                now = self.scene.film.read_bytes() if self.scene.film.is_file() else b""
                complete = self.ask("/film")["outcome"] == "done"
                check(complete or now == before, "the film of before is lost")
            wait_for(lambda: not self.ask("/film")["running"])
        self.ask(f"/film?version={self.version()}", "POST", plan)
        wait_for(lambda: not self.ask("/film")["running"])
        check(self.ask("/film")["outcome"] == "done", "the film is not made")
        check(self.ask("/film/file")[4:8] == b"ftyp", "the film is damaged")

    def export(self, kills: int) -> None:
        count = len(read_gaussians(self.scene.scene_file()))
        for number in range(kills):
            kind = ("zip", "ply")[number % 2]
            for file in self.scene.exports.glob("*"):
                file.unlink()
            self.kill_during("export", 30.0, work=lambda k=kind: self.ask(f"/exports/{k}", "POST"))
            self.ask(f"/exports/{kind}", "POST")
            (file,) = self.scene.exports.glob(f"*.{kind}")
            if kind == "ply":
                check(len(read_gaussians(file)) == count, "the file is damaged")
            else:
                with zipfile.ZipFile(file) as archive:
                    check(archive.testzip() is None, "the zip file is damaged")
                    site = names_in(self.scene.site)
                    names = {name for name in archive.namelist() if not name.endswith("/")}
                    check(names == site, "the zip file has other files than the site")
            self.check_shown()

    def browser(self, kills: int) -> None:
        """The browser is killed while it uploads; another one continues."""
        for number in range(kills):
            name = self.server.ask("scenes", "POST", {"title": f"Page {number}"})[1]["name"]
            for is_last in (False, True):
                with self._page(name) as page:
                    self._choose(page)
                    if is_last:
                        scene = Library(self.server.library).find(name)
                        wait_for(lambda s=scene: self._all_there(s), 300)
                    else:
                        self.pause(3.0)
            self.note("browser", f"while it uploaded {len(self.photos)} photos")

    @contextlib.contextmanager
    def _page(self, name: str) -> Iterator[Any]:
        browser = Browser(800, 600, frames=4.0)
        with contextlib.suppress(BrowserError, OSError), browser:
            try:
                yield browser.open(f"{self.server.url}#{name}", timeout=120)
            finally:
                browser.kill()

    def _choose(self, page: Any) -> None:
        page.wait_for("!!document.querySelector('input[type=file]')", 120)
        root = page.call("DOM.getDocument")["root"]["nodeId"]
        field = page.call("DOM.querySelector", nodeId=root, selector="main input[type=file]")
        files = [str(self.files / name) for name in self.photos]
        page.call("DOM.setFileInputFiles", files=files, nodeId=field["nodeId"])

    def _all_there(self, scene: StudioScene) -> bool:
        if not scene.photos.is_dir():
            return False
        return {path.name: path.read_bytes() for path in scene.photos.iterdir()} == self.photos


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--kills", type=int, default=sum(SHARES.values()))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=SHARES, nargs="+", default=list(SHARES))
    words = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="kill-studio-"))
    photos = words.photos or folder / "rendered"
    if words.photos is None:
        write_synthetic_photos(photos, n_views=16, width=320, height=240)
    kills = Kills(photos, folder, words.seed)
    if chromium() is None:
        words.only = [stage for stage in words.only if stage != "browser"]
    try:
        for stage, share in SHARES.items():
            count = max(1, round(words.kills * share / sum(SHARES.values())))
            needed = stage in ("upload", "make")  # by the others
            if stage in words.only or needed:
                getattr(kills, stage)(count if stage in words.only else 0)
    except Lost as error:
        print(f"LOST: {error}; see {folder}", flush=True)
        return 1
    finally:
        kills.kill_workers()
        kills.server.kill()
        print(f"{sum(kills.counts.values())} kills: {dict(kills.counts)}", flush=True)
    shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
