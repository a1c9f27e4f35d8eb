"""`publish`: a static web site that shows a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from snowsplat.formats.lod import INDEX
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.publish import PublishOptions
from snowsplat.pipeline.output.scene_files import write_levels
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.scene.edit import with_sh_degree
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_output
from snowsplat.util.messages import message
from snowsplat.viewer.web.panel import Description, made_on
from snowsplat.viewer.web.publication import write_one_file, write_site

#: Larger scenes are written in levels of detail. Phones show at most that many Gaussians at a time.
_LARGE = 2_000_000


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
    with observer.waiting("reading"):
        project = Project.open(scene, iteration)
        source = load_viewable(project)
    if not len(source.gaussians):
        raise UserError("{file}: contains no Gaussians; there is nothing to see", file=source.file)

    url = options.url and options.url.rstrip("/") + "/"
    about = Description(options.title or project.name, options.licence, made_on(source.file))
    if any(source.gaussians.origin):
        place = " ".join(f"{value:.15g}" for value in source.gaussians.origin)
        observer.note(
            message(
                "the page does not know the place of the scene, the origin {place}", place=place
            )
        )
    folder.mkdir(parents=True, exist_ok=True)
    if options.for_editing:
        # A Gaussian of which only these colours are not finite is left out, too.
        usable = source.gaussians.select(source.gaussians.usable_rows())
        source = replace(source, gaussians=with_sh_degree(usable, 0))
    large = len(source.gaussians) > _LARGE and not options.for_editing
    write = partial(_write_levels, observer) if large else write_one_file
    with observer.waiting("writing"):
        write_site(folder, source.ready(), about, url, write)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return PublishResult(folder, len(source.gaussians), size)


def _write_levels(observer: Observer, folder: Path, gaussians: Gaussians) -> str:
    """Write the levels of detail of a site."""
    write_levels(folder / INDEX, gaussians, observer)
    return INDEX
