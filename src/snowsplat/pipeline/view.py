"""`view`: the files of a page that shows a scene, in levels of detail if it is large; or a site."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from snowsplat.formats import format_for_reading
from snowsplat.formats.lod import INDEX, LEVELS, read_index, read_lod
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.scene_files import write_levels
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.viewer.http.static import Served
from snowsplat.viewer.web.panel import Description, made_on
from snowsplat.viewer.web.publication import site_files
from snowsplat.viewer.web.scene import ready, site

#: Larger scenes are shown in levels of detail. The viewer never draws more Gaussians at a time.
_LARGE = 4_000_000


@dataclass(frozen=True)
class ViewedScene:
    """The page of a scene."""

    file: Path  # the scene file, or the page of a published site
    gaussians: int | None  # their number; None for a published site, which is served as it is
    files: dict[str, Served]  # the files of the page, by name
    headers: dict[str, str]  # HTTP headers of the page


@contextmanager
def viewed_scene(
    path: Path | str, iteration: int | None = None, observer: Observer = SILENT
) -> Iterator[ViewedScene]:
    """A context with the page of a scene; see `load_viewable`. ``path`` may be a published site.

    Of levels of detail, only the coarsest is read, so their page is ready at once. For other
    scenes of more than 4 million Gaussians, levels of detail are written to a temporary folder,
    which is removed at the end.
    Raises: UserError: the scene is missing or damaged, or has no Gaussians.
    """
    path = Path(path)
    if SiteFolder(path).content() is not None:
        if iteration is not None:
            raise UserError("`iteration` selects a scene of an output folder; leave it out")
        yield ViewedScene(SiteFolder(path).page, None, *site_files(path))
        return
    project = Project.open(path, iteration)
    title, index = project.name, project.scene
    if index is not None and project.is_file and format_for_reading(index).name == LEVELS:
        counts = read_index(index).counts()
        coarse = read_lod(index, len(counts) - 1).to_gaussians()
        _check(index, coarse)
        about = Description(title, made=made_on(index))
        page = site(about, ready(coarse, [], turn=False), lambda _: index, counts[0])
        yield ViewedScene(index, counts[0], *page)
        return
    with observer.waiting("reading"):
        scene = load_viewable(project)
    _check(scene.file, scene.gaussians)
    about = Description(title, made=made_on(scene.file))
    if len(scene.gaussians) <= _LARGE:
        with observer.waiting("preparing"):
            page = site(about, scene.ready())
        yield ViewedScene(scene.file, len(scene.gaussians), *page)
        return
    with TemporaryDirectory(prefix="snowsplat-levels-") as folder:

        def levels(gaussians: Gaussians) -> Path:
            target = Path(folder) / INDEX
            write_levels(target, gaussians, observer)
            observer.note(
                message(
                    "to keep them: snowsplat convert {path} FOLDER/{index}", path=path, index=INDEX
                )
            )
            return target

        with observer.waiting("preparing"):
            page = site(about, scene.ready(), levels)
        yield ViewedScene(scene.file, len(scene.gaussians), *page)


def _check(file: Path, gaussians: Gaussians) -> None:
    if not len(gaussians):
        raise UserError("{file}: contains no Gaussians; there is nothing to see", file=file)
