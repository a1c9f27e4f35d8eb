"""One attempt to estimate poses: matches, a mapper, and the checks of what it has made."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.checks.consistency import agreement_of, check_pairs
from snowsplat.sfm.colmap.checks.diagnosis import Evidence, gather_evidence
from snowsplat.sfm.colmap.checks.repair import repair
from snowsplat.sfm.colmap.database import (
    fingerprint_of,
    open_database,
    read_descriptors,
    set_cameras,
)
from snowsplat.sfm.colmap.features.extraction import WorkerProgress, extract_features
from snowsplat.sfm.colmap.lenses.lens import Lens, settle_lens, with_all_parameters
from snowsplat.sfm.colmap.mapping.mapping import Mapping, usable_models
from snowsplat.sfm.colmap.options import Effort, detection_size
from snowsplat.sfm.colmap.pairs.choice import FEATURES, PairChoice, choose_pairs, similarity
from snowsplat.sfm.colmap.pairs.pair_matching import match_pairs, verify_pairs
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.options import Mapper
from snowsplat.util.messages import Message

# Largest distance of a verified match from its epipolar line, in pixels of the resized photo in
# which the features were detected.
_MAX_ERROR = 4.0


@dataclass(frozen=True)
class Matched:
    """A database with features and matches, and how they were made."""

    database: Path
    effort: Effort  # with which the features were detected
    choice: PairChoice
    scale: float  # size of a photo / size at which its features were detected (1 or more)

    @property
    def max_error(self) -> float:
        """The largest distance of a verified match from its epipolar line, in pixels of a photo."""
        return _MAX_ERROR * self.scale


@dataclass(frozen=True)
class Attempt:
    """The result of an attempt."""

    matched: Matched
    photos: list[Photo]  # in the groups of the attempt
    lens: Lens  # with which the attempt began
    mapping: Mapping  # for further work on the models
    models: list[pycolmap.Reconstruction]
    agreement: float  # of the first model with its matches; see `agreement_of`
    excluded: dict[str, Message]  # name -> reason, for photos that had a pose in a wrong place
    doubts: list[Message]  # about the lenses
    description: str  # as text for users

    @property
    def registered(self) -> int:
        return self.models[0].num_reg_images() if self.models else 0


@dataclass
class AttemptRunner:
    """Matches photos and makes attempts with the matches."""

    dataset: DatasetFolder
    photos: list[Photo]  # their groups may be changed between two attempts
    camera_model: str
    threads: int
    progress: WorkerProgress

    def match(self, database: Path, effort: Effort, *, reserve: bool = True) -> Matched:
        """Detect features, and match pairs of photos.
        ``reserve``: whether the pairs of the reserve are matched, too."""
        fingerprint = fingerprint_of(self.dataset.photos, self.photos, effort)
        open_database(database, self.photos, Lens(self.camera_model), fingerprint)
        extract_features(self.dataset, database, self.photos, effort, self.threads, self.progress)
        indices = range(len(self.photos))
        choice = choose_pairs(
            self.photos,
            effort,
            lambda: similarity([read_descriptors(database, i, FEATURES) for i in indices]),
        )
        scales = [
            max(photo.width, photo.height) / detection_size(effort.image_size, photo.panorama)
            for photo in self.photos
        ]
        scale = max(1.0, float(np.median(scales)))
        matched = Matched(database, effort, choice.whole() if reserve else choice, scale)
        self._for_pairs(match_pairs, matched)
        return matched

    def verify(self, matched: Matched, lens: Lens) -> None:
        """Match and verify those pairs of ``matched`` that are not verified yet. The cameras of
        ``lens`` replace those in the database."""
        set_cameras(matched.database, self.photos, lens)
        self._for_pairs(match_pairs, matched)
        self._for_pairs(verify_pairs, matched)

    def _for_pairs(self, work: Callable[..., None], matched: Matched) -> None:
        pairs = matched.choice.pairs
        work(matched.database, pairs, matched.max_error, self.threads, self.progress)

    def evidence(self, matched: Matched) -> Evidence:
        """What the matches tell about the photos."""
        return gather_evidence(matched.database, self.photos, len(matched.choice.pairs))

    def mapping(self, matched: Matched, lens: Lens) -> Mapping:
        """The mapper for these matches."""
        return Mapping(
            matched.database,
            self.dataset.photos,
            matched.scale,
            self.threads,
            self.progress.report,
            held=lens.held,
            forward=lens.held,
            show_poses=self.progress.show_poses,
        )

    def run(self, how: str, matched: Matched, mapper: Mapper, lens: Lens) -> Attempt:
        """Make an attempt. ``how`` describes it, as text for users."""
        set_cameras(matched.database, self.photos, lens)
        mapping = self.mapping(matched, lens)
        models = mapping.run(mapper)
        weak = ""
        if models and models[0].num_reg_images() < len(self.photos):
            before = models[0].num_reg_images()
            models = mapping.extend(models)
            added = models[0].num_reg_images() - before
            weak = f", {added} of them with weak matches" if added else ""
        check, excluded, doubts, agreement = "", dict[str, Message](), list[Message](), 0.0
        if models:
            others, repaired = models[1:], repair(models[0], mapping, matched.max_error)
            excluded = repaired.excluded
            check = f"; {repaired.description}" if repaired.description else ""
            models = usable_models([repaired.model])
        if models:
            found = settle_lens(repaired.model, self.photos, lens, mapping.with_cameras)
            mapping, doubts = dataclasses.replace(mapping, held=found.held), found.notes
            if found.model:
                refine = mapping.with_cameras
                model = with_all_parameters(found.model, self.photos, lens, refine, found.held)
                models = usable_models([model, *others])
            else:
                models = []
                check = f"; impossible: {', '.join(map(str, doubts))}"
        if models:
            agreement = agreement_of(check_pairs(models[0], matched.database, matched.max_error))
        effort, lens_text = matched.effort, f" ({lens.description})" if lens.description else ""
        registered = models[0].num_reg_images() if models else 0
        description = (
            f"{how}{lens_text}: {effort.features} features per photo at {effort.image_size} "
            f"pixels, {matched.choice.description}, {mapper} mapping: "
            f"{registered} of {len(self.photos)} photos registered{weak}{check}"
        )
        return Attempt(
            matched, self.photos, lens, mapping, models, agreement, excluded, doubts, description
        )
