"""`SiteFolder`: the files of a web site that `publish` writes.

    SITE/index.html    the page, which names the folder of all that it loads
    SITE/files-HASH/   scene.sog, or lod-meta.json with levels; poster.jpg, stops.webp; the viewer

The name of the folder depends on its content. So whoever has loaded a page gets the files of this
page, also from a cache, and a site is replaced by one file: `SiteFolder.replace`.
"""

import hashlib
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from snowsplat.project.inside import Inside
from snowsplat.util.errors import UserError
from snowsplat.util.files import STAGE, is_temporary, new_folder, sync_entries, write_text

PAGE, SCENE, POSTER = "index.html", "scene.sog", "poster.jpg"
_NAME = "files-[0-9a-f]{12}"
_FILES = re.compile(_NAME)
_CONTENT = re.compile(rf'"contentUrl": "\./({_NAME})/(scene\.sog|lod-meta\.json)"')


@dataclass(frozen=True)
class SiteFolder:
    """The folder of a site, existing or not."""

    path: Path

    page = Inside(PAGE)

    def content(self) -> Path | None:
        """What the page shows, a SOG scene or the index of levels of detail; None: there is no
        site here."""
        try:
            named = _CONTENT.search(self.page.read_text("utf-8"))
        except (OSError, ValueError):
            return None
        content = self.path / named[1] / named[2] if named else None
        return content if content is not None and content.is_file() else None

    def scene(self) -> Path | None:
        """The SOG scene; None: there is none, or it is in levels of detail."""
        content = self.content()
        return content if content is not None and content.name == SCENE else None

    def poster(self) -> Path | None:
        """The picture of the initial view; None: there is no site here."""
        content = self.content()
        return content and content.with_name(POSTER)

    def is_leftover(self, entry: Path) -> bool:
        """Whether a process that was killed before it wrote the page has left this."""
        is_ours = entry.name == STAGE or _FILES.fullmatch(entry.name)
        return bool(is_ours) or is_temporary(entry, (PAGE,))

    def replace(self, write: Callable[[Path], None], page: Callable[[str], str]) -> None:
        """Write the site: old or new at any time, also if the process is killed.

        Args:
            write: writes what the page loads into a folder.
            page: the page, which loads it from the folder of this name beside it.

        Raises:
            UserError: another process writes this site.
            OSError: a file cannot be written.
        """
        with new_folder(self.path / STAGE) as stage:
            if stage.name != STAGE:
                raise UserError("{folder}: another process writes it; try again", folder=self.path)
            made = stage / "files"
            made.mkdir()
            write(made)
            sync_entries(made)
            digest = _digest(made)
            name = f"files-{digest}"
            new = self.path / name
            if not new.is_dir() or _digest(new) != digest:
                shutil.rmtree(new, ignore_errors=True)
                os.replace(made, new)
            write_text(self.page, page(name))
        for folder in self.path.iterdir():
            if folder.name != name and _FILES.fullmatch(folder.name):
                shutil.rmtree(folder, ignore_errors=True)


def _digest(folder: Path) -> str:
    """A hash of the names and the content of all files in a folder."""
    whole = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = file.relative_to(folder).as_posix().encode()
        content = hashlib.sha256(file.read_bytes()).digest()
        whole.update(len(name).to_bytes(4, "little") + name + content)
    return whole.hexdigest()[:12]
