"""`publish`: a static web site that shows a scene; `viewed_scene`: the page of `view`."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from snowsplat.evaluation.verdict import Verdict
from snowsplat.formats import format_for_reading
from snowsplat.formats.lod import INDEX, LEVELS, read_index, read_lod
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.scene import PublishOptions
from snowsplat.pipeline.output.scene_files import write_levels
from snowsplat.pipeline.output.scene_source import ViewableScene, load_viewable
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.scene.edit import with_sh_degree
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_output
from snowsplat.viewer.http.static import Served
from snowsplat.viewer.web.panel import Description, made_on
from snowsplat.viewer.web.publication import site_files, write_one_file, write_site
from snowsplat.viewer.web.scene import ready, site

#: Larger scenes are written in levels of detail. Phones show at most that many Gaussians at a time.
_LARGE = 2_000_000
#: Larger scenes are viewed in levels of detail. The viewer never draws more Gaussians at a time.
_LARGE_HERE = 4_000_000


@dataclass(frozen=True)
class PublishResult:
    """A web site."""

    folder: Path
    gaussians: int  # the number of Gaussians of the scene
    bytes: int  # the size of all files


def publish(
    scene: Path | str,
    folder: Path | str,
    options: PublishOptions | None = None,
    *,
    iteration: int | None = None,
    overwrite: bool = False,
    threads: int | None = None,
    observer: Observer = SILENT,
) -> PublishResult:
    """Write a static web site that shows a scene: a page, the viewer, the scene, and a picture.

    A scene of more than 2 million Gaussians is written in levels of detail, except for editing.

    Args:
        scene: the output folder of a training run, or a scene file of any format.
        folder: a new or an empty folder.
        options: what the page says.
        iteration: an iteration of an output folder; default: the last one.
        overwrite: whether to replace a web site in ``folder``.
        threads: number of CPU threads; None: all cores.
        observer: gets the stages "reading" and "writing", the progress of levels of detail, the
            stage "levels", and notes.

    Raises:
        UserError: the scene is missing, damaged or has no Gaussians; ``folder`` contains other
            files, or a web site that is not to be overwritten.
        OSError: a file cannot be written.
    """
    options, folder = options or PublishOptions(), Path(folder)
    site = SiteFolder(folder)
    check_output(folder, lambda entry: bool(site.content()) or site.is_leftover(entry))
    if not overwrite and site.content():
        raise UserError(
            "{folder}: already contains a web site; use `overwrite` to replace it", folder=folder
        )
    Compute("cpu", threads).apply()
    project = Project.open(scene, iteration)
    source = _read(project, observer)
    url = options.url and options.url.rstrip("/") + "/"
    about = Description(options.title or project.name, options.licence, made_on(source.file))
    if any(source.gaussians.origin):
        place = " ".join(f"{value:.15g}" for value in source.gaussians.origin)
        observer.inform(
            "the page does not know the place of the scene, the origin {place}", place=place
        )
    if options.for_editing:
        # A Gaussian of which only these colours are not finite is left out, too.
        usable = source.gaussians.select(source.gaussians.usable_rows())
        source = replace(source, gaussians=with_sh_degree(usable, 0))
    large = len(source.gaussians) > _LARGE and not options.for_editing
    write = partial(_write_levels, observer) if large else write_one_file
    with observer.waiting("writing"):
        scene_of_page = source.ready(walk=options.walk)
        folder.mkdir(parents=True, exist_ok=True)
        write_site(folder, scene_of_page, about, url, write)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return PublishResult(folder, len(source.gaussians), size)


def _write_levels(observer: Observer, folder: Path, gaussians: Gaussians) -> str:
    """Write the levels of detail of a site."""
    write_levels(folder / INDEX, gaussians, observer)
    return INDEX


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
    scene = _read(project, observer)
    verdict = Verdict.from_json(project.verdict)
    about = Description(title, made=made_on(scene.file), grade=verdict.grade if verdict else "")
    if len(scene.gaussians) <= _LARGE_HERE:
        with observer.waiting("preparing"):
            page = site(about, scene.ready())
        yield ViewedScene(scene.file, len(scene.gaussians), *page)
        return
    with TemporaryDirectory(prefix="snowsplat-levels-") as folder:

        def levels(gaussians: Gaussians) -> Path:
            target = Path(folder) / INDEX
            write_levels(target, gaussians, observer)
            observer.inform(
                "to keep them: snowsplat convert {path} FOLDER/{index}", path=path, index=INDEX
            )
            return target

        with observer.waiting("preparing"):
            page = site(about, scene.ready(), levels)
        yield ViewedScene(scene.file, len(scene.gaussians), *page)


def _read(project: Project, observer: Observer) -> ViewableScene:
    with observer.waiting("reading"):
        scene = load_viewable(project)
    _check(scene.file, scene.gaussians)
    return scene


def _check(file: Path, gaussians: Gaussians) -> None:
    if not len(gaussians):
        raise UserError("{file}: contains no Gaussians; there is nothing to see", file=file)
