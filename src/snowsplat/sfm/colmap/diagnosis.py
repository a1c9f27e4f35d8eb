"""Why photos could not be placed, in words for people, read off the features and matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snowsplat.sfm.colmap.database import (
    Pair,
    displacement_of,
    feature_counts,
    verified_pairs,
)
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.errors import UserError

_FEW_FEATURES = 60
_WEAK_PAIR = 50  # matches
_MANY_FEATURES = 500  # a sharp photo of nearly anything has more
_STILL = 0.01  # of the photo's longest side
_FLAT_SHARE = 0.8


@dataclass(frozen=True)
class Evidence:
    """What the database says about the photos, by index."""

    features: list[int]
    pairs: list[Pair]
    displacement: float | None  # of matches from photo to photo, as a part of the longest side
    compared: int  # pairs that were

    @property
    def compared_all(self) -> bool:
        count = len(self.features)
        return self.compared >= count * (count - 1) // 2

    @property
    def hopeful(self) -> int:
        """How many photos could be placed at all: they have detail, and it is not all their own."""
        paired = {i for pair in self.pairs for i in (pair.first, pair.second)}
        alone = _MANY_FEATURES if self.compared_all else float("inf")
        return sum(
            count >= _FEW_FEATURES and (i in paired or count < alone)
            for i, count in enumerate(self.features)
        )

    @property
    def flat(self) -> bool:
        """Whether one plane, or a camera that only turned, explains the matches."""
        flat = sum(pair.inliers for pair in self.pairs if pair.flat)
        return flat > 0 and flat >= _FLAT_SHARE * sum(pair.inliers for pair in self.pairs)

    @property
    def still(self) -> bool:
        return self.displacement is not None and self.displacement < _STILL

    @property
    def hopeless(self) -> bool:
        """Whether, where no model was found, stronger settings would find none either."""
        if self.still or self.flat:
            return True
        return self.hopeful < 3


def gather_evidence(database: Path, photos: Sequence[Photo], compared: int) -> Evidence:
    """Read the database after matching; ``compared`` is how many pairs were."""
    pairs = verified_pairs(database)
    size = max(max(photo.width, photo.height) for photo in photos)
    # Some pairs tell; an even choice of them.
    some = pairs[:: max(1, len(pairs) // 100)]
    displacement = displacement_of(database, some) / size if some else None
    return Evidence(feature_counts(database, len(photos)), pairs, displacement, compared)


def explain(
    photos: Sequence[Photo], evidence: Evidence, models: Sequence[set[str]]
) -> dict[str, str]:
    """Name -> why, of each photo that is not in the first of ``models`` (sets of names)."""
    partners: list[list[int]] = [[] for _ in photos]
    for pair in evidence.pairs:
        partners[pair.first].append(pair.inliers)
        partners[pair.second].append(pair.inliers)
    reasons = {}
    for photo, features, matches in zip(photos, evidence.features, partners, strict=True):
        if photo.name in models[0]:
            continue
        part = next((model for model in models[1:] if photo.name in model), None)
        if part is not None:
            reason = f"it is in another part of {len(part)} photos, which does not join the rest"
        elif features < _FEW_FEATURES:
            reason = f"it shows hardly any detail ({features} points): too dark, blurred or plain"
        elif not matches:
            reason = "it matches no other photo"
        elif max(matches) < _WEAK_PAIR:
            reason = (
                f"it matches only {_photos(len(matches), 'other ')}, weakly "
                f"(at most {max(matches)} points)"
            )
        else:
            reason = f"its matches with {_photos(len(matches), 'other ')} do not fit the rest"
        reasons[photo.name] = reason
    return reasons


def failure(evidence: Evidence) -> UserError:
    """Why no model was found at all, and what to do about it."""
    count = len(evidence.features)
    usable = sum(features >= _FEW_FEATURES for features in evidence.features)
    paired = {i for pair in evidence.pairs for i in (pair.first, pair.second)}
    if usable < 3:
        return UserError(
            f"too few of the {count} photos have detail to go by ({usable}): the others are too "
            "dark, blurred or plain; take sharp, well-lit photos of things with texture"
        )
    if len(paired) < 3:
        return UserError(
            f"the {count} photos do not show the same things ({_matching(len(paired))}); take "
            "photos of one scene, each showing more than half of what the one before it shows"
        )
    if evidence.still:
        return UserError(
            "the camera hardly moved between the photos, so nothing tells how far things are; "
            "walk around the scene while you take them"
        )
    if evidence.flat:
        return UserError(
            "the camera only turned on the spot, or the photos show one flat thing, so nothing "
            "tells how far things are; walk around a scene that has depth"
        )
    return UserError(
        f"the camera positions of the {count} photos could not be found: their matches are too "
        "few or do not fit together; take more photos with smaller steps between them"
    )


def _matching(count: int) -> str:
    return "no two of them match" if count == 0 else f"only {count} of them match"


def _photos(count: int, kind: str) -> str:
    return f"{count} {kind}photo{'' if count == 1 else 's'}"
