"""Estimates camera poses from photos: a list of candidates, of which the most probable one is used.

`CANDIDATES` has the ways to make a model, in the order of their cost. The first one is always
made. Each of the others is a remedy for one cause of a failure, and is made if the attempts before
show this cause: if too few photos have poses (`Evidence.usable`), or if the poses do not agree with
their matches where they agree least (`agreement_of`). Then another model may have a higher `score`.
The result is the model with the highest one: that which makes the verified matches of all photos,
and its lenses, most probable.

Together, these take about as long as the first attempt, most of which are features and matches. If
photos are still missing, more features are detected and matched, which takes about three
times as long, and the candidates that are `again` are made with these. No choice depends on the
time that something took, except with `SfmOptions.seconds`, and no candidate changes the matches of
the first attempt. So an interrupted run ends with the same model.

Before the first attempt, the matches tell whether a camera has a fisheye lens (`fisheye`); so does
the picture, if it is a disc.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.attempt import Attempt, AttemptRunner, Matched
from snowsplat.sfm.colmap.checks.consistency import CONSISTENT
from snowsplat.sfm.colmap.checks.diagnosis import Evidence, explain, failure
from snowsplat.sfm.colmap.checks.matches import PairMatches, read_matches
from snowsplat.sfm.colmap.checks.score import Score, score_of
from snowsplat.sfm.colmap.database import (
    copy_without_verification,
    remove_database,
    replace_database,
    set_cameras,
    verified_pairs,
)
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses import camera_groups
from snowsplat.sfm.colmap.lenses.fisheye import (
    LensEvidence,
    describe_fisheye,
    doubts_about_fisheye,
    lens_evidence,
)
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
from snowsplat.util.messages import message

_ENOUGH = 0.9  # fraction of the usable photos that have to be registered
# The expected time from the start of the job to the end of the next attempt, divided by the time
# from the start of the job until now.
_NEXT_ATTEMPT = 3.0
# Each attempt with several focal lengths has better estimates of them than the one before.
_ZOOM_ATTEMPTS = 3


@dataclass(frozen=True)
class Candidate:
    """A way to make a model. The text for users is that of `Attempt.description`.

    Attributes:
        sensible: whether its model may be better than those that were made before.
        make: makes one or more attempts.
        again: also with more features.
    """

    sensible: Callable[[PoseEstimation], bool]
    make: Callable[[PoseEstimation], object]
    again: bool = False


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
        # With matches that are verified without EXIF, and with more features.
        self.without_exif = dataset.distorted / "database_without_exif.db"
        self.strong_database = dataset.distorted / "database_strong.db"
        self.options = options
        self.runner = AttemptRunner(dataset, photos, options.camera_model, threads, progress)
        self.lens_evidence: dict[int, LensEvidence] = {}  # by camera id
        self.started = time.monotonic()
        self.again = False  # the matches are those of more features
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
            self._remove_databases()
            raise error
        self.runner.progress.show_poses(best.models[0], True)
        choice, image_size = self._describe_choice(best), best.matched.effort.image_size
        set_cameras(best.matched.database, best.photos, best.lens)
        exif = exif_focals(best.photos) if best.lens.exif else {}
        before = [camera.params[0] for camera in best.models[0].cameras.values()]
        models = [best.mapping.complete(model, image_size, exif) for model in best.models]
        same = before == [camera.params[0] for camera in models[0].cameras.values()]
        for model in models:
            model.extract_colors_for_all_images(self.dataset.photos, self.runner.threads)
        write_models(models, self.dataset.distorted_models)
        names = [names_in(model) for model in models]
        evidence = self.runner.evidence(best.matched)
        unregistered = explain(best.photos, evidence, names, best.excluded)
        if best.matched.database != self.dataset.database:
            replace_database(self.dataset.database, by=best.matched.database)
        self._remove_databases()
        doubts = list(best.doubts)
        if bent := best.agreement < CONSISTENT:
            doubts.append(
                message(
                    "the poses may be bent: where they fit least, {share:.0%} of the matches "
                    "between neighbouring photos agree with them",
                    share=best.agreement,
                )
            )
        return result_of(
            models,
            best.photos,
            exif=best.lens.exif,
            held=best.mapping.held and same,
            unregistered=unregistered,
            pairs=best.matched.choice.description,
            attempts=self.log + choice,
            doubts=doubts + doubts_about_fisheye(best.lens, best.photos, self.lens_evidence, bent),
            zooms="" if best.photos is given else camera_groups.describe(models[0]),
            agreement=best.agreement,
            fisheye=describe_fisheye(best.lens, best.photos, self.lens_evidence),
        )

    def _remove_databases(self) -> None:
        for database in (self.without_exif, self.strong_database):
            remove_database(database)

    def _make_attempts(self, effort: Effort) -> None:
        """Make the first attempt with ``effort``, and the other candidates as far as needed."""
        self._match_first(effort)
        for candidate in CANDIDATES:
            if candidate.sensible(self):
                candidate.make(self)
        if self._enough or self._hopeless:
            return
        self.matched = self.runner.match(self.strong_database, effort.stronger())
        self._verify(self.matched.choice)
        self.again = True
        for candidate in CANDIDATES:
            if candidate.again and candidate.sensible(self):
                candidate.make(self)

    def _try(self, mapper: Mapper | None = None, lens: Lens | None = None) -> Attempt:
        """Make an attempt with the last matches; the default is the mapper and the lens of the
        first attempt."""
        how = "with more features, from larger photos" if self.again else "as configured"
        made = self.runner.run(how, self.matched, mapper or self.mapper, lens or self.lens)
        self.attempts.append(made)
        self.log.append(made.description)
        return made

    def _try_without_exif(self) -> None:
        """With a wrong focal length, the matches may show only a rotation."""
        self.lens = replace(self.lens, exif=False)
        copy_without_verification(self.matched.database, self.without_exif)
        self.matched = replace(self.matched, database=self.without_exif)
        self._verify(self.matched.choice)
        self._try()

    def _try_without_fisheye(self) -> None:
        """The matches, or a disc, may suggest a fisheye lens where there is none."""
        self._try(lens=replace(self.lens, fisheyes=frozenset(), focals={}))
        self.lens = self._best().lens

    def _try_fixed(self) -> None:
        """The photos may not determine the focal length."""
        self._try(mapper="incremental", lens=replace(self.lens, held=True))

    def _try_other_mapper(self) -> None:
        self._try(mapper="incremental" if self.mapper == "global" else "global")

    def _match_first(self, effort: Effort) -> None:
        """The matches and the lens of the first attempt."""
        database = self.dataset.database
        self.matched = self.runner.match(database, effort, reserve=False)
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

    def _try_zooms(self) -> None:
        """The photos of a camera may have several focal lengths, which remain for the others."""
        lens, one, best = self.lens, self.photos, self._best()
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
            made = self._try(lens=begin)
            if self._best() is not made:
                self.runner.photos = before
                break
            self.lens, model = begin, made.models[0]
            focals = camera_groups.focals_of(model) | camera_groups.own_focals(
                model, self.runner.threads
            )
        set_cameras(self.matched.database, self.photos, self.lens)

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
            exif = exif_focals(attempt.photos)
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
    def _hopeless(self) -> bool:
        """Whether no attempt can find poses."""
        return not self._found and self.evidence.more_effort_is_useless

    @property
    def _good(self) -> bool:
        """Whether enough photos are registered, in a model that agrees with its matches. With more
        features, no further candidate would make a bent model straight."""
        if not self._enough or self.again or self._late:
            return self._enough
        return self._best().agreement >= CONSISTENT

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

    @property
    def _may_miss_exif(self) -> bool:
        """Whether nothing was found, and the focal length in EXIF may be the reason."""
        return not self._found and self.evidence.flat and bool(exif_focals(self.photos))

    @property
    def _contradicts_exif(self) -> bool:
        """Whether the best lens is in doubt, and EXIF knows another focal length, which is tried.

        If the photos do not determine the focal length, the model that was made with a wrong one is
        bent, so `settled`, which starts from this model, may not find that EXIF is right.
        """
        doubtful = self.lens.exif and bool(self._best().doubts) and not self._late
        return doubtful and bool(exif_focals(self.photos))

    @property
    def _may_zoom(self) -> bool:
        """Fisheye lenses with a zoom are rare, so they are not tried."""
        return not self.lens.any_fisheye and camera_groups.may_differ(self.photos)


# In the order of their costs.
CANDIDATES = (
    Candidate(lambda job: True, PoseEstimation._try, again=True),
    Candidate(lambda job: job._may_miss_exif, PoseEstimation._try_without_exif),
    Candidate(
        lambda job: bool(job.lens.fisheyes) and not job._good,
        PoseEstimation._try_without_fisheye,
    ),
    Candidate(
        lambda job: not job._hopeless and (not job._good or job._contradicts_exif),
        PoseEstimation._try_fixed,
        again=True,
    ),
    Candidate(  # before a plane, the global mapper returns a wrong depth
        lambda job: not (job._good or job._hopeless or job.evidence.flat),
        PoseEstimation._try_other_mapper,
        again=True,
    ),
    Candidate(lambda job: job._may_zoom and not job._hopeless, PoseEstimation._try_zooms),
)
