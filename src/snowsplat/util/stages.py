"""Which stages of a job are finished, so that the same command goes on where it was stopped.

A stage is finished when it is written down here, with the same settings, and its files are there.
What is written down depends on all that came before: a stage whose input or settings have changed
is done again, and with it all later ones.
"""

from __future__ import annotations

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
    """What came of a stage: its ``result``, and whether it was there already."""

    result: dict[str, Any]
    seconds: float  # what the stage took when it was done
    again: bool  # finished in an earlier run, and left as it is


@dataclass(frozen=True)
class _Record:
    """What is written down of a finished stage."""

    key: str  # a hash of the settings, and of all that came before
    settings: dict[str, Any]
    outputs: dict[str, int]  # how many files each has
    seconds: float
    result: dict[str, Any]
    digest: str = ""  # of the result: what was damaged may still be JSON. None in older files


class Stages:
    """The record of a job in a file ``file``; ``names`` are its stages in order.

    Raises:
        UserError: the file is not a record of such a job.
    """

    def __init__(self, file: Path, names: Sequence[str]) -> None:
        self.file, self.names = file, list(names)
        self.about: dict[str, Any] = {}  # facts about the whole job, kept in the same file
        self._records: dict[str, dict[str, Any]] = {}
        self._parent = ""
        if file.is_file():
            try:
                whole = read_json(file)
                records = dict(whole.pop("stages"))
                self._records = {
                    name: asdict(from_json(_Record, record)) for name, record in records.items()
                }
                whole.pop("snowsplat")
                self.about = whole
            except (ValueError, KeyError, TypeError, AttributeError):
                raise UserError(f"{file}: damaged; delete it to begin anew") from None

    def run(
        self,
        name: str,
        settings: dict[str, Any],
        outputs: Sequence[Path],
        work: Callable[[], dict[str, Any]],
        on_change: Callable[[str], None] | None = None,
    ) -> Outcome:
        """Do a stage, unless it is finished. The stages of a job must run in their order.

        Args:
            settings: JSON values on which the result depends, beside that of earlier stages.
            outputs: files and folders that ``work`` makes.
            work: gives the result, JSON values.
            on_change: told, in words, why a stage that was finished is done again.
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
        # As it will be read again: with null for what is not finite.
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
        """Whether an earlier run has finished this stage, with whatever settings."""
        return name in self._records

    def save(self) -> None:
        """Write the record; `run` does so after each stage."""
        write_json(self.file, {"snowsplat": __version__} | self.about | {"stages": self._records})

    def _reason(
        self, record: dict[str, Any], key: str, settings: dict[str, Any], outputs: Sequence[Path]
    ) -> str:
        """Why the stage must be done again; empty if it need not."""
        if record["digest"] not in ("", _digest(record["result"])):
            return "what was written down of it is damaged"
        before = record["settings"]
        changed = [word for word in settings if settings[word] != before.get(word)]
        if changed or settings.keys() != before.keys():
            return "changed: " + ", ".join(word.replace("_", " ") for word in changed)
        if record["key"] != key:
            return "what it is made from has changed"
        if record["outputs"] != {_shown(p, self.file.parent): _count(p) for p in outputs}:
            return "files of it are missing"
        return ""


def _digest(result: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(result, sort_keys=True).encode()).hexdigest()


def _shown(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _count(path: Path) -> int:
    """How many files: of a folder those in it, of a file 1, and 0 of what is not there."""
    if path.is_dir():
        return sum(1 for entry in path.rglob("*") if not entry.is_dir())
    return int(path.is_file())
