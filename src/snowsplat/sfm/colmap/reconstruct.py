"""Photos -> poses, in as many tries as it takes: the first as asked, then with more of everything.

A try that places 90% of the photos that have detail and matches is the last. Otherwise the others
follow, unless what was found says that none of them can help:

    1  features, pairs and mapper as asked
    2  the same features, more pairs, weaker matches allowed
    3  twice the features, from larger photos; about 4 times the work of the first
    4  the other mapper, on the matches that are there

The one with most photos placed is kept.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import (
    fingerprint_of,
    open_database,
    read_descriptors,
    remove_database,
    replace_database,
)
from snowsplat.sfm.colmap.diagnosis import Evidence, explain, failure, gather_evidence
from snowsplat.sfm.colmap.features import Folders, Teller, extract_features, match_pairs
from snowsplat.sfm.colmap.mapping import Mapping, write_models
from snowsplat.sfm.colmap.options import Effort, Mapper, SfmOptions, SfmResult
from snowsplat.sfm.colmap.pairs import PairChoice, choose_pairs
from snowsplat.sfm.colmap.result import names_in, result_of
from snowsplat.sfm.colmap.retrieval import FEATURES, similarity
from snowsplat.sfm.ingest.photo import Photo

_ENOUGH = 0.9  # of the photos that could be placed
_MAX_ERROR = 4.0  # pixels at which features are looked for


@dataclass(frozen=True)
class Matched:
    """A database with features and matches."""

    database: Path
    effort: Effort
    choice: PairChoice
    scale: float  # pixels of a photo to one at which its features were looked for


@dataclass(frozen=True)
class Trial:
    """What a try came to."""

    matched: Matched
    models: list[pycolmap.Reconstruction]

    @property
    def placed(self) -> int:
        return self.models[0].num_reg_images() if self.models else 0


class Reconstruction:
    """The tries on one set of photos. `run` makes them and writes what is best."""

    def __init__(
        self,
        folders: Folders,
        photos: list[Photo],
        options: SfmOptions,
        threads: int,
        teller: Teller,
    ) -> None:
        self.folders, self.photos, self.options = folders, photos, options
        self.threads, self.teller = threads, teller
        self.attempts: list[str] = []
        self.trials: list[Trial] = []

    def run(self, effort: Effort) -> SfmResult:
        """Make the tries, the first with ``effort``; write ``sparse/`` and the database.

        Raises:
            UserError: no camera positions were found.
        """
        shutil.rmtree(self.folders.sparse, ignore_errors=True)
        first, second = self.folders.database, self.folders.distorted / "database_strong.db"
        mapper = self.options.mapper
        matched = self._match(first, effort, effort)
        evidence = self._evidence(matched)
        if evidence.flat:
            mapper = "incremental"  # the global one finds depth even where there is none to see
        self._try("as asked", matched, mapper)
        if not self._enough(evidence) and (self.trials[0].models or not evidence.hopeless):
            if not (self.trials[0].models and evidence.compared_all):
                more = self._match(first, effort, effort.stronger())
                self._try("with more pairs and weaker matches", more, "incremental", relaxed=True)
            if not self._enough(evidence):
                strong = effort.stronger()
                more = self._match(second, strong, strong)
                self._try("with more features, from larger photos", more, mapper, relaxed=True)
            if not self._enough(evidence) and not evidence.flat:
                other: Mapper = "incremental" if mapper == "global" else "global"
                self._try("with the other mapper", more, other, relaxed=True)
            evidence = self._evidence(more)
        best = max(self.trials, key=lambda trial: trial.placed)
        if not best.models:
            remove_database(second)
            raise failure(evidence)
        write_models(best.models, self.folders.sparse)
        reasons = explain(
            self.photos, self._evidence(best.matched), [names_in(model) for model in best.models]
        )
        result = result_of(
            best.models, self.photos, reasons, best.matched.choice.words, self.attempts
        )
        if best.matched.database == second:
            replace_database(first, by=second)
        remove_database(second)
        return result

    def _match(self, database: Path, effort: Effort, pairing: Effort) -> Matched:
        fingerprint = fingerprint_of(self.folders.images, self.photos, effort)
        open_database(database, self.photos, self.options.camera_model, fingerprint)
        extract_features(self.folders, database, self.photos, effort, self.threads, self.teller)
        choice = choose_pairs(self.photos, pairing, self._alike(database))
        sizes = [max(photo.width, photo.height) for photo in self.photos]
        scale = max(1.0, float(np.median(sizes)) / effort.image_size)
        match_pairs(
            database, self.photos, choice.pairs, _MAX_ERROR * scale, self.threads, self.teller
        )
        return Matched(database, effort, choice, scale)

    def _alike(self, database: Path) -> Callable[[], NDArray[np.floating]]:
        indices = range(len(self.photos))
        return lambda: similarity([read_descriptors(database, i, FEATURES) for i in indices])

    def _try(self, how: str, matched: Matched, mapper: Mapper, relaxed: bool = False) -> None:
        mapping = Mapping(
            matched.database, self.folders.images, matched.scale, self.threads, self.teller.report
        )
        models = mapping.run(mapper, relaxed)
        weak = ""
        if models and models[0].num_reg_images() < len(self.photos):
            before = models[0].num_reg_images()
            models = mapping.extend(models)
            added = models[0].num_reg_images() - before
            weak = f", {added} of them by weak matches" if added else ""
        trial = Trial(matched, models)
        self.trials.append(trial)
        effort = matched.effort
        self.attempts.append(
            f"{how}: {effort.features} features a photo at {effort.image_size} pixels, "
            f"{matched.choice.words}, {mapper} mapping: "
            f"{trial.placed} of {len(self.photos)} placed{weak}"
        )

    def _enough(self, evidence: Evidence) -> bool:
        placed = max(trial.placed for trial in self.trials)
        return placed > 0 and placed >= _ENOUGH * evidence.hopeful

    def _evidence(self, matched: Matched) -> Evidence:
        return gather_evidence(matched.database, self.photos, len(matched.choice.pairs))
