"""Estimates camera poses from photos, in several attempts with increasing effort.

`PoseEstimation._make_attempts` has the attempts in their order, and when each of them is made:
first others with the same features and matches, then with more pairs, then with more features, at
about 4 times the work of the first attempt.

Before the first attempt, the matches tell whether a camera has a fisheye lens (`fisheye`); so does
the picture, if it is a disc. After the first attempts, bundle adjustment shows whether one focal
length fits all photos of a camera. If not, the attempt is made with several, which remain for the
others (`camera_groups`).

The attempts end when one of them finds poses for 90% of the usable photos (`Evidence.usable`), or
when the matches show that no further attempt can succeed. If these poses do not agree with the
matches, some further attempts are made, too. The result is the model with the highest `score`: that
which makes the verified matches of all photos, and its lenses, most probable.
"""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.attempt import AnyMapper, Attempt, AttemptRunner, Matched
from snowsplat.sfm.colmap.checks.consistency import CONSISTENT
from snowsplat.sfm.colmap.checks.diagnosis import Evidence, explain, failure
from snowsplat.sfm.colmap.checks.score import PairMatches, Score, read_matches, score_of
from snowsplat.sfm.colmap.database import (
    forget_verification,
    remove_database,
    replace_database,
    set_cameras,
    verified_pairs,
)
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses import camera_groups
from snowsplat.sfm.colmap.lenses.fisheye import LensEvidence, lens_evidence
from snowsplat.sfm.colmap.lenses.lens import (
    Lens,
    camera_ids,
    circle_focals,
    exif_focals,
    focals_by_camera,
)
from snowsplat.sfm.colmap.mapping.mapping import write_models
from snowsplat.sfm.colmap.options import Effort, SfmResult
from snowsplat.sfm.colmap.pairs.choice import PairChoice
from snowsplat.sfm.colmap.result import names_in, result_of
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.options import Mapper, SfmOptions
from snowsplat.util.messages import Message, message

_ENOUGH = 0.9  # fraction of the usable photos that have to be registered
# The expected time from the start of the job to the end of the next attempt, divided by the time
# from the start of the job until now.
_NEXT_ATTEMPT = 3.0
# Each attempt with several focal lengths has better estimates of them than the one before.
_ZOOM_ATTEMPTS = 3


