"""Makes a model again, without false matches, if photos of it are in a wrong place."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pycolmap

from snowsplat.sfm.colmap.checks.consistency import (
    CONSISTENT,
    CheckedPair,
    agreement_of,
    check_pairs,
)
from snowsplat.sfm.colmap.checks.parts import find_parts
from snowsplat.sfm.colmap.checks.undetermined import undetermined_photos
from snowsplat.sfm.colmap.database import copy_for_mapping, remove_database
from snowsplat.sfm.colmap.mapping.mapping import Mapping
from snowsplat.sfm.options import MIN_PHOTOS
from snowsplat.util.messages import Message, message, plural

_ROUNDS = 3  # a new model is made at most this number of times


@dataclass(frozen=True)
class Repaired:
    """A model after the check of all photos."""

    model: pycolmap.Reconstruction
    contradicting: int  # number of photos whose pose contradicted their matches
    undetermined: int  # number of photos that are excluded as their position is not determined
    excluded: dict[str, Message]  # name -> reason, for those of these photos that have no pose now

    @property
    def description(self) -> str:
        """What the check found, as text; empty if it found nothing."""
        texts = []
        if self.contradicting:
            again = self.contradicting - (len(self.excluded) - self.undetermined)
            texts = [
                f"the poses of {self.contradicting} contradicted their matches: {again} registered "
                f"again, {self.contradicting - again} left out"
            ]
        if self.undetermined:
            texts.append(f"{self.undetermined} left out, as their positions are not determined")
        return "; ".join(texts)


def repair(model: pycolmap.Reconstruction, mapping: Mapping, max_error: float) -> Repaired:
    """Find the photos of ``model`` that are in a wrong place, and register them again.

    `find_parts` divides the photos into parts that contradict each other. The poses of all parts
    except the first are wrong. There are two causes, and both mends are tried, in this order:

    - A photo was registered with too few points, for example at a turn of the camera. The photos
      after it then have wrong poses, too. They are registered again from the first part, which may
      be on the other side of the weak place (`_registered_again`).
    - Places look alike. Matches between photos of different parts are false if they agree with
      the wrong poses (`_false_pairs`). A new model is made without the false matches: they have
      also bent the first part of the model. This is repeated until no part contradicts the others,
      at most `_ROUNDS` times.

    Of all models, the one with the most photos is used. Its photos that contradict the others are
    left out, and so are those whose positions the points do not determine.

    A model without such photos is returned unchanged. ``max_error`` as in `check_pairs`.
    """
    names: dict[int, str] = {}  # image id -> file name
    # The image ids of the pairs with false matches, of all rounds.
    false_pairs: set[tuple[int, int]] = set()
    wrong: dict[int, Message] = {}  # image id -> reason, for all photos that had a wrong pose
    found: list[tuple[pycolmap.Reconstruction, set[int]]] = []  # models, and their wrong photos
    while True:
        names |= {i: image.name for i, image in model.images.items()}
        pairs = check_pairs(model, mapping.database, max_error)
        parts = _parts(pairs, false_pairs)
        found.append((model, set[int]().union(*parts[1:])))
        wrong |= _reasons(model, pairs, parts)
        if len(parts) < 2:
            break
        models = _registered_again(model, mapping, parts, max_error) if len(found) == 1 else []
        if not models and len(found) <= _ROUNDS:
            false_pairs |= _false_pairs(pairs, parts)
            models = _made_again(mapping, false_pairs)
        if not models:
            break
        model = models[0]
    model, excluded = max(reversed(found), key=lambda m: m[0].num_reg_images() - len(m[1]))
    if excluded:
        model = mapping.without(model, excluded)
    model, undetermined = _without_undetermined(model, mapping)
    registered = set(model.reg_image_ids())
    left_out = {i: reason for i, reason in wrong.items() if i not in registered} | undetermined
    reasons = {names[i]: reason for i, reason in left_out.items()}
    return Repaired(model, len(wrong.keys() - undetermined.keys()), len(undetermined), reasons)


def _without_undetermined(
    model: pycolmap.Reconstruction, mapping: Mapping
) -> tuple[pycolmap.Reconstruction, dict[int, Message]]:
    """``model`` without its `undetermined_photos`; and why: image id -> reason.

    They are not registered again: the matches with the others are too few for a pose. (Measured in
    a capture with two such groups, also with weaker matches: no photo could be.)
    """
    reasons: dict[int, Message] = {}
    while found := undetermined_photos(model):
        for photo, error in found.items():
            reasons[photo] = message(
                "its position is not determined, with an error of {error:,.0f} times the extent of "
                "the other photos: it has too few points in common with them",
                error=error,
            )
        model = mapping.without(model, found)
    return model, reasons


def _parts(pairs: Sequence[CheckedPair], false_pairs: set[tuple[int, int]]) -> list[set[int]]:
    """The parts of a model that contradict each other, as `find_parts`.

    The matches of ``false_pairs`` were found to be false in an earlier model. This may have been a
    mistake, so these pairs are used here, too. There is one exception. If all contradictions come
    from ``false_pairs``, and no pair of photos that follow each other is a tear, then this model is
    considered correct, and there is only one part.
    """
    parts = find_parts(pairs)
    if len(parts) > 1 and not any(pair.torn and pair.follows for pair in pairs):
        others = find_parts([p for p in pairs if (p.first, p.second) not in false_pairs])
        if len(others) == 1:
            return others
    return parts


def _registered_again(
    model: pycolmap.Reconstruction, mapping: Mapping, parts: Sequence[set[int]], max_error: float
) -> list[pycolmap.Reconstruction]:
    """``model`` after the photos of all parts but the first were registered again, as the only
    entry; none if not all of them could be, if parts still contradict each other, or if the model
    does not agree with its matches: false ones may have bent it."""
    rest = mapping.without(copy.deepcopy(model), set().union(*parts[1:]))
    if rest.num_reg_images() < MIN_PHOTOS:
        return []
    again = mapping.extend([rest], relaxed=False)[0]
    if again.num_reg_images() < model.num_reg_images():
        return []
    pairs = check_pairs(again, mapping.database, max_error)
    if len(find_parts(pairs)) > 1:
        return []
    return [again] if agreement_of(pairs) >= CONSISTENT else []


def _made_again(
    mapping: Mapping, false_pairs: set[tuple[int, int]]
) -> list[pycolmap.Reconstruction]:
    """New models, made without the matches of the pairs ``false_pairs``."""
    reduced = mapping.database.with_suffix(".checked.db")
    try:
        copy_for_mapping(mapping.database, reduced, without=false_pairs)
        return replace(mapping, database=reduced).run("incremental")
    finally:
        remove_database(reduced)


def _part_of(parts: Sequence[set[int]]) -> dict[int, int]:
    """Image id -> index of the part that contains this photo."""
    return {i: number for number, part in enumerate(parts) for i in part}


def _false_pairs(pairs: Sequence[CheckedPair], parts: Sequence[set[int]]) -> set[tuple[int, int]]:
    """The pairs of photos in different parts whose matches are false, as image ids.

    These are the pairs that the model does not contradict: the wrong poses agree with their
    matches. Pairs of photos that follow each other are an exception, because they may be the only
    pairs between two parts whose matches are true. Even true matches can agree with wrong poses:
    this happens if other, false matches have moved both photos of the pair in the same way.
    """
    part = _part_of(parts)
    return {
        (pair.first, pair.second)
        for pair in pairs
        if part.get(pair.first, 0) != part.get(pair.second, 0)
        and not (pair.contradicted or pair.follows)
    }


def _reasons(
    model: pycolmap.Reconstruction, pairs: Sequence[CheckedPair], parts: Sequence[set[int]]
) -> dict[int, Message]:
    """Why the photos of all parts but the first are in a wrong place: image id -> text."""
    part = _part_of(parts)
    reasons = {}
    for number, photos in enumerate(parts[1:], start=1):
        tears = [
            p
            for p in pairs
            if p.torn and (part.get(p.first, 0) == number) != (part.get(p.second, 0) == number)
        ]
        for photo in sorted(photos):
            own = [pair for pair in tears if photo in (pair.first, pair.second)]
            worst = max(own or tears, key=lambda pair: pair.matches - pair.hits)
            one, other = (model.image(i).name for i in (worst.first, worst.second))
            reasons[photo] = plural(
                "it was in a place that its matches contradict: {one} and {other} have {matches} "
                "matches, but only {hits} points in common",
                "it was, with other photos ({n} in all), in a place that its matches contradict: "
                "{one} and {other} have {matches} matches, but only {hits} points in common",
                n=len(photos),
                one=one,
                other=other,
                matches=worst.matches,
                hits=worst.hits,
            )
    return reasons
