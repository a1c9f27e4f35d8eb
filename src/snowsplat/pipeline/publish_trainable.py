"""`publish_trainable`: a page that trains a dataset in a browser, with WebGPU."""

from dataclasses import dataclass
from pathlib import Path

from snowsplat.data import load_dataset
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_target, make_parent
from snowsplat.viewer.tab.trainable import LONGER_SIDE, write_trainable

#: Steps of the training in the page.
STEPS = 3000


@dataclass(frozen=True)
class TrainableResult:
    """A page that trains."""

    page: Path
    photos: int
    gaussians: int  # the number of the first ones
    bytes: int  # the size of the page


def publish_trainable(
    dataset: Path | str,
    page: Path | str,
    title: str | None = None,
    *,
    steps: int = STEPS,
    overwrite: bool = False,
    threads: int | None = None,
    observer: Observer = SILENT,
) -> TrainableResult:
    """Write one HTML file with the photos, cameras and points of a dataset, which trains a scene.

    A browser with WebGPU computes; the page makes no network requests. The longer side of the
    photos becomes at most 512 pixels. Every 8th photo is held out, as in `load_dataset`.

    Args:
        dataset: a dataset of posed images; see `load_dataset`.
        page: the HTML file.
        title: None: the name of the dataset.
        steps: of the training.
        overwrite: replace ``page``.
        threads: number of CPU threads; None: all cores.
        observer: gets the stage "writing", and notes.

    Raises:
        UserError: see `load_dataset`; or ``page`` is not an HTML file, or exists.
        OSError: the file cannot be written.
    """
    dataset, page = Path(dataset), Path(page)
    if page.suffix.lower() not in (".html", ".htm"):
        raise UserError("{page}: a page that trains is one file; use a name with .html", page=page)
    check_target(page, overwrite)
    Compute("cpu", threads).apply()
    read = load_dataset(dataset)
    cameras = [view.camera for view in [*read.train, *read.test]]
    longest = max(max(camera.width, camera.height) for camera in cameras)
    if longest > LONGER_SIDE:
        width = max(camera.width for camera in cameras)
        read = load_dataset(dataset, resolution=width * LONGER_SIDE // longest)
    make_parent(page)
    with observer.waiting("writing") as report:
        made = write_trainable(page, read, title or dataset.resolve().name, steps, report)
    if made.masked:
        observer.inform(
            "the page ignores the masks of {masked} of {photos} photos",
            masked=made.masked,
            photos=made.photos,
        )
    return TrainableResult(page, made.photos, made.gaussians, made.bytes)
