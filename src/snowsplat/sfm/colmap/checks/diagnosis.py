"""Explains to the user why photos have no pose, from the features and matches."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snowsplat.sfm.colmap.database import (
    MIN_MATCHES,
    VerifiedPair,
    displacements_of,
    feature_counts,
    verified_pairs,
)
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.options import MIN_PHOTOS
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message, message, plural

# A photo with fewer features is too dark, blurred or plain.
_FEW_FEATURES = 60
# Nearly every sharp photo has more features than this.
_MANY_FEATURES = 500
# If the displacement of the matches, divided by the longest side of the photo, is smaller, the
# camera did not move.
_STILL = 0.01
# If at least this fraction of all matches fits a plane or a pure rotation, depth is undetermined.
_FLAT_SHARE = 0.8


@dataclass(frozen=True)
class Evidence:
    """The data about the photos that the COLMAP database contains after matching."""

    features: list[int]  # number of features of each photo; the first photo has the image id 1
    pairs: list[VerifiedPair]  # the pairs with verified matches
    # Typical displacement of a match between two photos, relative to the longest side; None if
    # there are no matches.
    displacement: float | None
    matched: int  # number of pairs that were matched, with or without success
    # About 100 of the pairs, without those from one place, which fit a rotation in any scene; None:
    # all pairs.
    moving: list[VerifiedPair] | None = None

    @property
    def matched_all(self) -> bool:
        """Whether every photo was matched with every other photo."""
        count = len(self.features)
        return self.matched >= count * (count - 1) // 2

    @property
    def usable(self) -> int:
        """Number of photos that could get a pose.

        Such a photo has enough features, and other photos show the same scene.
        """
        paired = {i for pair in self.pairs for i in (pair.first, pair.second)}
        # If all pairs were matched, a photo with many features but no verified match shows another
        # scene. With fewer features, or if some pairs were not matched, another attempt with more
        # effort may find matches.
        no_match_limit = _MANY_FEATURES if self.matched_all else float("inf")
        return sum(
            count >= _FEW_FEATURES and (i in paired or count < no_match_limit)
            for i, count in enumerate(self.features, start=1)
        )

    @property
    def flat(self) -> bool:
        """Whether one plane, or a pure rotation of the camera, explains most matches."""
        pairs = self.pairs if self.moving is None else self.moving
        flat = sum(pair.matches for pair in pairs if pair.flat)
        return flat > 0 and flat >= _FLAT_SHARE * sum(pair.matches for pair in pairs)

    @property
    def still(self) -> bool:
        """Whether the camera hardly moved between the photos."""
        return self.displacement is not None and self.displacement < _STILL

    @property
    def more_effort_is_useless(self) -> bool:
        """Whether an attempt with more effort cannot find a model, if no model was found yet."""
        return self.still or self.flat or self.usable < MIN_PHOTOS


def gather_evidence(database: Path, photos: Sequence[Photo], matched: int) -> Evidence:
    """Read the database after matching; ``matched`` is the number of pairs that were matched."""
    pairs = verified_pairs(database)
    size = max(max(photo.width, photo.height) for photo in photos)
    # About 100 evenly chosen pairs are enough.
    some = pairs[:: max(1, len(pairs) // 100)]
    moved = np.array(displacements_of(database, some, _STILL * size)) / size
    # A lower quantile would be nearly zero in a slow video, where the frames of many pairs are
    # nearly equal.
    displacement = float(np.quantile(moved, 0.9)) if some else None
    moving = [pair for pair, far in zip(some, moved >= _STILL, strict=True) if far]
    return Evidence(feature_counts(database, len(photos)), pairs, displacement, matched, moving)


def explain(
    photos: Sequence[Photo],
    evidence: Evidence,
    models: Sequence[set[str]],
    excluded: Mapping[str, Message],
) -> dict[str, Message]:
    """Why photos have no pose: name -> reason, for each photo that is not in the first model.

    Args:
        models: the names of the photos in each model, the largest model first.
        excluded: name -> reason, for photos that had a pose in a wrong place (`repair`).
    """
    reasons = {}
    for i, (photo, features) in enumerate(zip(photos, evidence.features, strict=True), start=1):
        if photo.name in models[0]:
            continue
        matches = [pair.matches for pair in evidence.pairs if i in (pair.first, pair.second)]
        other_model = next((model for model in models[1:] if photo.name in model), None)
        others = plural("{n} other photo", "{n} other photos", n=len(matches))
        if photo.name in excluded:
            reason = excluded[photo.name]
        elif other_model is not None:
            reason = message("it is in a separate group of {count} photos", count=len(other_model))
        elif features < _FEW_FEATURES:
            reason = message(
                "it shows hardly any detail ({features} features): too dark, blurred or plain",
                features=features,
            )
        elif not matches:
            reason = message("it matches no other photo")
        elif max(matches) < MIN_MATCHES:
            reason = message(
                "it has too few matches with {others} (at most {most})",
                others=others,
                most=max(matches),
            )
        else:
            reason = message(
                "its matches with {others} are not consistent with the model", others=others
            )
        reasons[photo.name] = reason
    return reasons


def failure(evidence: Evidence, doubts: Sequence[Message] = ()) -> UserError:
    """The error to raise if no model was found: the reason, and what to do about it.

    ``doubts``: why a model was rejected.
    """
    count = len(evidence.features)
    usable = sum(features >= _FEW_FEATURES for features in evidence.features)
    paired = {i for pair in evidence.pairs for i in (pair.first, pair.second)}
    if usable < MIN_PHOTOS:
        return UserError(
            "photos: only {usable} of {count} show enough detail, and the others are too dark, "
            "blurred or plain; take sharp, well-lit photos of objects with texture",
            usable=usable,
            count=count,
        )
    if len(paired) < MIN_PHOTOS:
        matching = message("no two of them match")
        if paired:
            matching = message("only {count} of them match", count=len(paired))
        return UserError(
            "photos: the {count} photos do not overlap ({matching}); take photos of one scene, "
            "so that each shows more than half of what the previous one shows",
            count=count,
            matching=matching,
        )
    if evidence.still:
        return UserError(
            "photos: the camera hardly moved between the photos, so depth cannot be estimated; "
            "walk around the scene while taking them, or put an object that turns before a plain "
            "background"
        )
    if evidence.flat:
        return UserError(
            "photos: the camera only rotated, or the scene is flat, so depth cannot be estimated; "
            "walk around a scene that has depth, or put the camera on a tripod if an object turns, "
            "because only a still background is masked"
        )
    if doubts:
        return UserError(
            "photos: no possible camera poses were found for the {count} photos: {doubts}; take "
            "more photos, with smaller steps between them, or set another camera_model",
            count=count,
            doubts=doubts,
        )
    return UserError(
        "photos: no camera poses were found for the {count} photos, because their matches are "
        "too few or inconsistent; take more photos, with smaller steps between them",
        count=count,
    )
