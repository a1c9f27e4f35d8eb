"""Kills a subcommand repeatedly, and checks that no file is damaged, lost or left behind.

A `Job` is a command and its expected result. `Killer.round` runs it in a new folder and kills it
several times with SIGKILL, with its whole process group. After each kill it checks all files that
have their final names. Then it runs the same command to its end, which must have exit code 0 and
the correct result.
"""

import base64
import fcntl
import hashlib
import json
import os
import pty
import random
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import termios
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
import safetensors
import torch
from PIL import Image

import snowsplat
from snowsplat.data.colmap.model import read_model, read_points
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.formats import format_for_writing, read_gaussians
from snowsplat.formats.origin_file import Place, read_place, write_place
from snowsplat.project.edit_record import PageEdit
from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.studio_scene import StudioScene
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.training.core import checkpoint
from snowsplat.util.ply import open_table
from snowsplat.util.run_lock import LOCK

from ..gaussians import normal_gaussians
from .watched_command import STUDIO

#: For more kills, and at other moments.
TIMES = int(os.environ.get("SNOWSPLAT_KILLS", "1"))
SEED = int(os.environ.get("SNOWSPLAT_SEED", "1"))
_MOST_DEFECTS = 20
_SOURCE = str(Path(snowsplat.__file__).parents[1])


class Defect(AssertionError):
    """A violated guarantee."""


@dataclass
class Ended:
    """How a run ended: by itself or killed; and its output."""

    code: int
    text: str
    changes: int  # of files made by Python, if the run ended by itself
    seconds: float

    @property
    def killed(self) -> bool:
        return self.code == -signal.SIGKILL


class Runner:
    """Runs commands in forks of a process that has loaded all modules, so kills do not hit imports.

    Args:
        folder: the working folder, for logs and temporary files.
        popen: that of fork_server.py.
    """

    def __init__(self, folder: Path, popen: Callable[..., Any]) -> None:
        self.folder, self.temporary = folder, folder / "tmp"
        self.temporary.mkdir(parents=True, exist_ok=True)
        self._popen = popen

    def run(
        self,
        argv: Sequence[object],
        *,
        at: int | None = None,
        delay: float = 0.0,
        after: float | None = None,
        limits: dict[str, int] | None = None,
        columns: int | None = None,
        while_it_runs: Callable[[int], object] = lambda _: None,
    ) -> Ended:
        """Run a command to its end, or until it is killed.

        Args:
            at: kill it before the at-th change of a file, or ``delay`` seconds after that.
            after: kill it this many seconds after its start.
            limits: RLIMIT_… values; the limit of open files is added to the current number.
            columns: width of its terminal; None: no terminal.
            while_it_runs: called with its process id once it is started.
        """
        changes = self.folder / "changes.txt"
        changes.unlink(missing_ok=True)
        run = {
            "argv": [str(word) for word in argv],
            "folder": str(self.folder),
            "changes": str(changes),
            "at": at,
            "delay": delay,
            "limits": limits or {},
        }
        environment = {**os.environ, "PYTHONPATH": _SOURCE, "TMPDIR": str(self.temporary)}
        environment.pop("COLUMNS", None)  # set by pytest-xdist; would replace the terminal's width
        start = time.monotonic()
        with _output(self.folder / "log.txt", columns) as out:
            process = self._popen(
                Path(__file__).with_name("watched_command.py"),
                json.dumps(run),
                env=environment,
                stdout=out,
                stderr=subprocess.STDOUT,
                group=True,
            )
            try:
                while_it_runs(process.pid)
                if after is not None:
                    time.sleep(max(0.0, start + after - time.monotonic()))
                    _kill(process.pid)
            except BaseException:
                _kill(process.pid)
                raise
            finally:
                code = process.wait()
            seconds = time.monotonic() - start
            _wait_for_the_group(process.pid)
        count = int(changes.read_text() or 0) if changes.is_file() else 0
        text = (self.folder / "log.txt").read_bytes().decode(errors="replace")
        return Ended(code, text, count, seconds)


@contextmanager
def _output(log: Path, columns: int | None) -> Iterator[int]:
    """A descriptor for output: that of a file, or of a terminal whose output is copied to it."""
    with log.open("wb") as file:
        if columns is None:
            yield file.fileno()
            return
        ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        copying = threading.Thread(target=_copy, args=(ours, file))
        copying.start()
        try:
            yield theirs
        finally:
            os.close(theirs)
            copying.join()
            os.close(ours)


