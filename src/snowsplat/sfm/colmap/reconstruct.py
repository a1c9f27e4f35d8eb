"""Estimates camera poses from photos, in several attempts with increasing effort.

With the same features and matches:
    1  as configured
    2  the other mapper
    3  the focal length is held, and the camera may move forward (`Lens.fixed`)
    4  registered in COLMAP's own order
With further matches:
    5  more pairs; weaker matches are accepted
    6  twice as many features, from larger photos; about 4 times the work of the first attempt
    7  these, with a held focal length
    8  these, with the other mapper

If pairs of similar photos were held in reserve (`pairs`), and the first attempt is not good, it is
repeated with them.

After the first four, bundle adjustment shows whether one focal length fits all photos of a camera.
If not, the attempt is made with several, which remain for the others (`camera_groups`).

Before the first attempt, the matches tell whether a camera has a fisheye lens (`fisheye`); so does
the picture, if it is a disc. If this attempt is not good, it is also made with an ordinary lens,
and the better model decides.

The matches may show only a rotation because the focal length in EXIF is wrong. In this case, they
are verified again without it.

The attempts end when one of them finds poses for 90% of the usable photos (`Evidence.usable`), or
when the matches show that no further attempt can succeed. If these poses do not agree with the
matches, the second and third attempts are made, too; the third one also if their lens contradicts
EXIF. The result is the possible model (see `lens`) with the most registered photos, weighted by its
agreement with the matches.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from snowsplat.sfm.colmap.checks.consistency import CONSISTENT, agreement_of_model
from snowsplat.sfm.colmap.checks.diagnosis import Evidence, explain, failure, gather_evidence
from snowsplat.sfm.colmap.checks.repair import repair
from snowsplat.sfm.colmap.database import (
    fingerprint_of,
    forget_verification,
    open_database,
    read_descriptors,
    remove_database,
    replace_database,
    set_cameras,
    verified_pairs,
)
from snowsplat.sfm.colmap.features.extraction import Folders, WorkerProgress, extract_features
from snowsplat.sfm.colmap.lenses import camera_groups
from snowsplat.sfm.colmap.lenses.fisheye import LensEvidence, lens_evidence
from snowsplat.sfm.colmap.lenses.lens import (
    EQUAL_ERROR,
    Lens,
    Refine,
    camera_ids,
    circle_focals,
    exif_focals,
    focals_by_camera,
    misfit,
    settled,
    with_all_parameters,
)
from snowsplat.sfm.colmap.mapping.mapping import Mapping, usable_models, write_models
from snowsplat.sfm.colmap.options import Effort, Mapper, SfmOptions, SfmResult, detection_size
from snowsplat.sfm.colmap.pairs.choice import PairChoice, choose_pairs
from snowsplat.sfm.colmap.pairs.pair_matching import match_pairs, verify_pairs
from snowsplat.sfm.colmap.pairs.retrieval import FEATURES, similarity
from snowsplat.sfm.colmap.result import names_in, result_of
from snowsplat.sfm.ingest.photo import Photo

_ENOUGH = 0.9  # fraction of the usable photos that have to be registered
# The expected time from the start of the job to the end of the next attempt, divided by the time
# from the start of the job until now.
_NEXT_ATTEMPT = 3.0
# Largest distance of a verified match from its epipolar line, in pixels of the resized photo in
# which the features were detected.
_MAX_ERROR = 4.0
# A model of the wrong kind of lens has larger errors than one of the right kind, by this factor.
_OTHER_LENS = 1.25
# Each attempt with several focal lengths has better estimates of them than the one before.
_ZOOM_ATTEMPTS = 3

_MAPPING = {
    "incremental": "incremental mapping",
    "plain": "incremental mapping in COLMAP's order",
    "global": "global mapping",
}


@dataclass(frozen=True)
class Matched:
    """A database with features and matches, and how they were made."""

    database: Path
    effort: Effort  # with which the features were detected
    choice: PairChoice
    scale: float  # size of a photo / size at which its features were detected (1 or more)


@dataclass(frozen=True)
class Attempt:
    """The result of an attempt."""

    matched: Matched
    lens: Lens  # with which the attempt began
    mapping: Mapping  # for further work on the models
    models: list[pycolmap.Reconstruction]
    agreement: float  # of the first model with its matches; see `agreement_of`
    left_out: dict[str, str]  # name -> reason, for photos that had a pose in a wrong place
    doubts: list[str]  # about the lenses, as text for users

    @property
    def registered(self) -> int:
        return self.models[0].num_reg_images() if self.models else 0

    @property
    def error(self) -> float:
        """The mean reprojection error of the first model, in pixels of the photos."""
        return self.models[0].compute_mean_reprojection_error() if self.models else float("inf")

    @property
    def misfit(self) -> float:
        """`lens.misfit` of the first model."""
        return misfit(self.models[0]) if self.models else float("inf")


class PoseEstimation:
    """The attempts for one set of photos. `run` makes them and writes the best result."""

    def __init__(
        self,
        folders: Folders,
        photos: list[Photo],
        options: SfmOptions,
        threads: int,
        progress: WorkerProgress,
    ) -> None:
        self.folders = folders
        self.photos = photos  # `_try_zooms` may change their groups
        self.options = options
        self.threads = threads
        self.progress = progress
        self.lens_evidence: dict[int, LensEvidence] = {}  # by camera id
        self.started = time.monotonic()
        self.attempts: list[Attempt] = []
        self.log: list[str] = []  # a description of each attempt, as text for users

    def run(self, effort: Effort) -> SfmResult:
        """Make the attempts, the first with ``effort``; write ``sparse/`` and the database.

        Raises: UserError: no camera poses were found.
        """
        shutil.rmtree(self.folders.sparse, ignore_errors=True)
        second = self.folders.distorted / "database_strong.db"
        given = self.photos
        evidence = self._make_attempts(effort, second)
        best = self._best()
        if not best.models:
            remove_database(second)
            raise failure(evidence, next((a.doubts for a in self.attempts if a.doubts), []))
        self.progress.placed(best.models[0], True)
        for model in best.models:
            best.mapping.align_features(model, best.matched.effort.image_size)
            best.mapping.add_points(model)
            model.extract_colors_for_all_images(self.folders.images, self.threads)
        write_models(best.models, self.folders.sparse)
        names = [names_in(model) for model in best.models]
        reasons = explain(self.photos, self._evidence(best.matched), names, best.left_out)
        result = result_of(
            best.models,
            self.photos,
            reasons,
            best.matched.choice.description,
            self.log,
            exif=best.lens.exif,
            held=best.mapping.held,
        )
        if best.matched.database == second:
            replace_database(self.folders.database, by=second)
        remove_database(second)
        zooms = "" if self.photos is given else camera_groups.describe(best.models[0])
        doubts = list(best.doubts)
        if best.agreement < CONSISTENT:
            doubts.append(
                f"the poses may be bent: where they fit least, {best.agreement:.0%} of the matches "
                "between neighbouring photos agree with them"
            )
        doubts += self._other_lens(best)
        return dataclasses.replace(
            result,
            doubts=doubts,
            zooms=zooms,
            agreement=best.agreement,
            fisheye=self._found_fisheye(best),
        )

    def _make_attempts(self, effort: Effort, second: Path) -> Evidence:
        """Make as many attempts as needed; returns the evidence of the last matching. ``second`` is
        the path of the database for the attempts that have more features."""
        first, mapper = self.folders.database, self.options.mapper
        matched = self._match(first, effort, effort, reserve=False)
        self.lens_evidence = lens_evidence(first, self.photos, matched.scale)
        lens = self._first_lens()
        self._verify(matched, lens)
        completed = matched.choice.completed(verified_pairs(first), len(self.photos))
        matched = self._with_pairs(matched, completed, lens)
        evidence = self._evidence(matched)
        if evidence.flat:
            mapper = "incremental"  # the global mapper returns a wrong depth for flat scenes
        self._try("as configured", matched, mapper, lens)
        if not self._good(evidence) and matched.choice.reserve:
            matched = self._with_pairs(matched, matched.choice.whole(), lens)
            evidence = self._evidence(matched)
            self._try("with more pairs", matched, mapper, lens)
        if not self._found and evidence.flat and exif_focals(self.photos):
            lens = dataclasses.replace(lens, exif=False)
            forget_verification(first)
            self._verify(matched, lens)
            evidence = self._evidence(matched)
            self._try("as configured", matched, mapper, lens)
        if lens.fisheyes and not self._good(evidence):
            ordinary = dataclasses.replace(lens, fisheyes=frozenset(), focals={})
            self._try("as configured", matched, mapper, ordinary)
            lens = self._best().lens
        if not self._found and evidence.more_effort_is_useless:
            return evidence
        other: Mapper = "incremental" if mapper == "global" else "global"
        if not (self._good(evidence) or evidence.flat):
            self._try("as configured", matched, other, lens)
        if not self._good(evidence) or self._contradicts_exif(lens):
            self._try("as configured", matched, "incremental", lens.fixed)
        if not self._enough(evidence):
            self._try("as configured", matched, "plain", lens)
        if not lens.any_fisheye:  # fisheye lenses with a zoom are rare
            lens = self._try_zooms(matched, mapper, lens, evidence)
        if self._enough(evidence):
            return evidence
        if not (self._found and evidence.matched_all):
            matched = self._match(first, effort, effort.stronger())
            self._verify(matched, lens)
            self._try("with more pairs and weaker matches", matched, "incremental", lens, True)
        if self._enough(evidence):
            return self._evidence(matched)
        strong = effort.stronger()
        matched = self._match(second, strong, strong)
        self._verify(matched, lens)
        how = "with more features, from larger photos"
        self._try(how, matched, mapper, lens, True)
        if not self._enough(evidence):
            self._try(how, matched, "incremental", lens.fixed)
        if not self._enough(evidence) and not evidence.flat:
            self._try(how, matched, other, lens, True)
        return self._evidence(matched)

    def _best(self) -> Attempt:
        """The attempt with the most registered photos, weighted by the share of correct matches.

        A model that is bent, because photos were registered with too few points, may have all
        photos. So may a model of the wrong kind of lens, but it has larger errors. A lens in doubt,
        for example because of EXIF, is right only if no other lens agrees equally well with the
        matches.
        """
        least = min(attempt.error for attempt in self.attempts)
        lenses = {attempt.lens.any_fisheye for attempt in self.attempts}
        undoubted = min((a.misfit for a in self.attempts if not a.doubts), default=float("inf"))

        def score(attempt: Attempt) -> float:
            wrong_kind = len(lenses) > 1 and attempt.error > _OTHER_LENS * least
            doubtful = attempt.doubts and undoubted <= (1 + EQUAL_ERROR) * attempt.misfit
            weight = 0.5 if wrong_kind or doubtful else 1.0
            return attempt.registered * attempt.agreement * weight

        return max(self.attempts, key=score)

    def _first_lens(self) -> Lens:
        """The lens of the first attempt, with the focal lengths that discs and matches propose."""
        lens, circles = Lens(self.options.camera_model), circle_focals(self.photos)
        proposed = {number: found.focal for number, found in self.lens_evidence.items()}
        sure = {n: focal for n, focal in proposed.items() if self.lens_evidence[n].fisheye}
        if lens.model == "auto":
            focals = circles | sure
            return dataclasses.replace(lens, fisheyes=frozenset(focals), focals=focals)
        if not lens.any_fisheye:
            return lens
        return dataclasses.replace(lens, focals=proposed | circles | sure)

    def _found_fisheye(self, best: Attempt) -> str:
        """`SfmResult.fisheye` of the attempt ``best``."""
        if not best.lens.fisheyes:
            return ""
        count = sum(number in best.lens.fisheyes for number in camera_ids(self.photos))
        which = "the photos are" if count == len(self.photos) else f"{count} photos are"
        found = [self.lens_evidence.get(number) for number in best.lens.fisheyes]
        gains = [evidence.gain for evidence in found if evidence is not None and evidence.fisheye]
        if len(gains) < len(found):
            return f"{which} from a fisheye lens: the picture is a disc"
        return (
            f"{which} from a fisheye lens: {min(gains) - 1:.0%} more matches agree with one than "
            "with any ordinary lens"
        )

    def _other_lens(self, best: Attempt) -> list[str]:
        """A doubt, if the photos seem to be from a fisheye lens, but the model has an ordinary one.

        The model FOV describes fisheye lenses, too. An endoscope shows a disc without one: if poses
        of an ordinary lens agree with the matches, there is no doubt.
        """
        if best.lens.any_fisheye or best.lens.model == "FOV":
            return []
        disc = best.agreement < CONSISTENT and any(photo.circle for photo in self.photos)
        if not disc and not any(evidence.fisheye for evidence in self.lens_evidence.values()):
            return []
        return [
            "the photos seem to be from a fisheye lens, but their poses were estimated with an "
            "ordinary one; state the camera model OPENCV_FISHEYE"
        ]

    @property
    def _found(self) -> bool:
        """Whether an attempt has found poses."""
        return any(attempt.models for attempt in self.attempts)

    def _match(
        self, database: Path, effort: Effort, pairing: Effort, *, reserve: bool = True
    ) -> Matched:
        """Detect the features of ``effort``, and match the pairs of the effort ``pairing``.
        ``reserve``: whether the pairs of the reserve are matched, too."""
        fingerprint = fingerprint_of(self.folders.images, self.photos, effort)
        open_database(database, self.photos, Lens(self.options.camera_model), fingerprint)
        extract_features(self.folders, database, self.photos, effort, self.threads, self.progress)
        indices = range(len(self.photos))
        choice = choose_pairs(
            self.photos,
            pairing,
            lambda: similarity([read_descriptors(database, i, FEATURES) for i in indices]),
        )
        choice = choice.whole() if reserve else choice
        scales = [
            max(photo.width, photo.height) / detection_size(effort.image_size, photo.panorama)
            for photo in self.photos
        ]
        scale = max(1.0, float(np.median(scales)))
        match_pairs(database, choice.pairs, _MAX_ERROR * scale, self.threads, self.progress)
        return Matched(database, effort, choice, scale)

    def _with_pairs(self, matched: Matched, choice: PairChoice, lens: Lens) -> Matched:
        """Match and verify those pairs of ``choice`` that are not matched yet."""
        if choice.pairs == matched.choice.pairs:
            return matched
        error = _MAX_ERROR * matched.scale
        match_pairs(matched.database, choice.pairs, error, self.threads, self.progress)
        more = dataclasses.replace(matched, choice=choice)
        self._verify(more, lens)
        return more

    def _verify(self, matched: Matched, lens: Lens) -> None:
        """Verify those matches of ``matched`` that are not verified yet. The cameras of ``lens``
        replace those in the database."""
        set_cameras(matched.database, self.photos, lens)
        error, pairs = _MAX_ERROR * matched.scale, matched.choice.pairs
        verify_pairs(matched.database, pairs, error, self.threads, self.progress)

    def _try(
        self,
        how: str,
        matched: Matched,
        mapper: Mapper | Literal["plain"],
        lens: Lens,
        relaxed: bool = False,
    ) -> None:
        """Make an attempt. ``how`` describes it, as text for users; ``relaxed`` as in `Mapping`."""
        set_cameras(matched.database, self.photos, lens)
        mapping = self._mapping(matched, lens)
        models = mapping.run(mapper, relaxed)
        weak = ""
        if models and models[0].num_reg_images() < len(self.photos):
            before = models[0].num_reg_images()
            models = mapping.extend(models)
            added = models[0].num_reg_images() - before
            weak = f", {added} of them with weak matches" if added else ""
        check, left_out, doubts = "", dict[str, str](), list[str]()
        if models:
            repaired = repair(models[0], mapping, _MAX_ERROR * matched.scale)
            left_out = repaired.left_out
            check = f"; {repaired.description}" if repaired.description else ""
            refine = self._refine(mapping)
            found = settled(repaired.model, self.photos, lens, refine)
            mapping, doubts = dataclasses.replace(mapping, held=found.held), found.notes
            if found.model:
                model = with_all_parameters(found.model, self.photos, lens, refine, found.held)
                models = usable_models([model, *models[1:]])
            else:
                models = []
                check = f"; impossible: {', '.join(doubts)}"
        agreement = 0.0
        if models:
            error = _MAX_ERROR * matched.scale
            pairs = repaired.pairs if models[0] is repaired.model else None
            agreement = agreement_of_model(models[0], matched.database, error, pairs)
        attempt = Attempt(matched, lens, mapping, models, agreement, left_out, doubts)
        self.attempts.append(attempt)
        effort, lens_text = matched.effort, f" ({lens.description})" if lens.description else ""
        self.log.append(
            f"{how}{lens_text}: {effort.features} features per photo at {effort.image_size} "
            f"pixels, {matched.choice.description}, {_MAPPING[mapper]}: "
            f"{attempt.registered} of {len(self.photos)} photos registered{weak}{check}"
        )

    def _try_zooms(self, matched: Matched, mapper: Mapper, lens: Lens, evidence: Evidence) -> Lens:
        """Make attempts with several focal lengths per camera, if one does not fit all photos.
        Returns the lens of further attempts."""
        one, best = self.photos, self._best()
        if not camera_groups.may_differ(one):
            return lens
        if not self._enough(evidence):
            pinhole = Lens("SIMPLE_PINHOLE", exif=lens.exif)
            set_cameras(matched.database, camera_groups.separate(one), pinhole)
            models = self._mapping(matched, pinhole).run("incremental")
            focals = camera_groups.focals_of(models[0]) if models else {}
        else:
            focals = camera_groups.own_focals(best.models[0], self.threads)
        for _ in range(_ZOOM_ATTEMPTS):
            before, several = self.photos, camera_groups.grouped(one, focals)
            if several is None or camera_ids(several) == camera_ids(before):
                break
            self.photos = several
            begin = dataclasses.replace(lens, focals=focals_by_camera(several, focals))
            self._try("with several focal lengths", matched, mapper, begin)
            made, best = self.attempts.pop(), self._best()
            made_better = bool(made.models) and camera_groups.better(
                made.models[0], best.models, several=before is not one
            )
            if not made_better:
                self.photos = before
                break
            self.attempts, lens = [made], begin  # the other models are bent
            model = made.models[0]
            focals = camera_groups.focals_of(model) | camera_groups.own_focals(model, self.threads)
        set_cameras(matched.database, self.photos, lens)
        return lens

    def _mapping(self, matched: Matched, lens: Lens) -> Mapping:
        return Mapping(
            matched.database,
            self.folders.images,
            matched.scale,
            self.threads,
            self.progress.report,
            held=lens.held,
            forward=lens.held,
            placed=self.progress.placed,
        )

    @staticmethod
    def _refine(mapping: Mapping) -> Refine:
        return lambda model, cameras, held: dataclasses.replace(mapping, held=held).with_cameras(
            model, cameras
        )

    def _contradicts_exif(self, lens: Lens) -> bool:
        """Whether the best lens is in doubt, and EXIF knows another focal length, which is tried.

        If the photos do not determine the focal length, the model that was made with a wrong one is
        bent, so `settled`, which starts from this model, may not find that EXIF is right.
        """
        doubtful = lens.exif and bool(self._best().doubts) and not self._late()
        return doubtful and bool(exif_focals(self.photos))

    def _good(self, evidence: Evidence) -> bool:
        """Whether enough photos are registered, in a model that agrees with its matches."""
        consistent = self._best().agreement >= CONSISTENT
        return self._enough(evidence) and (consistent or self._late())

    def _enough(self, evidence: Evidence) -> bool:
        """Whether no further attempt is made: enough photos are registered, or no time is left."""
        registered = max(attempt.registered for attempt in self.attempts)
        least = 1.0 if self._late() else _ENOUGH * evidence.usable
        return registered > 0 and registered >= least

    def _late(self) -> bool:
        if self.options.seconds is None:
            return False
        return _NEXT_ATTEMPT * (time.monotonic() - self.started) > self.options.seconds

    def _evidence(self, matched: Matched) -> Evidence:
        return gather_evidence(matched.database, self.photos, len(matched.choice.pairs))