class PoseEstimation:
    """The attempts for one set of photos. `run` makes them and writes the best result."""

    matched: Matched  # of the last attempt
    evidence: Evidence  # of the matches of the first attempts
    mapper: Mapper  # of the first attempt
    lens: Lens  # with which the next attempt begins

    def __init__(
        self,
        dataset: DatasetFolder,
        photos: list[Photo],
        options: SfmOptions,
        threads: int,
        progress: WorkerProgress,
    ) -> None:
        self.dataset = dataset
        self.strong_database = dataset.distorted / "database_strong.db"  # with more features
        self.options = options
        self.runner = AttemptRunner(dataset, photos, options.camera_model, threads, progress)
        self.lens_evidence: dict[int, LensEvidence] = {}  # by camera id
        self.started = time.monotonic()
        self.attempts: list[Attempt] = []
        # The matches of all photos, and the scores of attempts with these; None: they have changed.
        self.pairs: list[PairMatches] | None = None
        self.scores: list[tuple[Attempt, Score]] = []
        self.log: list[str] = []  # a description of each attempt, as text for users

    @property
    def photos(self) -> list[Photo]:
        return self.runner.photos

    def run(self, effort: Effort) -> SfmResult:
        """Make the attempts, the first with ``effort``; write ``sparse/`` and the database.

        Raises: UserError: no camera poses were found.
        """
        shutil.rmtree(self.dataset.distorted_models, ignore_errors=True)
        given = self.photos
        self._make_attempts(effort)
        best = self._best()
        if not best.models:
            doubts = next((a.doubts for a in self.attempts if a.doubts), [])
            error = failure(self.runner.evidence(self.matched), doubts)
            remove_database(self.strong_database)
            raise error
        self.runner.progress.show_poses(best.models[0], True)
        choice, image_size = self._describe_choice(best), best.matched.effort.image_size
        exif = exif_focals(self.photos) if best.lens.exif else {}
        before = [camera.params[0] for camera in best.models[0].cameras.values()]
        models = [best.mapping.complete(model, image_size, exif) for model in best.models]
        same = before == [camera.params[0] for camera in models[0].cameras.values()]
        for model in models:
            model.extract_colors_for_all_images(self.dataset.photos, self.runner.threads)
        write_models(models, self.dataset.distorted_models)
        names = [names_in(model) for model in models]
        evidence = self.runner.evidence(best.matched)
        unregistered = explain(self.photos, evidence, names, best.excluded)
        if best.matched.database == self.strong_database:
            replace_database(self.dataset.database, by=self.strong_database)
        remove_database(self.strong_database)
        doubts = list(best.doubts)
        if best.agreement < CONSISTENT:
            doubts.append(
                message(
                    "the poses may be bent: where they fit least, {share:.0%} of the matches "
                    "between neighbouring photos agree with them",
                    share=best.agreement,
                )
            )
        return result_of(
            models,
            self.photos,
            exif=best.lens.exif,
            held=best.mapping.held and same,
            unregistered=unregistered,
            pairs=best.matched.choice.description,
            attempts=self.log + choice,
            doubts=doubts + self._doubt_about_fisheye(best),
            zooms="" if self.photos is given else camera_groups.describe(models[0]),
            agreement=best.agreement,
            fisheye=self._describe_fisheye(best),
        )

    def _make_attempts(self, effort: Effort) -> None:
        """Make as many attempts as needed, the first with ``effort``. Each of the others is a
        remedy for one cause of a failure, if the attempts before show this cause."""
        self._match_first(effort)
        self._try("as configured")
        if not self._good and self.matched.choice.reserve:
            # Pairs of similar photos were held in reserve, because places may only look alike.
            self._verify(self.matched.choice.whole())
            self._try("with more pairs")
        if not self._found and self.evidence.flat and exif_focals(self.photos):
            # With a wrong focal length, the matches may show only a rotation.
            self.lens = replace(self.lens, exif=False)
            forget_verification(self.matched.database)
            self._verify(self.matched.choice)
            self._try("as configured")
        if self.lens.fisheyes and not self._good:
            # The matches, or a disc, may suggest a fisheye lens where there is none.
            self._try("as configured", lens=replace(self.lens, fisheyes=frozenset(), focals={}))
            self.lens = self._best().lens
        if not self._found and self.evidence.more_effort_is_useless:
            return
        if not self._good or self._contradicts_exif():
            # The photos may not determine the focal length.
            self._try("as configured", "incremental", self.lens.fixed)
        other: Mapper = "incremental" if self.mapper == "global" else "global"
        if not (self._good or self.evidence.flat):
            self._try("as configured", other)
        if not self._enough:
            self._try("as configured", "plain")
        self._try_zooms()
        if not (self._enough or (self._found and self.evidence.matched_all)):
            self._match_again(self.dataset.database, effort, effort.stronger())
            self._try("with more pairs and weaker matches", "incremental", weak=True)
        how, stronger = "with more features, from larger photos", effort.stronger()
        if not self._enough:
            self._match_again(self.strong_database, stronger, stronger)
            self._try(how, weak=True)
            if not self._enough:
                self._try(how, "incremental", self.lens.fixed)
            if not self._enough and not self.evidence.flat:
                self._try(how, other, weak=True)

    def _try(
        self,
        how: str,
        mapper: AnyMapper | None = None,
        lens: Lens | None = None,
        weak: bool = False,
    ) -> None:
        """Make an attempt with the last matches; the default is the mapper and the lens of the
        first attempt. ``weak``: accept weaker matches."""
        attempt = self.runner.run(how, self.matched, mapper or self.mapper, lens or self.lens, weak)
        self.attempts.append(attempt)
        self.log.append(attempt.description)

    def _match_first(self, effort: Effort) -> None:
        """The matches and the lens of the first attempt."""
        database = self.dataset.database
        self.matched = self.runner.match(database, effort, effort, reserve=False)
        self.lens_evidence = lens_evidence(database, self.photos, self.matched.scale)
        self.lens = self._first_lens()
        self.runner.verify(self.matched, self.lens)
        choice = self.matched.choice
        self._verify(choice.complete(verified_pairs(database), len(self.photos)))
        # The global mapper returns a wrong depth for flat scenes.
        self.mapper = "incremental" if self.evidence.flat else self.options.mapper

    def _verify(self, choice: PairChoice) -> None:
        """Match and verify those of these pairs that are not verified yet."""
        self.matched = replace(self.matched, choice=choice)
        self.runner.verify(self.matched, self.lens)
        self.pairs = None
        self.evidence = self.runner.evidence(self.matched)

    def _match_again(self, database: Path, effort: Effort, pairing: Effort) -> None:
        self.matched = self.runner.match(database, effort, pairing)
        self.runner.verify(self.matched, self.lens)
        self.pairs = None

    def _try_zooms(self) -> None:
        """The photos of a camera may have several focal lengths, which remain for the others.

        Fisheye lenses with a zoom are rare, so they are not tried."""
        lens = self.lens
        one, best = self.photos, self._best()
        if lens.any_fisheye or not camera_groups.may_differ(one):
            return
        if not self._good:  # bundle adjustment of a bent model does not find a zoom
            pinhole = Lens("SIMPLE_PINHOLE", exif=lens.exif)
            set_cameras(self.matched.database, camera_groups.separate(one), pinhole)
            models = self.runner.mapping(self.matched, pinhole).run("incremental")
            focals = camera_groups.focals_of(models[0]) if models else {}
        else:
            focals = camera_groups.own_focals(best.models[0], self.runner.threads)
        for _ in range(_ZOOM_ATTEMPTS):
            before, several = self.photos, camera_groups.group_by_zoom(one, focals)
            if several is None or camera_ids(several) == camera_ids(before):
                break
            self.runner.photos = several
            begin = replace(lens, focals=focals_by_camera(several, focals))
            self._try("with several focal lengths", lens=begin)
            made, best = self.attempts.pop(), self._best()
            made_better = bool(made.models) and camera_groups.better(
                made.models[0], best.models, several=before is not one
            )
            if not made_better:
                self.runner.photos = before
                break
            self.attempts, lens = [made], begin  # the other models are bent
            model = made.models[0]
            focals = camera_groups.focals_of(model) | camera_groups.own_focals(
                model, self.runner.threads
            )
        set_cameras(self.matched.database, self.photos, lens)
        self.lens = lens

    def _first_lens(self) -> Lens:
        """The lens of the first attempt, with the focal lengths that discs and matches propose."""
        lens, circles = Lens(self.options.camera_model), circle_focals(self.photos)
        proposed = {number: found.focal for number, found in self.lens_evidence.items()}
        sure = {n: focal for n, focal in proposed.items() if self.lens_evidence[n].fisheye}
        if lens.model == "auto":
            focals = circles | sure
            return replace(lens, fisheyes=frozenset(focals), focals=focals)
        if not lens.any_fisheye:
            return lens
        return replace(lens, focals=proposed | circles | sure)

    def _describe_fisheye(self, best: Attempt) -> str:
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

    def _doubt_about_fisheye(self, best: Attempt) -> list[Message]:
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
            message(
                "the photos seem to be from a fisheye lens, but their poses were estimated with an "
                "ordinary one; state the camera model OPENCV_FISHEYE"
            )
        ]

    def _best(self) -> Attempt:
        """The attempt whose model is most probable; without a model, the first one."""
        made = [attempt for attempt in self.attempts if attempt.models]
        if len(made) < 2:
            return (made or self.attempts)[0]
        return max(made, key=lambda attempt: self._score(attempt).total)

    def _score(self, attempt: Attempt) -> Score:
        if self.pairs is None:
            self.pairs, self.scores = read_matches(self.matched.database), []
        known = next((score for other, score in self.scores if other is attempt), None)
        if known is None:
            exif = exif_focals(self.photos)
            model = attempt.mapping.with_likely_lenses(attempt.models[0], exif)
            known = score_of(model, self.pairs, exif)
            self.scores.append((attempt, known))
        return known

    def _describe_choice(self, best: Attempt) -> list[str]:
        """Which attempt was chosen, and how certain this is; empty if there was no choice."""
        others = [a for a in self.attempts if a.models and a is not best]
        if not others:
            return []
        score = self._score(best)
        second = max((self._score(attempt) for attempt in others), key=lambda s: s.total)
        number = self.log.index(best.description) + 1
        return [
            f"attempt {number} is used: its poses explain {score.explained:.0%} of the matches of "
            f"all photos, those of the next best one {second.explained:.0%} (logarithm of the "
            f"odds: {score.total - second.total:.0f})"
        ]

    @property
    def _found(self) -> bool:
        """Whether an attempt has found poses."""
        return any(attempt.models for attempt in self.attempts)

    @property
    def _good(self) -> bool:
        """Whether enough photos are registered, in a model that agrees with its matches."""
        consistent = self._best().agreement >= CONSISTENT
        return self._enough and (consistent or self._late)

    @property
    def _enough(self) -> bool:
        """Whether no further attempt is made: enough photos are registered, or no time is left."""
        registered = max(attempt.registered for attempt in self.attempts)
        least = 1.0 if self._late else _ENOUGH * self.evidence.usable
        return registered > 0 and registered >= least

    @property
    def _late(self) -> bool:
        if self.options.seconds is None:
            return False
        return _NEXT_ATTEMPT * (time.monotonic() - self.started) > self.options.seconds

    def _contradicts_exif(self) -> bool:
        """Whether the best lens is in doubt, and EXIF knows another focal length, which is tried.

        If the photos do not determine the focal length, the model that was made with a wrong one is
        bent, so `settled`, which starts from this model, may not find that EXIF is right.
        """
        doubtful = self.lens.exif and bool(self._best().doubts) and not self._late
        return doubtful and bool(exif_focals(self.photos))
