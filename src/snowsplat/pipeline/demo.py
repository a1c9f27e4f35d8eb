"""`demo`: photos of a synthetic scene become a scene again, and its poses are checked."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from snowsplat.data.colmap.model import posed_camera, read_model
from snowsplat.pipeline.make import make
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.run.results import MakeResult
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.synthetic import Truth, write_synthetic_photos
from snowsplat.synthetic.compare_poses import PoseErrors, compare_poses
from snowsplat.util.files import check_output
from snowsplat.util.stages import Outcome

PHOTOS, TRUTH, MADE = "photos", "truth", "made"
# Largest accepted errors of a photo: rotation, and position relative to the extent of the cameras.
MAX_DEGREES, MAX_SHARE = 0.1, 0.002
_OPTIONS = MakeOptions(quality="draft")  # no limit of time: a slow machine makes the same scene


@dataclass(frozen=True)
class DemoResult:
    """A finished demo."""

    photos: Path  # the folder of the photos
    truth: Path  # the folder of the true poses: a COLMAP text model
    made: MakeResult  # the scene
    errors: PoseErrors  # the estimated poses, compared with the true ones

    @property
    def accurate(self) -> bool:
        """Whether every photo has a pose, and the errors of all poses are small."""
        return is_accurate(self.errors)


def demo(output: Path | str, *, observer: Observer = SILENT) -> DemoResult:
    """Ray trace photos of a synthetic scene, run `make` on the photos alone, and check the poses.

    The same call resumes after an interruption.

    ``output``: the output folder. It contains photos/, truth/ (the true poses) and made/ (the
    output folder of `make`).

    Raises:
        UserError: ``output`` is a file or contains other files; see also `make`.
        TrainingStopped, KeyboardInterrupt: Ctrl-C. Finished photos and stages are kept.
    """
    out = Path(output)
    check_output(out, lambda entry: entry.name in (PHOTOS, TRUTH, MADE))
    truth = take_demo_photos(out / PHOTOS, observer)
    truth.write(out / TRUTH)
    made = make(out / PHOTOS, out / MADE, _OPTIONS, observer=observer)
    errors = compare_with_truth(made.dataset, truth.poses)
    return DemoResult(out / PHOTOS, out / TRUTH, made, errors)


def take_demo_photos(folder: Path, observer: Observer) -> Truth:
    """Ray trace the photos of the demo into ``folder``; those that are there are kept."""
    before, started = len(list(folder.glob("*.jpg"))), time.monotonic()
    truth = write_synthetic_photos(folder, report=observer.begin("demo"))
    total = len(truth.poses)
    outcome = Outcome({"photos": total}, time.monotonic() - started, before == total)
    observer.end("demo", outcome)
    return truth


def compare_with_truth(dataset: DatasetFolder, poses: Mapping[str, Tensor]) -> PoseErrors:
    """The errors of the poses of a dataset; ``poses`` are the true ones, as in `Truth`.

    Raises: ValueError: fewer than three photos have poses.
    """
    model = read_model(dataset.model)
    found = {image.name: posed_camera(model, image).cam_from_world for image in model.images}
    return compare_poses(found, poses)


def is_accurate(errors: PoseErrors) -> bool:
    """Whether no photo is missing, and all errors are at most `MAX_DEGREES` and `MAX_SHARE`."""
    degrees, shares = float(errors.rotations.max()), float(errors.centres.max())
    return degrees <= MAX_DEGREES and shares <= MAX_SHARE and not errors.missing