def _copy(terminal: int, file: BinaryIO) -> None:
    with suppress(OSError):  # the other end is closed
        while text := os.read(terminal, 65536):
            file.write(text)
    file.flush()


def _kill(group: int) -> None:
    with suppress(ProcessLookupError):  # it has already ended
        os.killpg(group, signal.SIGKILL)


def _wait_for_the_group(pid: int) -> None:
    """Wait until the children of a killed process have ended and can no longer write files."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            os.killpg(pid, 0)
        except (ProcessLookupError, PermissionError):
            return
        if all(_is_dead(member) for member in _members(pid)):
            return
        time.sleep(0.002)
    raise Defect("a process of a killed command still runs")


def _members(group: int) -> list[Path]:
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError, ValueError, IndexError):
                if int((folder / "stat").read_text().rpartition(")")[2].split()[2]) == group:
                    found.append(folder)
    return found


def _is_dead(process: Path) -> bool:
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


# Checks of files with final names


def check_whole(folder: Path) -> None:
    """Read all files. Raises Defect if one cannot be read to its end."""
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if any(part.startswith(".") for part in parts) or not path.is_file():
            continue
        if any(part.startswith("database") for part in parts) and path.suffix != ".db":
            continue  # files of COLMAP and SQLite beside the database
        try:
            _open(path)
        except Exception as error:
            raise Defect(f"{path.relative_to(folder)} is incomplete: {error!r}") from error


def _open(path: Path) -> None:
    name = path.name
    if name in ("colmap.log", "cfg_args", "cameras.bin", "images.bin", "frames.bin", "rigs.bin"):
        assert name == "colmap.log" or path.stat().st_size
    elif name == "points3D.bin":  # the last file of a model: the others must exist
        read_model(path.parent)
        read_points(path.parent)
    elif path.suffix == ".db":
        with TemporaryDirectory() as copies:  # opening rolls back an unfinished transaction
            for file in path.parent.glob(f"{name}*"):
                shutil.copy(file, copies)
            with closing(sqlite3.connect(Path(copies) / name)) as connection:
                assert connection.execute("PRAGMA quick_check").fetchall() == [("ok",)]
    elif path.suffix == ".json":
        json.loads(path.read_text(encoding="utf-8"))
    elif path.suffix == ".safetensors":
        checkpoint.load(path)
    elif path.suffix in (".css", ".js", ".txt") or name == "CNAME":
        assert path.stat().st_size
    elif path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            assert archive.testzip() is None
    elif path.suffix in (".html", ".svg"):
        end = f"</{path.suffix[1:]}>"
        assert path.read_text(encoding="utf-8").rstrip().endswith(end)
    elif name in ("input.ply", "points3D.ply"):
        for _ in open_table(path).rows():
            pass
    elif path.suffix in (".png", ".jpg", ".webp"):
        with Image.open(path) as image:
            image.load()
    else:
        read_gaussians(path)


def leftovers(*folders: Path) -> list[str]:
    """Names of temporary files and folders. The lock of a folder stays; it is not held."""
    found = []
    for folder in folders:
        for path in folder.rglob("*"):
            name = path.name
            odd = name.startswith(".") or name.endswith((".tmp", ".pairs", ".models", "-journal"))
            if name == LOCK:
                continue
            if odd or name.endswith(("-wal", "-shm", "_strong.db")):
                found.append(str(path.relative_to(folder)))
    return found


def names_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def digest(path: Path) -> str:
    """A digest of the bytes of a file.

    The header of a checkpoint has no fixed order, so its digest is that of its content.
    """
    if path.suffix != ".safetensors":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    with safetensors.safe_open(path, framework="np") as file:
        whole = hashlib.sha256(json.dumps(sorted(file.metadata().items())).encode())
        for name in sorted(file.keys()):
            whole.update(name.encode() + file.get_tensor(name).tobytes())
    return whole.hexdigest()


# Jobs


def some_gaussians(count: int, seed: int) -> Gaussians:
    found = normal_gaussians(count, 3, seed)
    found.log_scales -= 4.0
    found.quats = found.rotations
    found.sh_rest *= 0.1
    return found


@dataclass
class Job:
    """A command and its expected result.

    Attributes:
        command: its arguments for an output folder; ``again``: whether it resumes after a kill.
        prepare: creates an older output that is to be replaced.
        check_killed: checks the output after a kill, in addition to `check_whole`.
        check_done: compares the output with that of an undisturbed run.
    """

    name: str
    subcommand: str
    output: str
    command: Callable[[Path, bool], list[object]]
    check_done: Callable[[Path, Path], None]
    prepare: Callable[[Path], None] = lambda _: None
    check_killed: Callable[[Path, Path], None] = lambda *_: None


@dataclass
class Killer:
    """Kills jobs at random times that depend on a seed."""

    runner: Runner
    seed: int
    kills: int = 0
    _references: dict[str, tuple[Path, Ended]] = field(default_factory=dict)

    def reference(self, job: Job) -> tuple[Path, Ended]:
        """The output folder and the result of an undisturbed run."""
        if job.name not in self._references:
            folder = self.runner.folder / f"whole {job.name}"
            shutil.rmtree(folder, ignore_errors=True)  # of a try that failed
            folder.mkdir()
            job.prepare(folder / job.output)
            ended = self.runner.run(job.command(folder / job.output, False))
            if ended.code != 0:
                raise Defect(f"{job.name}, undisturbed: exit code {ended.code}\n{ended.text}")
            check_whole(folder)
            self._references[job.name] = folder, ended
        return self._references[job.name]

    def kill(self, jobs: Sequence[Job], kills: int, number: int = 0) -> list[Defect]:
        """Run rounds of the jobs in turn until this number of kills; returns the defects."""
        moments = random.Random(f"{self.seed} {number}")
        found: list[Defect] = []
        before = self.kills
        while self.kills < before + kills:
            try:
                self.round(jobs[number % len(jobs)], moments.randint(1, 5), number)
            except Defect as defect:
                found.append(defect)
                if len(found) >= _MOST_DEFECTS:
                    break
            number += 1
        return found

    def round(self, job: Job, kills: int, number: int) -> None:
        """Kill a job this many times in a row, then let it finish.

        Raises:
            Defect: see `Job`; the folder is kept for inspection.
        """
        moments = random.Random(f"{self.seed} {job.name} {number}")
        whole, undisturbed = self.reference(job)
        folder = self.runner.folder / f"killed {job.name} {number}"
        folder.mkdir()
        output = folder / job.output
        job.prepare(output)
        history = []
        try:
            for i in range(kills):
                moment = _moment(moments, undisturbed)
                ended = self.runner.run(job.command(output, i > 0), **moment)
                history.append(f"{moment} -> {ended.code}")
                if not ended.killed:
                    if ended.code != 0:
                        raise Defect(f"exit code {ended.code} after a kill\n{ended.text}")
                    break
                self.kills += 1
                check_whole(folder)
                job.check_killed(output, whole / job.output)
            ended = self.runner.run(job.command(output, True))
            if ended.code != 0:
                raise Defect(f"exit code {ended.code} of the final run\n{ended.text}")
            check_whole(folder)
            left = leftovers(folder, self.runner.temporary)
            if left:
                raise Defect(f"left behind: {', '.join(left)}")
            job.check_done(output, whole / job.output)
        except Exception as error:
            runs = "; ".join(history)
            raise Defect(f"{job.name}, round {number} ({runs}): {error}") from error
        shutil.rmtree(folder)


def _moment(moments: random.Random, undisturbed: Ended) -> dict[str, float]:
    """Half of the kills are at random times, the others near a change of a file."""
    kind = moments.random()
    if kind < 0.5:
        return {"after": moments.uniform(0.0, undisturbed.seconds)}
    at = moments.randint(1, max(1, undisturbed.changes))
    return {"at": at, "delay": 0.0 if kind < 0.8 else moments.uniform(0.0, 0.005)}


OLD_PLACE = Place((1.0, 2.0, 3.0), 0.5)


def convert_jobs(scene: Path, other: Path) -> list[Job]:
    """Convert into each format, over an existing file, and with edits."""
    targets = ["ply", "compressed.ply", "spz", "sog", "glb", "splat", "html"]

    def job(suffix: str) -> Job:
        def command(output: Path, _: bool) -> list[object]:
            return ["convert", scene, output, "--sh-degree", 1, "--overwrite"]

        def prepare(output: Path) -> None:
            if suffix != "html":  # files are recognised by their first bytes
                shutil.copyfile(other, output)
                write_place(output, OLD_PLACE)

        def check_killed(output: Path, whole: Path) -> None:
            places = {digest(whole): read_place(whole), digest(other): OLD_PLACE}
            if output.exists() and digest(output) not in places:
                raise Defect("neither the old file nor the new one")
            stored = suffix == "html" or format_for_writing(output).stores_origin
            if output.exists() and not stored and read_place(output) != places[digest(output)]:
                raise Defect("the place is that of another scene")

        def check_done(output: Path, whole: Path) -> None:
            if digest(output) != digest(whole):
                raise Defect("not the file of an undisturbed run")

        # The name is the same in all rounds, since it is the title of a page.
        return Job(
            f"convert {suffix}",
            "convert",
            f"scene.{suffix}",
            command,
            check_done,
            prepare,
            check_killed,
        )

    return [job(suffix) for suffix in targets]


def site_digests(folder: Path) -> dict[str, str]:
    """The files of the site in a folder by their names; empty if there is none."""
    content = SiteFolder(folder).content()
    if content is None:
        return {}
    loaded = [path for path in content.parent.rglob("*") if path.is_file()]
    files = [folder / "index.html", *loaded]
    return {str(file.relative_to(folder)): digest(file) for file in files}


def publish_jobs(scene: Path, other: Path) -> list[Job]:
    """Publish into a new folder, over another site, and in levels of detail."""

    def publish(file: Path, output: Path, *more: object) -> list[object]:
        return ["publish", file, "-o", output, "--title", file.stem, *more]

    def older_site(folder: Path) -> None:
        run_command(publish(other, folder))
        (folder / "CNAME").write_text("example.org")  # of its owner

    def older(output: Path) -> None:
        copy_prepared("older site", older_site, output)

    def check_killed(output: Path, whole: Path) -> None:
        old = whole.parents[1] / "older site"
        before = site_digests(old) if (output / "CNAME").exists() else {}
        if site_digests(output) not in (before, site_digests(whole)):
            raise Defect("neither the old site nor the new one")

    def check_done(output: Path, whole: Path) -> None:
        if site_digests(output) != site_digests(whole) or names_in(output) != names_in(whole):
            raise Defect("not the site of an undisturbed run")

    def new(output: Path, again: bool) -> list[object]:
        return publish(scene, output, *(["--overwrite"] * again))

    def over(output: Path, _: bool) -> list[object]:
        return publish(scene, output, "--overwrite")

    def levels(output: Path, _: bool) -> list[object]:
        return ["convert", scene, output / "lod-meta.json", "--overwrite"]

    def older_levels(output: Path) -> None:
        command = ["convert", other]
        copy_prepared(
            "older levels", lambda to: run_command([*command, to / "lod-meta.json"]), output
        )

    def check_levels(output: Path, whole: Path) -> None:
        count = len(read_gaussians(output / "lod-meta.json"))
        if count not in (len(read_gaussians(other)), len(read_gaussians(whole / "lod-meta.json"))):
            raise Defect("neither the old levels nor the new ones")

    def check_new_levels(output: Path, whole: Path) -> None:
        check_levels(whole, output)
        if len(names_in(output)) != len(names_in(whole)):
            raise Defect("files are left")

    site = ("publish", "site")
    return [
        Job("publish", *site, new, check_done, check_killed=check_killed),
        Job("publish --overwrite", *site, over, check_done, older, check_killed),
        Job("publish levels", *site, levels, check_new_levels, older_levels, check_levels),
    ]


def studio_jobs(scene: Path) -> list[Job]:
    """Edit a scene in the studio, and hand it on in each format."""

    def prepare(output: Path) -> None:
        copy_prepared("older studio", make, output)

    def make(output: Path) -> None:
        studio = StudioScene(output)
        output.mkdir()
        studio.write_new_job("Box", [])
        studio.made.mkdir()
        shutil.copy2(scene, studio.made / "box.ply")
        facts = {"file": "box.ply", "aligned": False, "reports": {}, "verdict": None}
        studio.write_state({"outcome": "done", "result": facts})
        run_command([STUDIO, "show", output])
        gone = np.packbits(np.arange(_shown(output)) < _GONE, bitorder="little").tobytes()
        studio.write_page_edit(PageEdit(_shown(output), base64.b64encode(gone).decode(), title="B"))

    def edit(output: Path, again: bool) -> list[object]:
        return [STUDIO, *(["show", output] if again else ["edit", output, '{"version": ""}'])]

    def check_edit(output: Path, whole: Path) -> None:
        new, file = _shown(whole), StudioScene(output).scene_file()
        if {_shown(output), len(read_gaussians(file))} - {new, new + _GONE}:
            raise Defect("neither the old scene nor the new one")

    def check_edited(output: Path, whole: Path) -> None:
        studio = StudioScene(output)
        if _shown(output) != len(read_gaussians(studio.scene_file())) or not studio.is_shown():
            raise Defect("the site shows another scene than the file")
        is_edited = _shown(output) == _shown(whole)
        if (studio.job.title == "B") != is_edited:
            raise Defect("the title is that of another scene")

    def export(kind: str) -> Job:
        def command(output: Path, _: bool) -> list[object]:
            return [STUDIO, "export", output, json.dumps({"kind": kind})]

        def check_killed(output: Path, whole: Path) -> None:
            made = StudioScene(output).exports / f"Box.{kind}"
            expected = StudioScene(whole).exports / made.name
            if kind != "zip" and made.exists() and digest(made) != digest(expected):
                raise Defect("a part of a file")

        def check_done(output: Path, whole: Path) -> None:
            if names_in(output) != names_in(whole):
                raise Defect(f"files differ: {sorted(names_in(output) ^ names_in(whole))}")
            check_killed(output, whole)

        name = f"studio export {kind}"
        return Job(name, "studio", "box", command, check_done, prepare, check_killed)

    exports = [export(kind) for kind in ("ply", "spz", "sog", "glb", "html", "zip")]
    return [Job("studio edit", "studio", "box", edit, check_edited, prepare, check_edit), *exports]


_GONE = 5  # Gaussians that an edit removes


def _shown(studio: Path) -> int:
    """The number of Gaussians of the site of a scene of the studio."""
    return len(read_gaussians(SiteFolder(studio / "site").scene()))


def studio_make_jobs(photos: Path) -> list[Job]:
    """The job of the studio: from photos to a site."""

    def prepare(output: Path) -> None:
        output.mkdir()
        StudioScene(output).write_new_job("Photos", [photos])
        StudioScene(output).change(quality="draft")

    def command(output: Path, _: bool) -> list[object]:
        return [STUDIO, "make", output]

    def check_done(output: Path, _: Path) -> None:
        studio = StudioScene(output)
        if studio.state().get("outcome") != "done":
            raise Defect(f"the state is {studio.state()}")
        if _shown(output) != len(read_gaussians(studio.scene_file())):
            raise Defect("the site shows another scene than the file")

    return [Job("studio-make", "studio-make", "photos", command, check_done, prepare)]


def copy_prepared(name: str, make: Callable[[Path], None], output: Path) -> None:
    """Copy a folder that ``make`` makes once, beside those of all rounds."""
    prepared = output.parents[1] / name
    if not prepared.exists():
        make(prepared)
    shutil.copytree(prepared, output)


def run_command(command: list[object]) -> None:
    """Run a command that is not killed, in a process of its own."""
    module = "snowsplat.studio" if command[0] == STUDIO else "snowsplat"
    words = [str(word) for word in command if word != STUDIO]
    subprocess.run(
        [sys.executable, "-m", module, *words],
        env={**os.environ, "PYTHONPATH": _SOURCE},
        check=True,
        stdout=subprocess.DEVNULL,
    )


_STEPS = 60
_PLAIN = (
    *("--iterations", _STEPS, "--eval", "--checkpoint-every", 10, "--device", "cpu"),
    *("--save-iterations", 20, 40, "--test-iterations", 30, "--threads", 1),
)


def train_jobs(dataset: Path) -> list[Job]:
    """Train with checkpoints and --resume, --memory, --minutes, and over older results."""

    def check_same(output: Path, whole: Path) -> None:
        # The comparison excludes the times in the curves and on the page, and the folder's path.
        expected = names_in(whole)
        if names_in(output) != expected:
            raise Defect(f"files differ: {sorted(names_in(output) ^ expected)}")
        timed = ("history.json", "report.html", "cfg_args")
        for name in sorted(expected - set(timed)):
            if digest(output / name) != digest(whole / name):
                raise Defect(f"{name} is not that of an undisturbed run")
        curves = [json.loads((each / "history.json").read_text()) for each in (output, whole)]
        steps = [[stretch["step"] for stretch in curve["stretches"]] for curve in curves]
        if steps[0] != steps[1] or curves[0]["measured"] != curves[1]["measured"]:
            raise Defect("the curves lack steps")

    def check_complete(output: Path, _: Path) -> None:
        scenes = list((output / "point_cloud").iterdir())
        metrics = json.loads((output / "metrics.json").read_text())
        if f"iteration_{metrics['iteration']}" not in {scene.name for scene in scenes}:
            raise Defect("no scene of the last step")
        if not all((scene / "point_cloud.ply").is_file() for scene in scenes):
            raise Defect("a folder without a scene")
        if not (output / "report.html").is_file():
            raise Defect("no report")

    def plain(*more: object) -> Callable[[Path, bool], list[object]]:
        def command(output: Path, again: bool) -> list[object]:
            return ["train", dataset, "-o", output, *_PLAIN, *more, *(["--resume"] * again)]

        return command

    def timed(output: Path, again: bool) -> list[object]:
        arguments = ["train", dataset, "-o", output, "--minutes", 0.05, "--eval", "--device", "cpu"]
        return [*arguments, "--checkpoint-every", 5, "--threads", 1, *(["--resume"] * again)]

    def replacing(output: Path, _: bool) -> list[object]:
        return ["train", dataset, "-o", output, *_PLAIN, "--overwrite"]

    def older_training(out: Path) -> None:
        arguments = ["train", dataset, "-o", out, "--iterations", 25, "--checkpoint-every", 5]
        run_command([*arguments, "--device", "cpu", "--quiet"])

    def older(output: Path) -> None:
        """The output of a training run with other settings."""
        copy_prepared("older", older_training, output)

    return [
        Job("train", "train", "out", plain(), check_same),
        Job("train --memory", "train", "out", plain("--memory", "200MB"), check_same),
        Job("train --minutes", "train", "out", timed, check_complete),
        Job("train --overwrite", "train", "out", replacing, check_same, older),
    ]


def sfm_jobs(photos: Path) -> list[Job]:
    """Make a dataset from photos, with smaller copies."""

    def command(output: Path, _: bool) -> list[object]:
        return ["sfm", photos, "-o", output, "--quality", "draft", "--threads", 1, "--resize"]

    return [Job("sfm", "sfm", "garden", command, _check_dataset)]


def make_jobs(photos: Path) -> list[Job]:
    """Make a scene from photos, with rendered images."""

    def command(output: Path, _: bool) -> list[object]:
        arguments = ["make", photos, "-o", output, "--quality", "draft", "--threads", 1]
        return [*arguments, "--device", "cpu"]

    def check_done(output: Path, whole: Path) -> None:
        if names_in(output) != names_in(whole):
            raise Defect(f"files differ: {sorted(names_in(output) ^ names_in(whole))}")
        _check_dataset(output / "dataset", whole / "dataset")
        record = json.loads((output / "make.json").read_text())
        if list(record["stages"]) != ["scene", "pictures", "all"]:
            raise Defect("stages are not finished")
        scene = output / f"{photos.name}.ply"
        (last,) = output.glob("scene/point_cloud/*/point_cloud.ply")
        if digest(scene) != digest(last):
            raise Defect("the scene is not that of the training")

    return [Job("make", "make", "made", command, check_done)]


def _check_dataset(output: Path, whole: Path) -> None:
    """Check that the files are the same, and the cameras are the same except for rounding."""
    if names_in(output) != names_in(whole):
        raise Defect(f"files differ: {sorted(names_in(output) ^ names_in(whole))}")
    record = json.loads((output / "sfm.json").read_text())
    if list(record["stages"]) != ["photos", "poses", "images", "report"]:
        raise Defect("stages are not finished")
    centres = []
    for folder in (output, whole):
        model = read_model(folder / "sparse" / "0")
        centres.append({image.name: _centre(image) for image in model.images})
    if centres[0].keys() != centres[1].keys():
        raise Defect("other photos are registered")
    mine, theirs = (np.array([c[name] for name in sorted(c)]) for c in centres)
    size = np.ptp(theirs, axis=0).max()
    apart = np.abs(mine - theirs).max() / size
    if apart > 1e-3:
        attempts = record["stages"]["poses"]["result"]["attempts"]
        raise Defect(f"cameras are {apart:.2g} of the scene apart: {attempts}")


def _centre(image: ColmapImage) -> np.ndarray:
    rotation = rotation_from_quat(torch.tensor(image.pose[:4], dtype=torch.float64)).numpy()
    return -rotation.T @ np.array(image.pose[4:])
