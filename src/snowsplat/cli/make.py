"""`snowsplat make`: photos or a video become a scene, in one command."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from snowsplat.cli.computing import check_threads, compute_with
from snowsplat.cli.flags import flag, switch
from snowsplat.cli.viewing import PageFlags
from snowsplat.pipeline.make import STAGES, Making, TrainingStopped
from snowsplat.pipeline.presets import Quality, quality_within
from snowsplat.util.errors import UserError
from snowsplat.util.files import remove_temporaries

if TYPE_CHECKING:
    from snowsplat.util.stages import Stages

RECORD = "make.json"


@dataclass
class Make:
    """Make a scene from photos or a video: cameras, training, pictures, in one command.

    Examples:
      snowsplat make photos/                   the scene is photos_scene/photos.ply
      snowsplat make walk.mp4 -o walk          … or walk/walk.ply
      snowsplat make photos/ --quality best    longer, for larger photos and more Gaussians
      snowsplat make photos/ --minutes 5       all in 5 minutes, as well as that allows here

    OUT/capture has the photos and their cameras, and a report; OUT/scene the training, and in
    scene/test/ours_N pictures of the scene beside the photos that were held out. Stopped, it goes
    on with the same command; what is finished is not done again, unless photos or settings changed.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("INPUT [INPUT ...]")] = ()
    """Folders of photos (JPEG, PNG, WebP, TIFF, HEIC), photos, and videos."""
    output: Annotated[Path | None, flag("OUT", "-o", default="INPUT_scene, here")] = None
    """Folder for all that is made."""
    quality: Annotated[
        Literal["draft", "normal", "best"] | None,
        flag("{draft,normal,best}", default="normal, or what the minutes allow"),
    ] = None
    """draft: a quick look; best: several times as long as normal. With --minutes: how hard to look
    for the cameras, the training takes the time that is left."""
    minutes: Annotated[float | None, flag("F", default="none")] = None
    """Be ready after this time. What earlier runs have finished takes none of it; an interrupted
    training goes on with the time that it had left."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Threads to compute with, on the CPU."""
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """What to train on."""
    memory: Annotated[str | None, flag("BYTES", default="what is there")] = None
    """Memory to train in, like 4GB: see train --help."""
    overwrite: Annotated[bool, switch()] = False
    """Replace a scene of other photos that is in OUT."""
    view: Annotated[bool, switch()] = False
    """Watch the training in a browser, and the scene when it is ready, until Ctrl-C."""
    port: Annotated[int | None, flag("N", default="8080, or the next that is free")] = None
    """Where that page is: http://localhost:N."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer alone")] = None
    """Who may look; 0.0.0.0: all in the network who have the address, which is printed."""

    def run(self) -> int:
        """Gives the exit code: 0, or 130 after Ctrl-C."""
        started = time.monotonic()
        name, out = self._where()
        if self.minutes is not None and not 0.0 < 60.0 * self.minutes < float("inf"):
            raise UserError(f"--minutes is {self.minutes:g}; it must be more than 0")
        check_threads(self.threads)
        if self.device is not None:  # before hours of work
            compute_with(self.threads, self.device)
        _check_free(out)
        page = PageFlags(self.port, self.host)
        page.check(self.view)

        from snowsplat.sfm.ingest.sources import find_sources
        from snowsplat.util.stages import Stages

        kinds = [source.kind for source in find_sources(self.inputs).sources]
        existed = out.exists()
        out.mkdir(parents=True, exist_ok=True)
        stages = Stages(out / RECORD, STAGES)
        try:
            quality = self._quality(stages, kinds.count("photo"), kinds.count("video"))
            stages.save()  # from here on the folder is known to be ours
            return Making(
                *(self.inputs, name, out, quality, stages, self._command()),
                minutes=self.minutes,
                threads=self.threads,
                device=self.device,
                memory=self.memory,
                overwrite=self.overwrite,
                started=started,
                page=page if self.view else None,
            ).run()
        except TrainingStopped:
            return 130  # it has said how to go on
        except KeyboardInterrupt:
            print(f"stopped; go on with: {self._command()}")
            return 130
        finally:
            if out.is_dir() and {entry.name for entry in out.iterdir()} <= {RECORD}:
                (out / RECORD).unlink(missing_ok=True)  # nothing has come of it
                if not existed:
                    out.rmdir()

    def _where(self) -> tuple[str, Path]:
        """Name of the scene, and the folder."""
        if not self.inputs:
            raise UserError("make needs photos; name a folder of photos, or a video")
        first = self.inputs[0].absolute()
        name = (first.stem if first.is_file() else first.resolve().name) or "scene"
        return name, self.output or Path(f"{name}_scene")

    def _quality(self, stages: Stages, photos: int, videos: int) -> Quality:
        """As asked for, or what the time allows; decided once, as cameras depend on it."""
        if self.quality is not None or self.minutes is None:
            return self.quality or "normal"
        from snowsplat import ops

        about = {"minutes": self.minutes, "photos": photos, "videos": videos}
        before = stages.about.get("effort", {})
        if {word: before.get(word) for word in about} != about:
            threads = self.threads or ops.get_num_threads()
            quality = quality_within(60.0 * self.minutes, photos, videos, threads)
            stages.about["effort"] = about | {"quality": quality}
        chosen: Quality = stages.about["effort"]["quality"]
        return chosen

    def _command(self) -> str:
        words = ["snowsplat", "make", *map(str, self.inputs)]
        for flag_name in (
            "output",
            "quality",
            "minutes",
            "threads",
            "device",
            "memory",
            "port",
            "host",
        ):
            value = getattr(self, flag_name)
            words += [] if value is None else [f"--{flag_name}", str(value)]
        words += ["--view"] if self.view else []
        return shlex.join(words)


def _check_free(out: Path) -> None:
    """Raises: UserError: ``out`` is a file, or holds something else."""
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: is a file; name a folder for the output")
    if out.is_dir():
        remove_temporaries(out, (RECORD,))
    if out.is_dir() and any(out.iterdir()) and not (out / RECORD).is_file():
        raise UserError(f"{out}: holds other files; name a new or an empty folder")
