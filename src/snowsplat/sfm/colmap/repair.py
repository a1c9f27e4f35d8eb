"""Takes photos out of a model that are in a wrong place, and places them again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pycolmap

from snowsplat.sfm.colmap.consistency import CheckedPair, check_pairs, find_parts
from snowsplat.sfm.colmap.database import copy_for_mapping, remove_database
from snowsplat.sfm.colmap.mapping import MIN_PHOTOS, Mapping

_ROUNDS = 3


@dataclass(frozen=True)
class Repaired:
    """A model after the check of all photos."""

    model: pycolmap.Reconstruction
    contradicting: int  # number of photos that contradicted their matches
    left_out: dict[str, str]  # name -> reason, for those that have no pose now

    @property
    def description(self) -> str:
        """What the check found, as text; empty if it found nothing."""
        if not self.contradicting:
            return ""
        placed = self.contradicting - len(self.left_out)
        return (
            f"{self.contradicting} contradicted their matches: {placed} placed again, "
            f"{len(self.left_out)} left out"
        )


def repair(model: pycolmap.Reconstruction, mapping: Mapping, max_error: float) -> Repaired:
    """Check the places of all photos of ``model``, and place those anew that contradict the others.

    The photos of all parts but the first (`find_parts`) lose their poses. Matches that link parts
    are false unless they are torn; without them, the photos are registered again. This is repeated
    until no part contradicts the others. What still does in the last round is left out.
    ``max_error`` is that of `check_pairs`. A model without contradictions is returned unchanged.
    """
    names = {i: image.name for i, image in model.images.items()}
    false: set[tuple[int, int]] = set()
    wrong: dict[int, str] = {}
    for number in range(_ROUNDS + 1):
        pairs = check_pairs(model, mapping.database, max_error)
        parts = find_parts(pairs)
        if len(parts) < 2:
            break
        wrong |= _reasons(model, pairs, parts)
        false |= _false_links(pairs, parts)
        model = mapping.without(model, set().union(*parts[1:]))
        if number == _ROUNDS or model.num_reg_images() < MIN_PHOTOS:
            break
        model = _placed_again(model, mapping, false)
    placed = set(model.reg_image_ids())
    left_out = {i: reason for i, reason in wrong.items() if i not in placed}
    return Repaired(model, len(wrong), {names[i]: reason for i, reason in left_out.items()})


def _placed_again(
    model: pycolmap.Reconstruction, mapping: Mapping, false: set[tuple[int, int]]
) -> pycolmap.Reconstruction:
    reduced = mapping.database.with_suffix(".checked.db")
    try:
        copy_for_mapping(mapping.database, reduced, without=false)
        return replace(mapping, database=reduced).extend([model], relaxed=False)[0]
    finally:
        remove_database(reduced)


def _part_of(parts: Sequence[set[int]]) -> dict[int, int]:
    return {i: number for number, part in enumerate(parts) for i in part}


def _false_links(pairs: Sequence[CheckedPair], parts: Sequence[set[int]]) -> set[tuple[int, int]]:
    """The pairs of photos in different parts whose matches the model does not contradict.

    Those of photos that follow each other are kept: they may be the true link of two parts that
    false matches elsewhere have moved together to a wrong place.
    """
    part = _part_of(parts)
    return {
        (pair.first, pair.second)
        for pair in pairs
        if part.get(pair.first, 0) != part.get(pair.second, 0) and not (pair.torn or pair.follows)
    }


def _reasons(
    model: pycolmap.Reconstruction, pairs: Sequence[CheckedPair], parts: Sequence[set[int]]
) -> dict[int, str]:
    """Why the photos of all parts but the first are in a wrong place: image id -> text."""
    part = _part_of(parts)
    reasons = {}
    for number, photos in enumerate(parts[1:], start=1):
        torn = [
            p
            for p in pairs
            if p.torn and (part.get(p.first, 0) == number) != (part.get(p.second, 0) == number)
        ]
        for photo in sorted(photos):
            own = [pair for pair in torn if photo in (pair.first, pair.second)]
            worst = max(own or torn, key=lambda pair: pair.matches - pair.shared)
            one, other = (model.image(i).name for i in (worst.first, worst.second))
            with_it = "" if len(photos) == 1 else f", with {len(photos) - 1} other photos,"
            reasons[photo] = (
                f"it was{with_it} in a place that its matches contradict: {one} and {other} have "
                f"{worst.matches} matches, but only {worst.shared} points in common"
            )
    return reasons
