"""A record of the finished stages of a job, so that the same command resumes an interrupted job.

A stage is finished if the record contains it with the same settings and its output files exist. The
key of a stage also depends on all earlier stages. So if the input or the settings of a stage
change, this stage and all later ones are repeated.
"""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from snowsplat._version import __version__
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import from_json, read_json


@dataclass(frozen=True)
class Outcome:
    """The result of a stage."""

    result: dict[str, Any]  # JSON values
    seconds: float  # duration of the stage in the run that executed it
    again: bool  # an earlier run finished this stage; it was not executed again


@dataclass(frozen=True)
class _Record:
    """The record of a finished stage."""

    key: str  # a hash of the settings, and of the keys of all earlier stages
    settings: dict[str, Any]
    outputs: dict[str, int]  # number of files of each output
    seconds: float
    result: dict[str, Any]
    digest: str = ""  # hash of the result, to detect damage; empty in older files


class Stages:
    """The record of a job.

    Args:
        file: the JSON file of the record; it need not exist.
        names: the stages of the job in order.

    Raises: UserError: the file is damaged.
    """

    def __init__(self, file: Path, names: Sequence[str]) -> None:
        self.file, self.names = file, list(names)
        self.about: dict[str, Any] = {}  # facts about the job, stored in the same file
        self._records: dict[str, dict[str, Any]] = {}
        self._parent = ""
        if file.is_file():
            try:
                content = read_json(file)
                records = dict(content.pop("stages"))
                self._records = {
                    name: asdict(from_json(_Record, record)) for name, record in records.items()
                }
                content.pop("snowsplat")
                self.about = content
            except (ValueError, KeyError, TypeError, AttributeError):
                raise UserError(
                    "{file}: damaged; delete it to start from the beginning", file=file
                ) from None

    def run(
        self,
        name: str,
        settings: dict[str, Any],
        outputs: Sequence[Path],
        work: Callable[[], dict[str, Any]],
        on_change: Callable[[str], None] | None = None,
    ) -> Outcome:
        """Execute a stage unless it is finished. The stages of a job must run in order.

        Args:
            name: one of the names of the job.
            settings: JSON values on which the result depends, besides the earlier stages.
            outputs: files and folders that ``work`` writes.
            work: executes the stage and returns its result, JSON values.
            on_change: called with the reason if a finished stage must be repeated.
        """
        settings = json.loads(json.dumps(settings))
        key = hashlib.sha256(json.dumps([self._parent, name, settings]).encode()).hexdigest()
        self._parent = key
        record = self._records.get(name)
        if record is not None:
            reason = self._reason(record, key, settings, outputs)
            if not reason:
                return Outcome(record["result"], record["seconds"], True)
            if on_change is not None:
                on_change(reason)
        for later in self.names[self.names.index(name) :]:
            self._records.pop(later, None)
        if record is not None:
            self.save()
        start = time.monotonic()
        # Convert the result to what a later run will read: numbers that are not finite become null.
        result = json.loads(json.dumps(work()), parse_constant=lambda _: None)
        seconds = round(time.monotonic() - start, 2)
        self._records[name] = {
            "key": key,
            "settings": settings,
            "outputs": {_shown(path, self.file.parent): _count(path) for path in outputs},
            "seconds": seconds,
            "result": result,
            "digest": _digest(result),
        }
        self.save()
        return Outcome(result, seconds, False)

    def is_finished(self, name: str) -> bool:
        """Whether an earlier run finished this stage, with any settings."""
        return name in self._records

    def settings(self, name: str) -> dict[str, Any]:
        """The settings with which an earlier run finished this stage; empty if none did."""
        return self._records[name]["settings"] if name in self._records else {}

    def save(self) -> None:
        """Write the record. `run` calls this after each stage."""
        write_json(self.file, {"snowsplat": __version__} | self.about | {"stages": self._records})

    def _reason(
        self, record: dict[str, Any], key: str, settings: dict[str, Any], outputs: Sequence[Path]
    ) -> str:
        """Why the stage must be repeated; empty if it need not be."""
        if record["digest"] not in ("", _digest(record["result"])):
            return "its record is damaged"
        before = record["settings"]
        changed = [word for word in settings if settings[word] != before.get(word)]
        if changed or settings.keys() != before.keys():
            return "changed: " + ", ".join(word.replace("_", " ") for word in changed)
        if record["key"] != key:
            return "an earlier stage has changed"
        if record["outputs"] != {_shown(p, self.file.parent): _count(p) for p in outputs}:
            return "its files are missing"
        return ""


def _digest(result: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(result, sort_keys=True).encode()).hexdigest()


def _shown(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _count(path: Path) -> int:
    """Number of files in a folder; 1 for a file; 0 if ``path`` does not exist."""
    if path.is_dir():
        return sum(1 for entry in path.rglob("*") if not entry.is_dir())
    return int(path.is_file())
