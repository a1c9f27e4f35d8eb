"""`Inside`: the place of a file in a folder, as an attribute of the class of the folder."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, overload


class _Folder(Protocol):
    @property
    def path(self) -> Path: ...


class Inside:
    """The file or folder ``name`` in the ``path`` of an object; of the class, this declaration."""

    def __init__(self, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, folder: None, kind: type) -> Inside: ...

    @overload
    def __get__(self, folder: _Folder, kind: type) -> Path: ...

    def __get__(self, folder: _Folder | None, kind: type) -> Inside | Path:
        return self if folder is None else folder.path / self.name
